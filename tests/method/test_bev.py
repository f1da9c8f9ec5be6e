from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.method.bev import choose_cell, coarsen, coverage_of, grid_around, make_bev, rasterise


def test_hand_worked_cells() -> None:
    xyz = np.array([[0.2, 0.2, 1.0], [0.8, 0.9, 5.0], [0.5, 0.5, -2.0], [2.5, 1.5, 7.0]])
    bev = rasterise([xyz], Grid(west=0.0, north=2.0, cell=1.0, width=3, height=2))
    assert bev.count.tolist() == [[0, 0, 1], [3, 0, 0]]
    assert bev.top[1, 0] == 5.0
    assert bev.low[1, 0] == -2.0
    assert bev.top[0, 2] == bev.low[0, 2] == 7.0
    assert np.isnan(bev.top[0, 0])


def test_pixel_centres_map_to_metres_and_back() -> None:
    grid = Grid(west=10.0, north=50.0, cell=2.0, width=5, height=4)
    assert grid.to_metres(np.array([[0.0, 0.0]])).tolist() == [[11.0, 49.0]]
    assert grid.to_pixel(np.array([[11.0, 49.0], [12.0, 48.0]])).tolist() == [[0.0, 0.0], [0.5, 0.5]]


def test_chunks_make_no_difference() -> None:
    xyz = np.random.default_rng(1).uniform(0, 50, (5000, 3))
    grid = grid_around(xyz.min(axis=0), xyz.max(axis=0), 1.5)
    whole = rasterise([xyz], grid)
    parts = rasterise(np.array_split(xyz, 7), grid)
    assert np.array_equal(whole.top, parts.top, equal_nan=True)
    assert np.array_equal(whole.low, parts.low, equal_nan=True)
    assert np.array_equal(whole.count, parts.count)


def test_points_outside_the_grid_are_left_out() -> None:
    bev = rasterise(
        [np.array([[-1.0, 0.5, 0.0], [9.0, 0.5, 0.0], [0.5, 0.5, 3.0]])], Grid(0.0, 1.0, 1.0, 1, 1)
    )
    assert bev.count.tolist() == [[1]]


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_coarsening_equals_rasterising_coarser(factor: int) -> None:
    xyz = np.random.default_rng(2).uniform(-37, 41, (3000, 3))
    fine = rasterise([xyz], grid_around(xyz.min(axis=0), xyz.max(axis=0), 1.0))
    coarse = coarsen(fine, factor)
    direct = rasterise([xyz], coarse.grid)
    assert np.array_equal(coarse.top, direct.top, equal_nan=True)
    assert np.array_equal(coarse.low, direct.low, equal_nan=True)
    assert coarse.count.sum() == len(xyz)
    assert coarse.grid.west % factor == 0
    assert coarse.grid.north % factor == 0


def test_density_counts_occupied_ground_only() -> None:
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0, 20, (4000, 3))
    far = xyz + [1000.0, 0.0, 0.0]
    both = np.vstack([xyz, far])
    assert coverage_of(both).per_m2 == pytest.approx(coverage_of(xyz).per_m2, rel=0.2)


@pytest.mark.parametrize("share", [0.04, 0.2, 0.999])
def test_the_density_of_a_sample_is_that_of_the_cloud(share: float) -> None:
    rng = np.random.default_rng(5)
    wide, per_m2 = 1200.0, 0.5
    whole = rng.uniform(0.0, wide, (round(per_m2 * wide**2), 3))
    sample = whole[rng.random(len(whole)) < share]
    found = coverage_of(sample, points=len(whole))
    assert found.per_m2 == pytest.approx(per_m2, rel=0.1)
    assert found.occupied_m2 == pytest.approx(wide**2, rel=0.1)
    assert choose_cell([found.per_m2]) == choose_cell([per_m2])


def test_a_whole_cloud_is_measured_in_cells_of_two_metres_however_sparse() -> None:
    xyz = np.random.default_rng(6).uniform(0.0, 400.0, (3000, 3))
    assert coverage_of(xyz).occupied_m2 == coverage_of(xyz, points=len(xyz)).occupied_m2 <= 4.0 * len(xyz)


def test_a_sample_of_a_few_points_far_apart_has_a_density() -> None:
    few = np.array([[1.0, 1.0, 0.0], [901.0, 1.0, 0.0], [1.0, 901.0, 0.0]])
    assert 0.0 < coverage_of(few, points=1000).per_m2 < 1.0
    assert coverage_of(few[:1], points=1000).occupied_m2 == 4.0


def test_a_cloud_wider_than_cells_of_two_metres_fit_has_a_density() -> None:
    xyz = np.random.default_rng(7).uniform(0.0, 1.0, (2000, 3)) * [20_000.0, 20_000.0, 10.0]
    assert coverage_of(xyz).per_m2 == pytest.approx(1 / 16, rel=0.02)
    with pytest.raises(RegistrationError, match="too large"):
        coverage_of(xyz * [5.0, 5.0, 1.0])


def test_the_sparser_cloud_sets_the_cell() -> None:
    rng = np.random.default_rng(4)
    dense = coverage_of(rng.uniform(0, 100, (100_000, 3))).per_m2
    sparse = coverage_of(rng.uniform(0, 200, (13_000, 3))).per_m2
    assert choose_cell([dense, dense]) == 1.0
    assert choose_cell([dense, sparse]) > choose_cell([dense, dense])


def test_a_raster_too_large_is_refused_with_the_way_out() -> None:
    with pytest.raises(RegistrationError, match="coarser cell"):
        grid_around(np.zeros(2), np.full(2, 1e6), 0.5)


def test_points_of_an_exact_grid_all_lie_in_their_raster():
    x, y = np.meshgrid(np.arange(5.0, 9.0), np.arange(-3.0, 4.0))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    for cell in (0.5, 1.0, 2.0):
        bev = make_bev(xyz, cell)
        assert int(bev.count.sum()) == len(xyz)
