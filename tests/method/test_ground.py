"""Which cells show the ground: halls, houses, far crowns and pits do not, slopes, ridges and floors do."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.method.ground import connected_ground, ground_cells

SIDE = 160


def plane(east: float = 0.0, north: float = 0.0) -> np.ndarray:
    y, x = np.mgrid[0:SIDE, 0:SIDE].astype(np.float32)
    return (np.float32(east) * x - np.float32(north) * y).astype(np.float32)


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.25])
@pytest.mark.parametrize("half", [2, 6, 18])
def test_a_building_on_any_slope_is_no_ground(slope: float, half: int) -> None:
    low = plane(slope)
    roof = (slice(80 - half, 80 + half), slice(80 - half, 80 + half))
    # a flat roof whose eaves stand well above the ground on the upper side too
    low[roof] = low[roof].max() + np.float32(6.0 + 24.0 * slope)
    ground = ground_cells(low, 1.0)
    assert not ground[roof].any()
    assert ground.mean() > 0.9 * (1.0 - (2 * half) ** 2 / SIDE**2)


@pytest.mark.parametrize("slope", [0.05, 0.3, 0.6])
def test_hillsides_and_ridges_are_ground(slope: float) -> None:
    x = np.arange(SIDE, dtype=np.float32)[None] * np.ones((SIDE, 1), np.float32)
    ridge = (-np.float32(slope) * np.abs(x - SIDE / 2)).astype(np.float32)
    assert ground_cells(plane(slope, -slope), 1.0).mean() > 0.97
    # of a sharp crest some metres may go
    assert ground_cells(ridge, 1.0).mean() > 0.9


def test_empty_cells_are_no_ground_and_heights_may_be_large() -> None:
    low = plane(0.02) + np.float32(4000.0)
    low[:, 100:] = np.nan
    ground = ground_cells(low, 1.0)
    assert ground[:, :100].all()
    assert not ground[:, 100:].any()
    assert not ground_cells(np.full((5, 5), np.nan, np.float32), 1.0).any()


def test_a_strip_narrower_than_the_windows_is_still_told_apart() -> None:
    low = plane()[:12]
    low[4:8, 60:64] = 3.0
    ground = ground_cells(low, 1.0)
    assert not ground[4:8, 60:64].any()
    assert ground[:, :50].all()


def seen_from_a_street(slope: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest heights as a scanner on the ground has them, and where crowns stand apart.

    A street seen well, and beyond it nothing but far crowns, of which only what is above 6 m is seen.
    """
    rng = np.random.default_rng(4)
    low = np.full((SIDE, SIDE), np.nan, np.float32)
    low[70:95] = plane(slope)[70:95] + rng.normal(0.0, 0.03, (25, SIDE)).astype(np.float32)
    crowns = np.zeros(low.shape, bool)
    for row, column in ((20, 30), (30, 110), (130, 60), (140, 130)):
        block = slice(row, row + 8), slice(column, column + 8)
        crowns[block] = True
        low[block] = plane(slope)[block] + rng.uniform(6.0, 14.0, (8, 8)).astype(np.float32)
    return low, crowns


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_crowns_that_stand_apart_are_no_ground(slope: float) -> None:
    low, crowns = seen_from_a_street(slope)
    opened = ground_cells(low, 0.5)
    # nothing lower is near
    assert opened[crowns].any()
    given = opened.copy()
    ground = connected_ground(low, opened, 0.5)
    assert np.array_equal(opened, given), "what is given is changed"
    assert not ground[crowns].any()
    assert ground[70:95].mean() > 0.98
    assert not (ground & ~opened).any()


def test_ground_that_stands_apart_is_ground() -> None:
    low, _ = seen_from_a_street(0.1)
    yard = slice(100, 112), slice(40, 52)
    rng = np.random.default_rng(5)
    seen = rng.random((12, 12)) < 0.3
    low[yard] = np.where(seen, plane(0.1)[yard], np.float32(np.nan))
    ground = connected_ground(low, ground_cells(low, 0.5), 0.5)
    assert ground[yard][seen].all()


@pytest.mark.parametrize("below", [(95, slice(None)), (80, slice(None, None, 60))], ids=["walls", "pits"])
def test_what_lies_below_a_street_is_no_ground(below: tuple[int, slice]) -> None:
    """Feet of walls in light wells along its edge, or single echoes from below."""
    low, _ = seen_from_a_street()
    low[95] = plane(0.02)[95]
    low[below] -= np.float32(2.0)
    opened = ground_cells(low, 0.5)
    given = opened.copy()
    ground = connected_ground(low, opened, 0.5)
    assert np.array_equal(opened, given), "what is given is changed"
    assert opened[below].any()
    assert not ground[below].any()
    assert ground[70:94].mean() > 0.95


def test_the_floor_of_a_forest_stays() -> None:
    """Few cells reach the floor; the others end in brush, of which an opening leaves what is low."""
    rng = np.random.default_rng(6)
    floor = plane(0.15, 0.1)
    reached = rng.random(floor.shape) < 0.15
    low = np.where(reached, floor, floor + rng.uniform(0.3, 9.0, floor.shape)).astype(np.float32)
    opened = ground_cells(low, 0.5)
    ground = connected_ground(low, opened, 0.5)
    assert ground[reached].mean() > 0.98 * opened[reached].mean()
    assert opened[reached].mean() > 0.9


@pytest.mark.parametrize("slope", [0.05, 0.3, 0.6])
def test_hillsides_stay_connected(slope: float) -> None:
    low = plane(slope, -slope / 2)
    assert connected_ground(low, ground_cells(low, 1.0), 1.0).mean() > 0.97


def test_no_ground_is_connected_to_none() -> None:
    low = np.full((9, 9), np.nan, np.float32)
    assert not connected_ground(low, ground_cells(low, 0.5), 0.5).any()
    # one cell is all there is
    low[4, 4] = 3.0
    assert connected_ground(low, ground_cells(low, 0.5), 0.5)[4, 4]
