"""The ground that both clouds see: on slopes too, and whatever their densities."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_plots import plot, terrain

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import grid_around, rasterise
from mtpcr_geo.method.overlap import (
    MOST_OVERLAP_CELLS,
    OVERLAP_CELL_M,
    CommonGround,
    _ground,
    _lowest_near,
    _slope,
    overlap_of,
)
from mtpcr_geo.method.settle import settle_on_ground


def slope_of(bev: Bev) -> np.ndarray:
    """(h, w) slope of a raster's ground, rise over run."""
    return _slope(_lowest_near(bev.low, bev.grid.cell), bev.grid.cell)


def hillside(seed: int, slope: float, n: int = 60_000, extent: float = 120.0) -> np.ndarray:
    """(n, 3) points on rolling ground that rises to the east, metres."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-extent / 2, extent / 2, (n, 2))
    return np.column_stack([xy, terrain(xy, slope=slope) + rng.normal(0.0, 0.02, n)])


@pytest.mark.parametrize("slope", [0.0, 0.15, 0.3, 0.5])
def test_ground_on_a_slope_is_ground(slope: float) -> None:
    source, target = hillside(1, slope), hillside(2, slope)
    overlap = overlap_of(source, target)
    xy, step = overlap.ground_steps()
    assert len(step) > 0.6 * overlap.shared.sum()
    assert abs(np.median(step)) < 0.01
    assert np.abs(step).max() < 0.5
    # spread over the whole site, not on its flats alone
    assert np.ptp(xy, axis=0).min() > 100.0


def test_ground_beneath_trees_is_told_from_crowns() -> None:
    rng = np.random.default_rng(3)
    source, target = plot(rng, 60.0, 20.0), plot(rng, 60.0, 20.0)
    roofed = np.vstack([target[np.abs(target[:, :2]).max(axis=1) > 5.0], roof(rng)])
    xy, step = overlap_of(roofed, roofed + [0.0, 0.0, 0.3]).ground_steps()
    assert not (np.abs(xy).max(axis=1) < 4.5).any()
    assert np.allclose(step, 0.3, atol=1e-6)
    _, step = overlap_of(source, target).ground_steps()
    assert (np.abs(step) < 0.5).mean() > 0.95


def roof(rng: np.random.Generator) -> np.ndarray:
    """(n, 3) points on a flat roof of 10 m by 10 m around zero, 9 m up."""
    xy = rng.uniform(-5.0, 5.0, (2000, 2))
    return np.column_stack([xy, np.full(len(xy), 9.0) + rng.normal(0.0, 0.02, len(xy))])


@pytest.mark.parametrize(("noise", "slope"), [(0.02, 0.0), (0.05, 0.0), (0.02, 0.1)])
def test_a_denser_cloud_has_no_lower_ground(noise: float, slope: float) -> None:
    rng = np.random.default_rng(4)
    grid = grid_around(np.zeros(2), np.full(2, 40.0), 2.0)
    heights, lowest = [], []
    for per_cell in (5, 200):
        xy = rng.uniform(0.0, 40.0, (400 * per_cell, 2))
        xyz = np.column_stack([xy, slope * xy[:, 0] + rng.normal(0.0, noise, len(xy))])
        bev = rasterise([xyz], grid)
        heights.append(_ground(xyz, bev, slope_of(bev)))
        lowest.append(bev.low)
    bias = np.nanmedian(heights[1] - heights[0])
    assert abs(bias) < 0.02
    # the single lowest point of a cell is no such measure
    assert np.nanmedian(lowest[1] - lowest[0]) < -0.02


def test_height_is_settled_across_densities() -> None:
    source, target = hillside(5, 0.0, 7200), hillside(6, 0.0, 200_000)
    T = transforms.translation((0.0, 0.0, 0.2))
    for a, b in ((source, target), (target, source)):
        fit = settle_on_ground(a, b, T, tilt=False)
        assert abs(fit.T[2, 3]) < 0.02


def test_empty_cells_have_no_ground() -> None:
    xyz = hillside(7, 0.3, 4000, 40.0)
    bev = rasterise([xyz[xyz[:, 0] > 0.0]], grid_around(np.full(2, -20.0), np.full(2, 20.0), 2.0))
    ground = _ground(xyz[xyz[:, 0] > 0.0], bev, slope_of(bev))
    assert np.array_equal(np.isfinite(ground), bev.count > 0)
    filled = bev.count > 0
    assert (ground[filled] >= bev.low[filled] - 1e-6).all()
    _, step = overlap_of(xyz, xyz + [500.0, 0.0, 0.0]).ground_steps()
    assert len(step) == 0


def test_grounds_of_one_place_have_one_shape_and_of_two_places_have_not() -> None:
    source, target = hillside(1, 0.1), hillside(2, 0.1)
    same = overlap_of(source, target).common_ground().shape()
    assert same.blocks > 50
    assert same.spread_m < 0.05
    assert same.relief_m > 5 * same.spread_m
    assert 0.0 < same.noise_m < 0.05
    # the slope falls alike everywhere, and is no sign of one place: what rolls on it is
    moved = source + [31.0, 17.0, 3.1]
    other = overlap_of(moved, target).common_ground().shape()
    assert other.spread_m > 0.7 * other.relief_m
    assert other.spread_m > 12.0 * other.noise_m


def test_noise_of_the_ground_explains_the_spread_under_the_right_place_alone() -> None:
    rng = np.random.default_rng(8)
    xy = rng.uniform(-60.0, 60.0, (6000, 2))
    low = 0.4 * np.sin(xy[:, 0] / 20.0)
    noisy = low + rng.normal(scale=0.05, size=len(xy))
    right = CommonGround(xy, low, noisy, 1.0).shape()
    assert right.spread_m == pytest.approx(right.noise_m, rel=0.3)
    # terrain that fits by chance, to a fifth of its relief
    similar = CommonGround(xy, low, noisy + 0.08 * np.sin(xy[:, 1] / 20.0), 1.0).shape()
    assert similar.spread_m > 4.0 * similar.noise_m


def test_too_little_ground_has_no_shape() -> None:
    few = hillside(3, 0.0, 200, 8.0)
    assert not np.isfinite(overlap_of(few, few).common_ground().shape().spread_m)


def test_an_overlap_of_many_kilometres_takes_larger_cells() -> None:
    rng = np.random.default_rng(11)
    wide = 20_000.0
    xy = rng.uniform(0.0, wide, (3000, 2))
    xyz = np.column_stack([xy, 30.0 * np.sin(xy[:, 0] / 900.0)])
    overlap = overlap_of(xyz, xyz + [0.0, 0.0, 0.3])
    assert overlap.grid.cell > OVERLAP_CELL_M
    assert overlap.grid.width * overlap.grid.height <= MOST_OVERLAP_CELLS
    assert overlap.select(xyz).mean() > 0.99
    assert np.median(overlap.ground_steps()[1]) == pytest.approx(0.3, abs=1e-5)
    # clouds of that size that share a corner only keep their cells
    corner = overlap_of(xyz, xyz + [wide - 500.0, wide - 500.0, 0.0])
    assert corner.grid.cell == OVERLAP_CELL_M
