"""Lengths that follow from the data: within the limits of their table, whatever the site and wherever."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest

from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import Coverage, choose_cell, choose_cells
from mtpcr_geo.method.scales import (
    block_for,
    filled_share,
    ground_cell_for,
    occupied_area,
    scales_of,
    tolerance_for,
)

SITES = {"plot": (20.0, 100.0), "scan": (60.0, 40.0), "tile": (1000.0, 8.0)}
"""Edge, metres, and points per square metre."""


def full(extent: float, cell: float) -> Bev:
    """A flat square raster, every cell filled."""
    side = round(extent / cell)
    height = np.zeros((side, side), np.float32)
    grid = Grid(0.0, side * cell, cell, side, side)
    return Bev(grid, height, height, np.ones((side, side), np.uint32))


def of_site(name: str) -> Bev:
    extent, density = SITES[name]
    return full(extent, choose_cell([density, density], extent))


@pytest.mark.parametrize("name", SITES)
def test_lengths_keep_the_limits_of_the_table(name: str) -> None:
    extent, _ = SITES[name]
    bev = of_site(name)
    cell = bev.grid.cell
    scales = scales_of(bev, bev)
    assert 0.25 <= cell <= 8.0
    assert scales.cell_m == cell
    assert scales.extent_m == pytest.approx(extent, rel=0.1)
    assert 12 * cell <= scales.patch_m <= max(24.0, 12 * cell)
    assert 3 * cell <= scales.search_radius_m <= max(6.0, 3 * cell)
    assert scales.least_overlap_m2 <= min(400.0, 0.2 * occupied_area(bev))
    assert 1.0 <= scales.terrain_cell_m <= max(8.0, 4 * cell, min(scales.extent_m / 40.0, 32.0))
    assert scales.terrain_cell_m >= 4 * cell
    assert 1.0 <= scales.same_pose_m <= 12.0
    assert scales.tolerance_m == max(cell, 0.5)
    # room for several patches side by side, and a patch that moves stays near where it was
    assert scales.patch_m <= extent / 3
    assert scales.search_radius_m < scales.patch_m / 2


def test_a_plot_a_scan_and_a_tile() -> None:
    plot, scan, tile = (scales_of(of_site(name), of_site(name)) for name in ("plot", "scan", "tile"))
    assert (plot.cell_m, scan.cell_m, tile.cell_m) == (0.25, 0.25, 1.0)
    assert (plot.patch_m, scan.patch_m, tile.patch_m) == (5.0, 15.0, 24.0)
    assert (plot.least_overlap_m2, scan.least_overlap_m2, tile.least_overlap_m2) == (80.0, 400.0, 400.0)
    assert (plot.terrain_cell_m, scan.terrain_cell_m, tile.terrain_cell_m) == (2.5, 7.5, 25.0)
    assert (plot.same_pose_m, scan.same_pose_m, tile.same_pose_m) == (2.5, 7.5, 12.0)


@pytest.mark.parametrize("cell", [0.25, 1.0, 4.0])
def test_no_length_shrinks_as_the_site_grows(cell: float) -> None:
    found = [astuple(scales_of(full(e, cell), full(e, cell))) for e in (16, 24, 32, 64, 128, 256, 512)]
    assert (np.diff(np.array(found), axis=0) >= 0.0).all()


def test_the_smaller_cloud_decides_whichever_it_is() -> None:
    small, large = full(24.0, 1.0), full(400.0, 1.0)
    assert scales_of(small, large) == scales_of(large, small) == scales_of(small, small)


def test_position_plays_no_part() -> None:
    rng = np.random.default_rng(4)
    xy = rng.uniform(0.0, 60.0, (500, 2))
    far = 5_000_000.0
    assert block_for(xy + far, 0.5) == pytest.approx(block_for(xy, 0.5), rel=1e-6)
    for name in SITES:
        bev = of_site(name)
        grid = bev.grid
        moved = replace(bev, grid=replace(grid, west=grid.west + far, north=grid.north - far))
        assert scales_of(moved, moved) == scales_of(bev, bev)


def test_gaps_between_the_rings_of_a_scan_count_as_seen() -> None:
    bev = full(40.0, 0.25)
    ringed = np.zeros_like(bev.count)
    ringed[::6] = 1
    assert occupied_area(replace(bev, count=ringed)) == pytest.approx(occupied_area(bev))


def test_thin_rasters_get_larger_patches() -> None:
    bev = full(400.0, 2.0)
    thin = replace(bev, count=(np.random.default_rng(3).random(bev.count.shape) < 0.35).astype(np.uint32))
    assert filled_share(bev) == pytest.approx(1.0)
    assert filled_share(thin) == pytest.approx(0.35, rel=0.05)
    found = scales_of(thin, thin)
    assert found.fill == pytest.approx(0.35**2, rel=0.1)
    assert found.fill * (found.patch_m / 2.0) ** 2 == pytest.approx(40.0, rel=0.01)
    # but never more than half of a small site
    small = full(40.0, 2.0)
    few = (np.random.default_rng(4).random(small.count.shape) < 0.2).astype(np.uint32)
    few_patch = scales_of(replace(small, count=few), small).patch_m
    assert few_patch <= max(12 * 2.0, 40.0 / 2)


def test_blocks_follow_the_tie_points() -> None:
    rng = np.random.default_rng(5)

    def block(extent: float, cell: float = 0.5) -> float:
        return block_for(rng.uniform(0.0, extent, (2000, 2)), cell)

    assert block(20.0) == pytest.approx(0.9 * 20.0 / 5, rel=0.1)
    assert block(60.0) == pytest.approx(0.9 * 60.0 / 5, rel=0.1)
    assert block(1000.0) == 40.0
    assert block_for(np.array([[3.0, 4.0]]), 1.0) == 40.0
    assert block_for(np.full((9, 2), 7.0), 1.0) == 1.0
    # as many blocks on a plot as on a tile: enough to hold some out
    xy = rng.uniform(0.0, 20.0, (2000, 2))
    assert len(np.unique(np.floor(xy / block_for(xy, 0.25)), axis=0)) >= 25


def test_ground_cells_and_tolerances_follow_the_raster() -> None:
    assert [ground_cell_for(cell) for cell in (0.1, 0.25, 0.5, 1.0, 8.0)] == [0.5, 0.5, 1.0, 2.0, 2.0]
    assert [tolerance_for(cell) for cell in (0.25, 0.5, 1.0, 8.0)] == [0.5, 0.5, 1.0, 8.0]


@pytest.mark.parametrize(
    ("densities", "extent", "cell"),
    [
        ([400.0, 400.0], 20.0, 0.25),  # a dense plot
        ([100.0, 10.0], 30.0, 0.25),  # 0.35 m would hold 1.2 points of the sparser one
        ([100.0, 2.0], 30.0, 0.75),
        ([1.2, 400.0], 30.0, 1.0),
        ([100.0, 100.0], 100.0, 0.5),  # no more than some 200 cells across
        ([100.0, 100.0], 150.0, 0.75),
        ([100.0, 100.0], 200.0, 1.0),
        ([100.0, 100.0], 5000.0, 1.0),  # from 200 m on, 1 m is fine enough
        ([8.0, 4.0], 1000.0, 1.0),
        ([0.5, 20.0], 1000.0, 1.5),
        ([0.005, 20.0], 5000.0, 8.0),  # the coarsest
    ],
)
def test_density_and_extent_choose_the_cell(densities: list[float], extent: float, cell: float) -> None:
    assert choose_cell(densities, extent) == cell
    assert choose_cell(densities[::-1], extent) == cell


def test_cells_grow_with_the_extent_and_shrink_with_the_density() -> None:
    by_extent = [choose_cell([50.0], extent) for extent in np.geomspace(5.0, 5000.0, 40)]
    by_density = [choose_cell([density], 40.0) for density in np.geomspace(0.001, 1000.0, 60)]
    assert (np.diff(by_extent) >= 0.0).all()
    assert (np.diff(by_density) <= 0.0).all()
    assert {by_extent[0], by_extent[-1]} == {0.25, 1.0}
    assert {by_density[0], by_density[-1]} == {8.0, 0.25}


def test_a_finest_cell_that_is_asked_for_stands_in_for_the_extent() -> None:
    plot = Coverage(points=40_000, box_m2=400.0, occupied_m2=400.0)
    assert choose_cells([plot, plot]).cells_m == (0.25, 0.25)
    assert choose_cells([plot, plot], finest=1.0).cells_m == (1.0, 1.0)
    tile = Coverage(points=40_000_000, box_m2=1e6, occupied_m2=1e6)
    assert choose_cells([tile, tile]).cells_m == (1.0, 1.0)
    assert choose_cells([tile, tile], finest=0.5).cells_m == (0.5, 0.5)
    assert choose_cells([plot, tile], cell=2.0).cells_m == (2.0, 2.0)
