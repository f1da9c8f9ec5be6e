"""Inverse mapping (Eq. 5): from matched pixels back to 3D, with heights from the float rasters."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.types import Bev, Matches, TiePoints
from mtpcr_geo.method.paper import height_span

Floats = NDArray[np.float64]
Surface = Literal["ground", "top", "grey"]
Pixel = Literal["centre", "ceil"]

GROUND_RADIUS_M = 4.0


def inverse_mapping(
    matches: Matches,
    source: Bev,
    target: Bev,
    *,
    surface: Surface = "ground",
    pixel: Pixel = "centre",
    folds: int = 4,
    block_m: float = 40.0,
    seed: int = 0,
) -> TiePoints:
    """Lift matches to tie points in levelled coordinates, and set some aside to judge the result by.

    The tie points of whole square blocks of the target go into one fold, so that tie points held out are
    no neighbours of
    those the transform is solved from. Tie points without a height on either side are left out.

    Args:
        matches: pixel pairs.
        source: raster of the cloud that moves.
        target: raster of the cloud that stays.
        surface: "ground" takes the lowest z around the pixel, which both clouds see under canopy and
            eaves; "top" takes the highest z of the cell; "grey" has it in 255 steps, as in the paper.
        pixel: "centre" puts a pixel at the centre of its cell; "ceil" at the north-east corner (Eq. 5).
        folds: parts into which the blocks are dealt; the first is held out from the solve.
        block_m: edge of a block, metres.
        seed: chooses the blocks.

    """
    s = pixels_to_3d(matches.source_px, source, surface, pixel)
    t = pixels_to_3d(matches.target_px, target, surface, pixel)
    known = np.isfinite(s[:, 2]) & np.isfinite(t[:, 2])
    s, t, score = s[known], t[known], matches.score[known]
    fold = folds_of(t[:, :2], folds, block_m, seed)
    return TiePoints(s, t, score, fold, fold == 0, np.ones(len(s), bool))


def pixels_to_3d(px: Floats, bev: Bev, surface: Surface, pixel: Pixel = "centre") -> Floats:
    """Return (n, 3) metres of (n, 2) pixels, see `lift`; z is NaN where the raster is empty."""
    xy = bev.grid.to_metres(px)
    if pixel == "ceil":
        xy = xy + bev.grid.cell / 2
    column = np.round(px[:, 0]).astype(int)
    row = np.round(px[:, 1]).astype(int)
    inside = (column >= 0) & (column < bev.grid.width) & (row >= 0) & (row < bev.grid.height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    z = (_lowest_around(bev) if surface == "ground" else bev.top)[row, column].astype(np.float64)
    if surface == "grey":
        low, high = height_span(bev)
        step = max(high - low, 1e-6) / 255
        z = low + step * np.floor((z - low) / step)
    return np.column_stack([xy, np.where(inside, z, np.nan)])


def _lowest_around(bev: Bev) -> NDArray[np.float32]:
    import cv2

    radius = max(1, round(GROUND_RADIUS_M / bev.grid.cell))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    filled = np.where(np.isnan(bev.low), np.float32(np.inf), bev.low)
    low = cv2.erode(filled, window, borderType=cv2.BORDER_REPLICATE)
    return np.where(np.isfinite(low), low, np.float32(np.nan))


def folds_of(xy: Floats, folds: int, block_m: float, seed: int) -> NDArray[np.int64]:
    """Deal (n, 2) points into folds, whole square blocks at a time and evenly: (n,) numbers 0..folds-1.

    The blocks hang on the points' own corner, so a shift of the scene changes nothing.
    """
    if len(xy) == 0:
        return np.zeros(0, np.int64)
    block = np.floor((xy - np.floor(xy.min(axis=0))) / block_m).astype(np.int64)
    keys, of_point = np.unique(block, axis=0, return_inverse=True)
    dealt = np.random.default_rng(seed).permutation(len(keys)) % folds
    return np.asarray(dealt[of_point.ravel()], np.int64)
