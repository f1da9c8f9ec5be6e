"""Where discs are cut: places that hold points, chosen from a coarse map of occupied cells."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mtpcr_geo.benchmark.simulator.overlap import occupied_cells
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import InputError

CELL_M = 4.0
REACH_CELLS = 4
"""A place is judged by the occupied cells within so many cells (16 m) of it."""
FULL = 0.85
"""Places as full as this share of the fullest one are taken alike."""


def shared_places(source: Floats, target: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Choose places about which both clouds have points.

    Args:
        source: (n, 2 or 3) metres, where it truly lies.
        target: (m, 2 or 3) metres, in the same frame.
        count: of places; far from one another as far as the shared ground allows.
        rng: of the choice.

    Returns:
        (count, 2) metres.

    Raises:
        InputError: if the clouds share nothing.

    """
    maps, low = _maps(source, target)
    if not (maps[0] & maps[1]).any():
        raise InputError("the clouds share no ground to cut a disc from")
    return _chosen(maps[0] & maps[1], low, count, rng)


def dense_places(source: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Choose places about which one cloud has points; as `shared_places`."""
    maps, low = _maps(source)
    return _chosen(maps[0], low, count, rng)


def _maps(*clouds: Floats) -> tuple[list[Mask], Floats]:
    """Return a map of each cloud's occupied cells on one grid, rows along y, and its first cell's number."""
    cells = [occupied_cells(cloud, CELL_M) for cloud in clouds]
    low = np.min([c.min(axis=0) for c in cells], axis=0)
    columns, rows = np.max([c.max(axis=0) for c in cells], axis=0) - low + 1
    maps = []
    for c in cells:
        image = np.zeros((rows, columns), bool)
        image[c[:, 1] - low[1], c[:, 0] - low[0]] = True
        maps.append(image)
    return maps, low


def _chosen(full: Mask, low: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Draw the first place at random among the full ones, and each other far from those before it."""
    axis = np.arange(-REACH_CELLS, REACH_CELLS + 1)
    near = np.hypot(*np.meshgrid(axis, axis)) <= REACH_CELLS
    fullness = ndimage.convolve(full.astype(float), near.astype(float), mode="constant") / near.sum()
    rows, columns = np.nonzero(full & (fullness >= FULL * fullness[full].max()))
    xy = (np.stack([columns, rows], axis=1) + low + 0.5) * CELL_M
    chosen = [xy[rng.integers(len(xy))]]
    while len(chosen) < count:
        away = np.min([np.hypot(*(xy - one).T) for one in chosen], axis=0)
        far = np.flatnonzero(away >= 0.6 * away.max())
        chosen.append(xy[far[rng.integers(len(far))]])
    return np.array(chosen)
