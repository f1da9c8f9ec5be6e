"""Rasters lie where the clouds lie: to no fraction of a cell beside what a transform says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_scene import make_pair

from mtpcr_geo.core import transforms
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export import difference, drawing, resample
from mtpcr_geo.method.bev import make_bev, rasterise

SHIFTS = [(0.31, -0.44, 0.0), (0.5, 0.49, 0.2), (-7.77, 3.21, -1.0)]


def turned_by_nothing(shift: tuple[float, float, float], cell: float = 1.0) -> Pair:
    """A pair whose clouds are one and the same, the source put elsewhere by a shift and nothing else."""
    pair = make_pair(60_000, cell=cell)
    xyz = pair.target.sample - shift
    source = replace(pair.target, role="source", sample=xyz, bev=make_bev(xyz, cell))
    return pair.with_(source=source, T_target_source=transforms.translation(shift))


def without_points(pair: Pair) -> Pair:
    """The pair as a run has it of clouds too large to be held in memory."""
    return pair.with_(
        source=replace(pair.source, complete=False), target=replace(pair.target, complete=False)
    )


@pytest.mark.parametrize("shift", SHIFTS)
def test_a_registered_raster_is_that_of_the_moved_points(shift):
    pair = turned_by_nothing(shift)
    moved = resample.registered_bev(pair)
    assert pair.target.bev is not None
    again = resample.cut_to(moved, pair.target.bev.grid)
    assert again is not None
    for name in ("top", "low", "count"):
        np.testing.assert_allclose(getattr(again, name), getattr(pair.target.bev, name), atol=1e-5)


@pytest.mark.parametrize("shift", SHIFTS)
def test_the_difference_of_a_cloud_and_itself_is_nothing(shift):
    pair = turned_by_nothing(shift)
    found = difference.height_difference(pair)
    assert found is not None
    assert pair.target.bev is not None
    assert np.isfinite(found.low).sum() == np.isfinite(pair.target.bev.low).sum()
    assert np.nanmax(np.abs(found.low)) < 1e-4
    assert np.nanmax(np.abs(found.top)) < 1e-4


@pytest.mark.parametrize(("shift", "most"), [(SHIFTS[0], 1600), (SHIFTS[1], 70)])
def test_both_clouds_lie_alike_on_the_grid_of_a_picture(shift, most):
    source, target = drawing.common_rasters(turned_by_nothing(shift), max_side=most)
    assert source.grid == target.grid
    np.testing.assert_allclose(source.low, target.low, atol=1e-4)
    np.testing.assert_allclose(source.top, target.top, atol=1e-4)


def test_a_turned_and_tilted_source_is_rasterised_from_its_points():
    pair = make_pair(60_000, tilt=0.1)
    moved = resample.registered_bev(pair)
    assert pair.T_target_source is not None
    xyz = transforms.apply(pair.T_target_source, pair.source.sample)
    assert int(moved.count.sum()) == len(xyz)
    expected = rasterise([xyz], moved.grid)
    np.testing.assert_allclose(moved.top, expected.top, atol=1e-5)


def test_of_a_cloud_that_is_not_held_its_cells_are_moved():
    pair = without_points(turned_by_nothing(SHIFTS[0]))
    moved = resample.registered_bev(pair)
    assert pair.target.bev is not None
    placed = resample.cut_to(moved, pair.target.bev.grid)
    assert placed is not None
    # the nearest cell lies 0.31 and 0.44 of a cell beside it, heights are exact
    both = np.isfinite(placed.low) & np.isfinite(pair.target.bev.low)
    assert both.mean() > 0.5
    assert abs(np.median((placed.low - pair.target.bev.low)[both])) < 0.02


def test_a_raster_is_cut_and_widened_to_a_grid_of_its_lattice_alone():
    bev = make_bev(make_pair(3000).target.sample, 1.0)
    grid = bev.grid
    wider = Grid(grid.west - 3.0, grid.north + 2.0, 1.0, grid.width + 7, grid.height + 5)
    found = resample.cut_to(bev, wider)
    assert found is not None
    assert int(found.count.sum()) == int(bev.count.sum())
    back = resample.cut_to(found, grid)
    assert back is not None
    np.testing.assert_array_equal(back.top, bev.top)
    assert resample.cut_to(bev, replace(wider, west=wider.west + 0.25)) is None
    assert resample.cut_to(bev, replace(wider, cell=1.001)) is None
    apart = resample.cut_to(bev, replace(grid, west=grid.west + 10.0 * grid.width))
    assert apart is not None
    assert not apart.count.any()


def test_a_grid_is_snapped_outwards():
    lattice = Grid(10.0, 50.0, 2.0, 20, 20)
    found = resample.snapped(Grid(13.0, 47.5, 2.0, 4, 5), lattice)
    assert (found.west, found.north) == (12.0, 48.0)
    assert found.west + found.width * 2.0 >= 21.0
    assert found.north - found.height * 2.0 <= 37.5
    assert resample.cut_to(make_bev(np.zeros((1, 3)), 2.0), found) is not None


def test_slopes_of_a_cloud_that_is_held_and_one_that_is_not_lie_alike():
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, 120.0, (120_000, 2))
    slope = np.column_stack([xy, 0.2 * xy[:, 0]])
    bev = make_bev(slope, 1.0)
    pair = turned_by_nothing((0.0, 0.0, 0.0))
    target = replace(pair.target, sample=slope, bev=bev, complete=False)
    pair = pair.with_(target=target, source=replace(target, role="source", complete=True))
    source, fixed = drawing.common_rasters(pair, max_side=50)
    assert source.grid.cell > 2.0
    assert abs(np.nanmedian(source.low - fixed.low)) < 0.02
    assert abs(np.nanmedian(source.top - fixed.top)) < 0.02
