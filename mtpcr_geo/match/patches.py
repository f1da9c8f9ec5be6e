"""Local matches: where each patch of the posed source fits best on the target, to a fraction of a cell."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.match.pose import Pose, source_from_target_pixels, warp_to
from mtpcr_geo.match.search import FILLED, Layer, correlation_score


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
        before = (max(-top, 0), max(-left, 0))
        after = (
            bottom - top - before[0] - part.shape[0],
            right - left - before[1] - part.shape[1],
        )
        return np.pad(part, ((before[0], after[0]), (before[1], after[1])))

    m = cut(mask, 0)
    a, e = cut(warped[0] * mask, 0), cut(warped[1] * mask, 0)
    A, E, M = (cut(channel, window) for channel in stack)
    side = 2 * window + 1
    shape = (height // stride - 1, width // stride - 1)
    sums = np.empty((7, side * side, shape[0] * shape[1]), np.float32)
    aa, ee, AA, EE = a * a, e * e, A * A, E * E

    def sum_rows(dy: int) -> None:
        """Fill in the sums of all shifts by so many rows."""
        products = np.empty((7, height, width), np.float32)
        for dx in range(side):
            place = (slice(dy, dy + height), slice(dx, dx + width))
            Mp = M[place]
            pairs = (
                (m, Mp), (a, A[place]), (e, E[place]), (aa, Mp), (ee, Mp), (m, AA[place]), (m, EE[place])
            )  # fmt: skip
            for product, (one, other) in zip(products, pairs, strict=True):
                np.multiply(one, other, out=product)
            sums[:, dy * side + dx] = _patch_sums(products, stride).reshape(7, -1)

    with ThreadPoolExecutor(usable_cores()) as threads:
        list(threads.map(sum_rows, range(side)))
    overlap = sums[0]
    values = correlation_score(overlap, (sums[1], sums[2]), (sums[3], sums[4]), (sums[5], sums[6]))
    score = (values / np.sqrt(np.maximum(overlap, 1.0)) / 2).reshape(side, side, *shape)
    fill = overlap.reshape(side, side, *shape)
    enough = fill[window, window] >= min_fill * (2 * stride) ** 2
    flat = score.reshape(side * side, *shape)
    best = np.argmax(flat, axis=0)
    by, bx = best // side, best % side
    inside = (by > 0) & (by < side - 1) & (bx > 0) & (bx < side - 1)
    peak = np.take_along_axis(flat, best[None], axis=0)[0]
    keep = enough & inside & (peak >= min_score)
    iy, ix = np.nonzero(keep)
    by, bx = by[keep], bx[keep]
    sub_y = _parabola(score[by - 1, bx, iy, ix], score[by, bx, iy, ix], score[by + 1, bx, iy, ix])
    sub_x = _parabola(score[by, bx - 1, iy, ix], score[by, bx, iy, ix], score[by, bx + 1, iy, ix])
    centre = np.stack([column0 + (ix + 1) * stride - 0.5, row0 + (iy + 1) * stride - 0.5], axis=1)
    move = np.stack([bx - window + sub_x, by - window + sub_y], axis=1)
    M23 = source_from_target_pixels(source.grid, grid, pose)
    return PatchMatches(
        source_px=centre @ M23[:, :2].T + M23[:, 2],
        target_px=centre + move,
        score=peak[keep].astype(np.float64),
        moved=move * [grid.cell, -grid.cell],
        patches=int(enough.sum()),
    )


def _patch_sums(images: Image, stride: int) -> Image:
    """Sum (k, h, w) images over patches of 2 x stride cells, one every stride cells."""
    count, height, width = images.shape
    rows, columns = height // stride, width // stride
    strips = np.add.reduce(images.reshape(count, rows, stride, width), axis=2)
    blocks = np.add.reduce(strips.reshape(count, rows, columns, stride), axis=3)
    across = blocks[:, :, :-1] + blocks[:, :, 1:]
    return np.asarray(across[:, :-1] + across[:, 1:])


def _parabola(before: Image, at: Image, after: Image) -> Floats:
    """Place of the vertex of the parabola through three neighbouring scores, -0.5..0.5 cells."""
    bend = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = 0.5 * (before - after) / bend
    return np.where(bend < 0, np.clip(np.nan_to_num(vertex), -0.5, 0.5), 0.0).astype(np.float64)


def _nothing() -> PatchMatches:
    none = np.empty((0, 2))
    return PatchMatches(none, none, np.empty(0), none, 0)
