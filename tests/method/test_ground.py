"""Which cells show the ground: halls, houses and crowns do not, slopes and ridges do."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.method.ground import ground_cells

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
