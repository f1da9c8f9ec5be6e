"""Inverse mapping (Eq. 5): from matched pixels back to 3D tie points, with heights from the float rasters."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Bev, Matches, TiePoints
from mtpcr_geo.method.images import height_span
from mtpcr_geo.method.scales import block_for

Surface = Literal["ground", "top", "grey"]
Pixel = Literal["centre", "ceil", "printed"]

GROUND_RADIUS_M = 4.0


def inverse_mapping(px: Floats, bev: Bev, *, surface: Surface = "ground", pixel: Pixel = "centre") -> Floats:
    """Take pixels of a raster back to 3D (Eq. 5).

    Args:
        px: (n, 2) pixel coordinates (column, row), pixel centres at integers.
        bev: the raster, in levelled coordinates.
        surface: "ground" takes the lowest z around the pixel, which both clouds see under canopy and
            eaves; "top" takes the highest z of the cell; "grey" rounds that down to 255 steps of the
            raster's height range, as in the paper.
        pixel: "centre" puts a pixel at the centre of its cell; "ceil" at the north-east corner, which is
            Eq. 5 without the misprint (Y from j); "printed" takes Y from i, as printed, so that all points
            fall on one line. The last two suit rasters of the ceiling convention (Eq. 2 as printed).

    Returns:
        (n, 3) metres in the raster's frame; z is NaN where the raster is empty or the pixel lies outside.

    """
    grid = bev.grid
    px = np.asarray(px, np.float64)
    xy = grid.to_metres(px)
    if pixel != "centre":
        xy = xy + grid.cell / 2
    if pixel == "printed":
        # i and j count from the south-west cell, which holds the lowest x and y alone
        south_west = grid.to_metres(np.array([[0.0, grid.height - 1.0]]))[0] + grid.cell / 2
        xy[:, 1] = south_west[1] + (xy[:, 0] - south_west[0])
    column, row = (np.round(px[:, axis]).astype(np.int64) for axis in (0, 1))
    inside = grid.holds(column, row)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    z = (_lowest_around(bev) if surface == "ground" else bev.top)[row, column].astype(np.float64)
    if surface == "grey":
        low, high = height_span(bev)
        step = max(high - low, 1e-6) / 255
        z = low + step * np.floor((z - low) / step)
    return np.column_stack([xy, np.where(inside, z, np.nan)])


def tie_points_of(
    matches: Matches,
    source: Bev,
    target: Bev,
    *,
    surface: Surface = "ground",
    pixel: Pixel = "centre",
    folds: int = 4,
    block_m: float | None = None,
    seed: int = 0,
) -> TiePoints:
    """Map matches back to 3D (Eq. 5), and hold some out to judge the result by.

    The raster of more filled cells is divided into square blocks, and all tie points of a block go into the
    same fold, so that those held out are not neighbours of those the transform is solved from. Matches
    without a height in either raster are left out.

    Args:
        matches: pixel pairs.
        source: raster of the cloud that moves.
        target: raster of the cloud that stays.
        surface, pixel: see `inverse_mapping`.
        folds: number of folds; the first is held out from the solve.
        block_m: edge of a block, metres; from the tie points' extent if None.
        seed: of the assignment of blocks to folds.

    Returns:
        The tie points, metres in the levelled frames of both rasters.

    """
    s = inverse_mapping(matches.source_px, source, surface=surface, pixel=pixel)
    t = inverse_mapping(matches.target_px, target, surface=surface, pixel=pixel)
    known = np.isfinite(s[:, 2]) & np.isfinite(t[:, 2])
    s, t, score = s[known], t[known], matches.score[known]
    # by the same raster whichever is the source, so that both ways round the same are held out
    xy = (s if (source.count > 0).sum() > (target.count > 0).sum() else t)[:, :2]
    block = block_for(xy, target.grid.cell) if block_m is None else block_m
    fold = folds_of(xy, folds, block, seed)
    return TiePoints(s, t, score, fold, fold == 0, np.ones(len(s), bool))


def _lowest_around(bev: Bev) -> NDArray[np.float32]:
    import cv2

    radius = max(1, round(GROUND_RADIUS_M / bev.grid.cell))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    filled = np.where(np.isnan(bev.low), np.float32(np.inf), bev.low)
    low = cv2.erode(filled, window, borderType=cv2.BORDER_REPLICATE)
    return np.where(np.isfinite(low), low, np.float32(np.nan))


def folds_of(xy: Floats, folds: int, block_m: float, seed: int) -> NDArray[np.int64]:
    """Assign points to folds by whole square blocks, with equal numbers of blocks.

    The blocks start at the least x and y of the points, to the metre, so that a shift of all points by whole
    metres changes nothing.

    Args:
        xy: (n, 2) metres.
        folds: number of folds.
        block_m: edge of a block, metres.
        seed: of the assignment.

    Returns:
        (n,) numbers 0..folds-1.

    """
    if len(xy) == 0:
        return np.zeros(0, np.int64)
    block = np.floor((xy - np.floor(xy.min(axis=0))) / block_m).astype(np.int64)
    keys, of_point = np.unique(block, axis=0, return_inverse=True)
    dealt = np.random.default_rng(seed).permutation(len(keys)) % folds
    return np.asarray(dealt[of_point.ravel()], np.int64)
