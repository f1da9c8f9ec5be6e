"""Which cells of a height raster show the ground: a progressive morphological filter that follows slopes.

The idea is that of Zhang et al. (2003, IEEE Transactions on Geoscience and Remote Sensing 41(4)): what an
opening of a growing window takes off is an object, unless the terrain itself is steep enough to be cut by
as much. The slope is measured on the opened surface, where the objects are gone already, and counts over the
whole window, so that ridges and terraces on a hillside stay.
"""

from __future__ import annotations

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Image, Mask
from mtpcr_geo.core.types import Bev

WINDOWS_M = (6.0, 12.0, 24.0)
"""Half widths of the windows, metres: of bushes, crowns and cars; of houses; of halls."""
ABOVE_M = 0.7
"""Metres above the opened surface that still count as ground on the level."""
SUPPORT_M, WELL_SEEN, ROUGH_M = 4.0, 0.25, 2.0
"""Half width of the window in which ground cells are counted, metres; the share of what is usual where a
cloud sees much of the ground from which on it is seen well; and half width of the window in which it is
smooth then, by a standard deviation of `ABOVE_M` at most."""
CLOSED = 0.25
"""Share of cells that show the ground from which on it is a closed surface."""
STEEPEST = 1.0
"""Slope, rise over run, beyond which steps count as walls and not as ground."""


def ground_cells(low: Image, cell: float) -> Mask:
    """Mark the cells whose lowest height is that of the ground.

    Args:
        low: (h, w) lowest heights, metres, NaN where empty.
        cell: edge of a cell, metres.

    """
    filled = np.isfinite(low)
    if not filled.any():
        return filled
    ground = filled.copy()
    # heights about their median keep float32 exact at any elevation
    middle = np.float32(np.median(low[filled]))
    surface = np.where(filled, low - middle, np.float32(np.nan)).astype(np.float32)
    reach = min(low.shape) * cell
    for number, half in enumerate(WINDOWS_M):
        if number and 2 * half > reach:
            break
        radius = max(1, round(half / cell))
        opened = _opened(surface, filled, radius)
        slope = _steepest_near(opened, filled, radius)
        above = np.where(filled, surface - opened, np.float32(0.0))
        objects = above > np.float32(ABOVE_M) + np.minimum(slope, np.float32(STEEPEST * cell)) * np.float32(
            radius
        )
        ground &= ~objects
        surface = np.where(objects, opened, surface)
    return ground


def bare(bev: Bev) -> Bev:
    """Return a height raster whose lowest heights are those of the ground; cells without it are empty."""
    ground = connected_ground(bev.low, ground_cells(bev.low, bev.grid.cell), bev.grid.cell)
    return Bev(
        bev.grid,
        np.where(ground, bev.top, np.float32(np.nan)),
        np.where(ground, bev.low, np.float32(np.nan)),
        np.where(ground, bev.count, np.uint32(0)),
    )


def connected_ground(low: Image, ground: Mask, cell: float) -> Mask:
    """Leave out ground cells that stand alone above what the ground about them leads to, or lie below it.

    From the ground far crowns and walls are seen, and not what lies under them: nothing lower is near, so
    that no opening takes them off. Where few cells about one are ground, it counts only if it lies no higher
    than the nearest ground that is seen well, and what the terrain may rise by on the way. Pits and feet of
    walls in light wells lie below the mean of the ground about them.

    Args:
        low: (h, w) lowest heights, metres, NaN where empty.
        ground: (h, w) cells that an opening left.
        cell: edge of a cell, metres.

    """
    if not ground.any():
        return ground
    window = 2 * max(1, round(SUPPORT_M / cell)) + 1
    share = cv2.blur(ground.astype(np.float32), (window, window), borderType=cv2.BORDER_CONSTANT)
    heights = np.where(ground, low - np.float32(np.median(low[ground])), np.float32(0.0)).astype(np.float32)
    seen_well = ground & (share >= WELL_SEEN * np.quantile(share[ground], 0.9))
    seen_well &= _roughness(heights, ground, max(1, round(ROUGH_M / cell))) <= np.float32(ABOVE_M)
    if not seen_well.any():
        return ground
    rise = float(np.quantile(_rise_of(heights, seen_well, window / 2.0)[seen_well], 0.5)) / cell
    most = np.float32(ABOVE_M + min(rise, STEEPEST) * SUPPORT_M / 2)
    ground = ground & ~_sunken(heights, ground, window, most)
    seen_well &= ground
    if not seen_well.any():
        return ground
    distance, labels = cv2.distanceTransformWithLabels(
        (~seen_well).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(labels.max()) + 1, np.float32)
    of_label[labels[seen_well]] = heights[seen_well]
    allowed = of_label[labels] + np.float32(ABOVE_M) + np.float32(min(rise, STEEPEST) * cell) * distance
    return np.asarray(ground & (seen_well | (heights <= allowed)))


def _sunken(heights: Image, ground: Mask, window: int, most: np.float32) -> Mask:
    """Mark ground cells that lie more than ``most`` metres below a surface that is closed and smooth.

    What lies below the mean of a forest's floor is the floor, and what is above it brush.
    """
    size = (window, window)
    low = np.zeros_like(ground)
    for _ in range(2):
        left = (ground & ~low).astype(np.float32)
        weight, mean, square = (
            cv2.blur(one, size, borderType=cv2.BORDER_CONSTANT)
            for one in (left, heights * left, heights**2 * left)
        )
        weight = np.maximum(weight, np.float32(1e-6))
        mean /= weight
        low |= ground & (heights < mean - most) & (weight > CLOSED)
        spread = np.sqrt(np.maximum(square / weight - mean**2, np.float32(0.0)))
    return np.asarray(low & (spread < most / 2))


def _roughness(heights: Image, filled: Mask, radius: int) -> Image:
    """Return how the heights in a square window scatter about their means, a standard deviation in metres.

    Means move with the window, so that a slope is not rough.
    """
    size = (2 * radius + 1, 2 * radius + 1)
    weight = filled.astype(np.float32)
    share = np.maximum(cv2.blur(weight, size, borderType=cv2.BORDER_CONSTANT), np.float32(1e-6))
    rest = (heights - cv2.blur(heights * weight, size, borderType=cv2.BORDER_CONSTANT) / share) * weight
    square = cv2.blur(rest**2, size, borderType=cv2.BORDER_CONSTANT) / share
    return np.asarray(np.sqrt(np.maximum(square, np.float32(0.0))))


def _opened(surface: Image, filled: Mask, radius: int) -> Image:
    """Open a surface by a square window, empty cells left out; NaN stays NaN."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    lowest = cv2.erode(np.where(filled, surface, np.float32(np.inf)), window, borderType=cv2.BORDER_REPLICATE)
    known = np.where(np.isfinite(lowest), lowest, np.float32(-np.inf))
    opened = cv2.dilate(known, window, borderType=cv2.BORDER_REPLICATE)
    return np.where(filled, opened, np.float32(np.nan)).astype(np.float32)


def _steepest_near(surface: Image, filled: Mask, radius: int) -> Image:
    """Return the rise per cell of a smoothed surface, the greatest within ``radius`` cells of each."""
    rise = _rise_of(surface, filled, max(radius / 2.0, 1.0))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(rise, window, borderType=cv2.BORDER_REPLICATE), np.float32)


def _rise_of(surface: Image, filled: Mask, sigma: float) -> Image:
    """Return the rise per cell of a surface smoothed over so many cells; 0 where it is empty."""
    weight = filled.astype(np.float32)
    base = np.where(filled, surface, np.float32(0.0))
    smooth = cv2.GaussianBlur(base, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    smooth /= np.maximum(
        cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), np.float32(1e-3)
    )
    east, north = (
        cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=3, borderType=cv2.BORDER_REPLICATE) for dx in (1, 0)
    )
    return np.where(filled, np.hypot(east, north) / np.float32(8.0), np.float32(0.0)).astype(np.float32)
