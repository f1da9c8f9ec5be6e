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
    surface = (low - np.float32(np.nanmedian(low))).astype(np.float32)
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
    ground = ground_cells(bev.low, bev.grid.cell)
    return Bev(
        bev.grid,
        np.where(ground, bev.top, np.float32(np.nan)),
        np.where(ground, bev.low, np.float32(np.nan)),
        np.where(ground, bev.count, np.uint32(0)),
    )


def _opened(surface: Image, filled: Mask, radius: int) -> Image:
    """Open a surface by a square window, empty cells left out; NaN stays NaN."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    lowest = cv2.erode(np.where(filled, surface, np.float32(np.inf)), window, borderType=cv2.BORDER_REPLICATE)
    known = np.where(np.isfinite(lowest), lowest, np.float32(-np.inf))
    opened = cv2.dilate(known, window, borderType=cv2.BORDER_REPLICATE)
    return np.where(filled, opened, np.float32(np.nan)).astype(np.float32)


def _steepest_near(surface: Image, filled: Mask, radius: int) -> Image:
    """Return the rise per cell of a smoothed surface, the greatest within ``radius`` cells of each."""
    weight = filled.astype(np.float32)
    base = np.where(filled, surface, np.float32(0.0))
    sigma = max(radius / 2.0, 1.0)
    smooth = cv2.GaussianBlur(base, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    smooth /= np.maximum(
        cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), np.float32(1e-3)
    )
    east, north = (
        cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=3, borderType=cv2.BORDER_REPLICATE) for dx in (1, 0)
    )
    rise = np.where(filled, np.hypot(east, north) / np.float32(8.0), np.float32(0.0)).astype(np.float32)
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    return np.asarray(cv2.dilate(rise, window, borderType=cv2.BORDER_REPLICATE), np.float32)
