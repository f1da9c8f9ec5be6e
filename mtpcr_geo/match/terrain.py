"""The shape of the ground as evidence: where things repeat, the terrain beneath them rarely does.

The band-passed channels of the correlation leave the terrain out, since canopy and roofs hide parts of it and
two levellings may differ. Here lowest heights in coarse cells are compared after one shift in height, or one
plane where a vertical is not trusted, to judge any pose; `terrain_search` finds poses by them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Image, median
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.method.bev import coarsen

NOISE_M = 0.1
"""Spread of the ground's height differences below which cells, borders and noise leave nothing to compare."""
FEWEST_CELLS = 8
FEWEST_OF_MEDIAN = 4
FINER_PARTS = (8, 4, 2)
LEAST_SEEN, LEAST_PART = 0.1, 0.2
"""Parts of the terrain's cell in which grounds may be compared, finest first; the share of the ground's area
that must show in them; and the part of the fewest cells' area that they must show under a pose."""
MOST_CELLS = 10_000
"""Cells of the source that are compared at most: every so many-th of more."""
CELLS_OF_PLANE = 1_000
"""Of these, how many tell how each ground varies beside its own plane."""
KNOWN = 0.99
"""Weight of filled cells above which an interpolated height is one of the ground alone."""


@dataclass(frozen=True)
class Terrain:
    """Lowest heights in coarse cells.

    Attributes:
        grid: where they lie, metres.
        low: (h, w) float32 metres about their median, 0 where empty.
        mask: (h, w) float32, 1 where filled.

    """

    grid: Grid
    low: Image
    mask: Image

    @cached_property
    def compared(self) -> tuple[Floats, NDArray[np.float32]]:
        """Places of the cells that are compared with another ground, (n, 2) metres, and heights, (n,)."""
        row, column = np.nonzero(self.mask)
        every = _every(len(row))
        row, column = row[::every], column[::every]
        return self.grid.to_metres(np.column_stack([column, row]).astype(np.float64)), self.low[row, column]

    @classmethod
    def of(cls, bev: Bev, cell_m: float) -> Terrain:
        """Make it of a height raster of the bare ground, in cells of about ``cell_m`` metres."""
        coarse = coarsen(bev, max(1, round(cell_m / bev.grid.cell)))
        filled = coarse.count > 0
        middle = np.median(coarse.low[filled]) if filled.any() else np.float32(0.0)
        low = np.where(filled, coarse.low - middle, np.float32(0.0)).astype(np.float32)
        return cls(coarse.grid, low, filled.astype(np.float32))

    def smoothed(self) -> Terrain:
        """Return medians of 3 x 3 cells: brush, holes and the feet of walls are left out of the shape.

        Cells with fewer than `FEWEST_OF_MEDIAN` filled ones about them, themselves included, are left empty.
        """
        padded = np.pad(np.where(self.mask > 0, self.low, np.float32(np.nan)), 1, constant_values=np.nan)
        height, width = self.low.shape
        near = [padded[i : i + height, j : j + width] for i, j in product(range(3), repeat=2)]
        # empty cells are sorted behind all others
        ordered = np.sort(np.stack(near), axis=0)
        seen = np.isfinite(ordered).sum(axis=0)
        kept = (self.mask > 0) & (seen >= FEWEST_OF_MEDIAN)
        halves = [np.take_along_axis(ordered, np.maximum(seen - k, 0)[None] // 2, axis=0)[0] for k in (0, 1)]
        low = np.where(kept, (halves[0] + halves[1]) / 2, np.float32(0.0))
        return Terrain(self.grid, low.astype(np.float32), kept.astype(np.float32))


@dataclass(frozen=True)
class GroundSpread:
    """How far the shapes of both grounds differ under a pose.

    Attributes:
        cells: cells compared, of `MOST_CELLS` of the source at most.
        spread_m: robust standard deviation of their height differences, after one shift or one plane.
        fewest: cells that are ground enough to compare.

    """

    cells: int
    spread_m: float
    fewest: int = FEWEST_CELLS

    @property
    def known(self) -> bool:
        """Whether there was enough ground to compare."""
        return self.cells >= self.fewest


@dataclass(frozen=True)
class GroundComparison(GroundSpread):
    """How the shapes of both grounds compare under a pose: how far they differ, and how far they could.

    Attributes:
        relief_m: what the spread would be if neither ground told anything of the other: their own spreads in
            the cells compared, added in squares.
        beyond_plane_m: the same of what is left of each ground beside its own plane.

    """

    relief_m: float = 0.0
    beyond_plane_m: float = 0.0


def cell_to_compare(source: Bev, target: Bev, coarsest_m: float) -> float:
    """Return the finest cell in which both clouds still see ground together, metres.

    The finer the cells, the less of a slope, and of what hides the ground, lies within one. In cells too fine
    for a thin cloud no ground lies beside other ground.

    Args:
        source, target: height rasters of the bare ground.
        coarsest_m: cell that is taken if no finer one will do.

    """
    wide = [float(Terrain.of(bev, coarsest_m).mask.sum()) * coarsest_m**2 for bev in (source, target)]
    for parts in FINER_PARTS:
        cell = coarsest_m / parts
        if cell < source.grid.cell:
            continue
        masks = [Terrain.of(bev, cell).mask for bev in (source, target)]
        areas = [float(cv2.erode(mask, np.ones((2, 2), np.uint8)).sum()) * cell**2 for mask in masks]
        if all(area >= LEAST_SEEN * most for area, most in zip(areas, wide, strict=True)):
            return cell
    return coarsest_m


def fewest_of(cell_m: float, coarsest_m: float) -> int:
    """Return how many cells are ground enough to compare: a part of the area of `FEWEST_CELLS` coarse ones.

    Args:
        cell_m: edge of a cell, metres.
        coarsest_m: edge of a cell of the terrain, metres.

    """
    return max(FEWEST_CELLS, int(np.ceil(FEWEST_CELLS * LEAST_PART * (coarsest_m / cell_m) ** 2)))


def compare_ground(
    source: Terrain,
    target: Terrain,
    hypothesis: Hypothesis,
    *,
    plane: bool = False,
    fewest: int = FEWEST_CELLS,
) -> GroundComparison:
    """Compare the shape of both grounds under a pose.

    Args:
        source, target: both terrains.
        hypothesis: the pose.
        fewest: cells that are ground enough to compare.
        plane: remove the best plane of the differences, for clouds whose vertical is not trusted; else
            their median alone.

    """
    places, heights = _common_heights(source, target, hypothesis)
    found = _spread_of(source, places, heights, plane=plane, fewest=fewest)
    if found.cells < FEWEST_CELLS:
        return GroundComparison(found.cells, found.spread_m, found.fewest)
    some = slice(None, None, -(-found.cells // CELLS_OF_PLANE))
    own, other = (_spread(_without_plane(places[some], one[some])) for one in heights)
    beyond_plane = relief = float(np.hypot(own, other))
    if not _takes_plane(found.cells, plane):
        own, other = (_spread(one) for one in heights)
        relief = float(np.hypot(own, other))
    return GroundComparison(found.cells, found.spread_m, found.fewest, relief, beyond_plane)


def ground_spread(
    source: Terrain, target: Terrain, hypothesis: Hypothesis, *, plane: bool = False
) -> GroundSpread:
    """Return how far both grounds differ under a pose, and nothing else of `compare_ground`.

    Args:
        source, target: both terrains.
        hypothesis: the pose.
        plane: see `compare_ground`.

    """
    return _spread_of(source, *_common_heights(source, target, hypothesis), plane=plane)


def _spread_of(
    source: Terrain, places: Floats, heights: list[Floats], *, plane: bool, fewest: int = FEWEST_CELLS
) -> GroundSpread:
    """Return how far (n,) heights of both grounds differ at (n, 2) places."""
    cells = len(places)
    fewest = max(FEWEST_CELLS, -(-fewest // _every(int(np.count_nonzero(source.mask)))))
    if cells < FEWEST_CELLS:
        return GroundSpread(cells, np.inf, fewest)
    step = heights[1] - heights[0]
    return GroundSpread(
        cells, _spread(_without_plane(places, step) if _takes_plane(cells, plane) else step), fewest
    )


def _takes_plane(cells: int, plane: bool) -> bool:
    """Return whether a plane that is free is taken from so many cells: of a few it would leave nothing."""
    return plane and cells >= 3 * FEWEST_CELLS


def _every(cells: int) -> int:
    """Return which of the cells of a source are compared: every so many-th."""
    return max(1, -(-cells // MOST_CELLS))


def _common_heights(source: Terrain, target: Terrain, hypothesis: Hypothesis) -> tuple[Floats, list[Floats]]:
    """Return where both grounds are seen under a pose, (n, 2), and their heights there, (n,) each."""
    xy, own = source.compared
    c, s = np.cos(hypothesis.yaw), np.sin(hypothesis.yaw)
    placed = xy @ np.array([[c, s], [-s, c]]) + hypothesis.shift
    px = target.grid.to_pixel(placed).astype(np.float32)
    x, y = px[:, :1], px[:, 1:]
    known = cv2.remap(target.mask, x, y, cv2.INTER_LINEAR)[:, 0] > KNOWN
    height = cv2.remap(target.low, x, y, cv2.INTER_LINEAR)[:, 0]
    return placed[known], [one[known].astype(np.float64) for one in (own, height)]


def ground_closeness(
    source: Terrain, target: Terrain, hypothesis: Hypothesis, *, plane: bool = False
) -> float:
    """Return how much less both grounds differ under a pose than they vary there, for the cells they share.

    Args:
        source, target: both terrains.
        hypothesis: the pose.
        plane: see `compare_ground`.

    Returns:
        The root of their number times the logarithm of the ratio of both robust spreads; minus infinity where
        they share too few.

    """
    places, heights = _common_heights(source, target, hypothesis)
    if len(places) < FEWEST_CELLS:
        return -np.inf
    if _takes_plane(len(places), plane):
        heights = [_without_plane(places, one) for one in heights]
    own, other = heights
    relief = float(np.hypot(_spread(own), _spread(other))) + NOISE_M / 2
    return float(np.sqrt(len(places)) * np.log(relief / (_spread(other - own) + NOISE_M / 2)))


def _spread(height: Floats) -> float:
    """Return the robust spread of (n,) heights about their median."""
    return 1.4826 * median(np.abs(height - median(height)))


def _without_plane(xy: Floats, height: Floats) -> Floats:
    """Take the best plane from (n,) heights at (n, 2) places, outliers weighed down."""
    centred = xy - xy.mean(axis=0)
    # scaled to one, so that the normal equations stay well conditioned
    A = np.column_stack([np.ones(len(xy)), centred / max(float(np.abs(centred).max()), 1e-9)])
    weight = np.ones(len(xy))
    rest = height
    for _ in range(4):
        W = A * weight[:, None] ** 2
        rest = height - A @ np.linalg.lstsq(W.T @ A, W.T @ height, rcond=None)[0]
        scale = max(1.4826 * median(np.abs(rest)), NOISE_M)
        weight = 1.0 / (1.0 + (rest / (2.0 * scale)) ** 2)
    return np.asarray(rest)
