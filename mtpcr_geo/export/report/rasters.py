"""Rasters as a report draws them: on one grid, small gaps closed, cut to where it matters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Floats, Image, Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.export import drawing
from mtpcr_geo.method.bev import coarsen

_BLOCK_CELLS = 8
_NEARLY = 0.15  # a few cells more may be empty before others are joined
_FILLED_SHARE = 0.7
_DENSE_SHARE = 0.85
_LEAST_WEIGHT = 0.02
_OUTSIDE = -0.4  # a window at the edge of the overlap shows the less of it
_WINDOW_CELLS = 160
_LEAST_WINDOW_CELLS = 40


def readable(bev: Bev, share: float = _FILLED_SHARE, most_cells: int = 4096) -> Bev:
    """Join cells until most within the cloud's outline are filled.

    Args:
        bev: a raster.
        share: of the cells within the outline that shall be filled, 0 to 1.
        most_cells: cells along the longer side at most.

    """
    return coarsen(bev, joined_cells(bev, share, most_cells))


def joined_cells(bev: Bev, share: float = _FILLED_SHARE, most_cells: int = 4096) -> int:
    """Return how many cells `readable` joins along each side."""
    blocks = int((coarsen(bev, _BLOCK_CELLS).count > 0).sum())
    filled = float((bev.count > 0).sum()) / max(1, blocks * _BLOCK_CELLS**2)
    # by Poisson's law for points spread at random
    per_cell = -math.log1p(-min(max(filled, 1e-4), 1.0 - 1e-4))
    to_fill = math.sqrt(-math.log1p(-share) / per_cell)
    return max(1, math.ceil(to_fill - _NEARLY), -(-max(bev.grid.shape) // most_cells))


def closed(top: Image) -> Image:
    """Fill gaps of a few cells with the mean of their neighbours; what lies outside the outline stays empty.

    Args:
        top: (h, w) heights, NaN where empty.

    """
    z = np.array(top, np.float32)
    filled = np.isfinite(z)
    if filled.all() or not filled.any():
        return z
    mask = closed_mask(filled)
    middle = np.float32(np.median(z[filled]))
    for sigma in (0.8, 1.6, 3.2):
        gap = mask & ~np.isfinite(z)
        if not gap.any():
            break
        weight = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        total = cv2.GaussianBlur(
            np.where(filled, top - middle, 0).astype(np.float32),
            (0, 0),
            sigma,
            borderType=cv2.BORDER_CONSTANT,
        )
        gap &= weight > _LEAST_WEIGHT
        z[gap] = total[gap] / weight[gap] + middle
    return z


def even(top: Image) -> Image:
    """Close small gaps, and even out heights over about a cell where many cells are empty."""
    z = closed(top)
    filled = np.isfinite(z)
    if not filled.any() or float(np.isfinite(top).sum()) > _DENSE_SHARE * float(filled.sum()):
        return z
    middle = np.float32(np.median(z[filled]))
    weight = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), 0.7)
    total = cv2.GaussianBlur(np.where(filled, z - middle, 0).astype(np.float32), (0, 0), 0.7)
    return np.where(filled, total / np.maximum(weight, 1e-6) + middle, np.float32(np.nan)).astype(np.float32)


def closed_mask(filled: Mask) -> Mask:
    """Return a mask with its gaps closed: those of two cells, of four where many are empty.

    Args:
        filled: (h, w).

    """
    near = cv2.dilate(filled.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    share = float(filled.sum()) / max(int(near.sum()), 1)
    radius = 1 if share > _DENSE_SHARE else 2
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    # at the border the outside counts as empty
    padded = np.pad(filled.astype(np.uint8), 2 * radius)
    joined = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[
        2 * radius : -2 * radius, 2 * radius : -2 * radius
    ]
    return np.asarray(filled | (joined > 0))


def smooth_larger(top: Image, factor: int) -> Image:
    """Return heights at a whole number of times the resolution, bicubic."""
    if factor <= 1:
        return top
    filled = np.isfinite(top)
    middle = drawing.middle_height(top, filled)
    size = (top.shape[1] * factor, top.shape[0] * factor)
    weight = cv2.resize(filled.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    total = cv2.resize(np.where(filled, top - middle, np.float32(0.0)), size, interpolation=cv2.INTER_CUBIC)
    z = np.full(weight.shape, np.nan, np.float32)
    held = weight > 0.5
    z[held] = total[held] / weight[held] + middle
    return z


@dataclass(frozen=True)
class Window:
    """A part of a grid.

    Attributes:
        rows, columns: of the grid.

    """

    rows: slice
    columns: slice

    def of(self, bev: Bev) -> Bev:
        """Return that part of a raster."""
        part = (self.rows, self.columns)
        return Bev(bev.grid.part(*part), bev.top[part], bev.low[part], bev.count[part])

    def middle(self, grid: Grid) -> Floats:
        """Return its middle, (2,) metres."""
        part = grid.part(self.rows, self.columns)
        return np.array([part.west + part.width * part.cell / 2, part.north - part.height * part.cell / 2])


def structure(source: Bev, target: Bev) -> Image:
    """Return how much each cell of one grid tells whether both rasters fit: (h, w), 0 where not both see it.

    It is the smaller of both height steps, and a little for any cell that both fill.
    """
    both = np.isfinite(source.top) & np.isfinite(target.top)
    near = np.ones((3, 3), np.uint8)
    steps = [cv2.dilate(drawing.step_edges(bev.top), near) for bev in (source, target)]
    return np.asarray(np.where(both, 0.15 + np.minimum(*steps), 0.0), np.float32)


def best_window(weight: Image, side: int) -> Window:
    """Return the square window of a raster in which the sum of the weights is largest.

    Args:
        weight: (h, w).
        side: cells along each side; less where the raster is smaller.

    """
    height, width = (min(side, size) for size in weight.shape)
    sums = cv2.integral(weight.astype(np.float64))
    total = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    row, column = (int(k) for k in np.unravel_index(int(total.argmax()), total.shape))
    return Window(slice(row, row + height), slice(column, column + width))


def telling_window(source: Bev, target: Bev) -> Window:
    """Return the part of the overlap in which one sees best whether both rasters fit.

    Args:
        source, target: on one grid.

    """
    shared = closed_mask(np.isfinite(source.top)) & closed_mask(np.isfinite(target.top))
    # half of a small overlap still shows its middle enlarged
    side = int(np.clip(math.sqrt(float(shared.sum())) * 0.6, _LEAST_WINDOW_CELLS, _WINDOW_CELLS))
    return best_window(np.where(shared, structure(source, target), _OUTSIDE), side)


def windows_of(
    shared: Mask, weight: Image, side: int, most: int = 24, least_filled: float = 0.7
) -> list[Window]:
    """Return squares of a raster that do not overlap and that both clouds fill, those that tell most first.

    Args:
        shared: (h, w) cells that both fill.
        weight: (h, w) how much each tells.
        side: cells along each side.
        most: squares at most.
        least_filled: share of a square that is filled.

    """
    if min(shared.shape) < side:
        return []
    sums = [cv2.integral(part.astype(np.float64)) for part in (shared, weight)]
    filled, told = (
        (total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side])
        for total in sums
    )
    told = np.where(filled >= least_filled * side * side, told, 0.0)
    found: list[Window] = []
    while len(found) < most and told.max() > 0:
        row, column = (int(k) for k in np.unravel_index(int(told.argmax()), told.shape))
        found.append(Window(slice(row, row + side), slice(column, column + side)))
        told[max(row - side + 1, 0) : row + side, max(column - side + 1, 0) : column + side] = 0.0
    return found
