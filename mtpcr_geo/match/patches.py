"""Local matches: where each patch of the posed source fits best on the target, to a fraction of a cell."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.match.pose import Pose, source_from_target_pixels, warp_to
from mtpcr_geo.match.search import FILLED, Layer, correlation_score

CELLS_AT_ONCE = 100_000
"""Cells of the source whose products are summed at once."""
PATCHES_AT_ONCE = 20_000


@dataclass(frozen=True)
class PatchMatches:
    """Patches and where they went.

    Attributes:
        source_px, target_px: (n, 2) matched positions in both rasters, pixels.
        score: (n,) mean of both channels' normalised correlation at the peak, -1..1.
        moved: (n, 2) metres by which each patch moved from where the pose had put it, east and north.
        patches: number of patches that held enough cells to be tried.

    """

    source_px: Floats
    target_px: Floats
    score: Floats
    moved: Floats
    patches: int

    def __len__(self) -> int:
        return len(self.score)


def match_patches(
    source: Layer,
    target: Layer,
    pose: Pose,
    *,
    window: int,
    stride: int,
    min_fill: float = 0.25,
    min_score: float = 0.15,
) -> PatchMatches:
    """Match square patches of 2 x ``stride`` cells around a pose.

    Args:
        source, target: fine layers of one cell size.
        pose: where the source is thought to lie.
        window: how far a patch may move, cells. A best place on the window's rim is no peak and is dropped.
        stride: distance between patches, cells.
        min_fill: share of a patch's cells that must be filled in both rasters.
        min_score: patches scoring less are dropped.

    """
    grid = target.grid
    stack = target.channels.stack
    warped = warp_to(source.channels.stack, source.grid, grid, pose)
    mask = (warped[2] > FILLED).astype(np.float32)
    # outside of what a patch can reach of the target, no shift compares anything
    reach = cv2.dilate(stack[2], np.ones((2 * window + 1, 2 * window + 1), np.uint8))
    both = (mask > 0) & (reach > 0)
    rows, columns = np.flatnonzero(both.any(axis=1)), np.flatnonzero(both.any(axis=0))
    if not len(rows):
        return _nothing()
    row0, column0 = int(rows[0]), int(columns[0])
    height = -(-(int(rows[-1]) + 1 - row0) // stride) * stride
    width = -(-(int(columns[-1]) + 1 - column0) // stride) * stride
    if min(height, width) < 2 * stride:
        return _nothing()

    def cut(image: Image, margin: int) -> Image:
        """Cut the working part with a margin on every side, filled with emptiness beyond the raster."""
        top, left = row0 - margin, column0 - margin
        bottom, right = row0 + height + margin, column0 + width + margin
        part = image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
        whole = np.zeros((bottom - top, right - left), image.dtype)
        row, column = max(-top, 0), max(-left, 0)
        whole[row : row + part.shape[0], column : column + part.shape[1]] = part
        return whole

    m = cut(mask, 0)
    A, E, M = (cut(channel, window) for channel in stack)
    side = 2 * window + 1
    blocks = height // stride, width // stride
    images = (m, cut(warped[0] * mask, 0), cut(warped[1] * mask, 0))
    sums = _sums_of_blocks(images, (M, A, E), blocks, stride, window)
    # a patch is four blocks; of a patch with too few cells where it lies nothing is asked
    rows, columns = np.indices((blocks[0] - 1, blocks[1] - 1)).reshape(2, -1)
    corner = rows * blocks[1] + columns
    fill = _of_patches(sums[0, window * side + window], corner, blocks[1])
    corner = corner[fill >= min_fill * (2 * stride) ** 2]
    peaks = [
        _peaks(_of_patches(sums, some, blocks[1]), side)
        for some in np.array_split(corner, -(-len(corner) // PATCHES_AT_ONCE) or 1)
    ]
    peak, by, bx = (np.concatenate(parts) for parts in zip(*peaks, strict=True))
    keep = peak >= min_score
    iy, ix = np.divmod(corner[keep], blocks[1])
    centre = np.stack([column0 + (ix + 1) * stride - 0.5, row0 + (iy + 1) * stride - 0.5], axis=1)
    move = np.stack([bx[keep] - window, by[keep] - window], axis=1)
    M23 = source_from_target_pixels(source.grid, grid, pose)
    return PatchMatches(
        source_px=centre @ M23[:, :2].T + M23[:, 2],
        target_px=centre + move,
        score=peak[keep].astype(np.float64),
        moved=move * [grid.cell, -grid.cell],
        patches=len(corner),
    )


def _sums_of_blocks(
    source: Sequence[Image], target: Sequence[Image], shape: tuple[int, int], stride: int, window: int
) -> Image:
    """Sum what a correlation is made of over square blocks side by side, for every shift of the target.

    Args:
        source: (h, w) mask, heights and step edges of the source.
        target: the same of the target, with a margin of ``window`` cells.
        shape: rows and columns of blocks.
        stride: edge of a block, cells.
        window: shifts up to so many cells either way.

    Returns:
        (7, shifts, blocks) sums, see `mtpcr_geo.match.search.correlation_score`; zeros where the source is
        empty.

    """
    side = 2 * window + 1
    sums = np.zeros((7, side * side, shape[0] * shape[1]), np.float32)
    filled = np.flatnonzero(source[0].reshape(shape[0], stride, shape[1], stride).any(axis=(1, 3)))
    parts = np.array_split(filled, -(-len(filled) * stride**2 // CELLS_AT_ONCE) or 1)

    def sum_part(some: NDArray[np.intp]) -> None:
        """Fill in the sums of some of the blocks."""
        rows, columns = np.divmod(some, shape[1])
        images = _blocks(source, rows * stride, columns * stride, stride)
        wider = _blocks(target, rows * stride, columns * stride, stride + 2 * window)
        sums[:, :, some] = _correlated(images, wider)

    if len(parts) == 1:
        sum_part(parts[0])
        return sums
    with ThreadPoolExecutor(usable_cores()) as threads:
        list(threads.map(sum_part, parts))
    return sums


def _blocks(images: Sequence[Image], row: NDArray[np.intp], column: NDArray[np.intp], size: int) -> Image:
    """Cut square blocks out of (h, w) images of one width.

    Args:
        images: k of them.
        row, column: (b,) first cells of the blocks.
        size: edge of a block, cells.

    Returns:
        (k, size, size, b): the blocks lie innermost, so that all of them are summed at once.

    """
    width = images[0].shape[1]
    cell = np.arange(size)[:, None] * width + np.arange(size)
    first = row * width + column
    return np.stack([np.take(image, cell[:, :, None] + first) for image in images])


def _correlated(source: Image, target: Image) -> Image:
    """Sum products over blocks, for all places of smaller blocks in larger ones.

    Args:
        source: (3, n, n, b) mask, heights and step edges.
        target: (3, n + s - 1, n + s - 1, b) the same.

    Returns:
        (7, s^2, b) sums.

    """
    size = source.shape[1]
    side = target.shape[1] - size + 1
    m, a, e = source
    M, A, E = target
    shifted = [sliding_window_view(there, size, axis=1) for there in (M, A, E, A * A, E * E)]
    pairs = tuple(
        zip((m, a, e, a * a, e * e, m, m), (shifted[k] for k in (0, 1, 2, 0, 0, 3, 4)), strict=True)
    )
    sums = np.empty((7, side, side, source.shape[3]), np.float32)
    for dy in range(side):
        for out, (one, other) in zip(sums[:, dy], pairs, strict=True):
            np.einsum("yxb,ydbx->db", one, other[dy : dy + size], out=out)
    return sums.reshape(7, side * side, -1)


def _of_patches(sums: Image, corner: NDArray[np.intp], columns: int) -> Image:
    """Sum (..., blocks) over patches of two by two blocks, whose first blocks are given."""
    first, last = sums[..., corner] + sums[..., corner + 1], corner + columns
    return np.asarray(first + (sums[..., last] + sums[..., last + 1]))


def _peaks(sums: Image, side: int) -> tuple[Image, Floats, Floats]:
    """Return the best score of each patch, minus infinity on the window's rim, and its row and column."""
    overlap = sums[0]
    values = correlation_score(overlap, (sums[1], sums[2]), (sums[3], sums[4]), (sums[5], sums[6]))
    score = values / np.sqrt(np.maximum(overlap, 1.0)) / 2
    best = np.argmax(score, axis=0)
    number = np.arange(score.shape[1])
    by, bx = np.divmod(best, side)
    inside = (by > 0) & (by < side - 1) & (bx > 0) & (bx < side - 1)
    best = np.where(inside, best, side + 1)
    at = score[best, number]
    up, down, left, right = (score[best + step, number] for step in (-side, side, -1, 1))
    return np.where(inside, at, -np.inf), by + _parabola(up, at, down), bx + _parabola(left, at, right)


def _parabola(before: Image, at: Image, after: Image) -> Floats:
    """Place of the vertex of the parabola through three neighbouring scores, -0.5..0.5 cells."""
    bend = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = 0.5 * (before - after) / bend
    return np.where(bend < 0, np.clip(np.nan_to_num(vertex), -0.5, 0.5), 0.0).astype(np.float64)


def _nothing() -> PatchMatches:
    none = np.empty((0, 2))
    return PatchMatches(none, none, np.empty(0), none, 0)
