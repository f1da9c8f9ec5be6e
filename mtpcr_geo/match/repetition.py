"""Whether a scene repeats itself: each raster against itself, moved."""

from __future__ import annotations

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Image
from mtpcr_geo.match.nearby import target_under
from mtpcr_geo.match.pose import Pose, warp_to
from mtpcr_geo.match.search import FILLED, Layer, spectrum

REPEATS = 0.4
"""Correlation of a scene with itself, moved, from which it repeats itself. Nine real sites have 0.19-0.28;
rows of trees 0.62, solar panels and equal houses 0.74-0.90."""
WINDOW_CELLS = 400
"""Edge of the part that is looked at, cells."""
LEAST_SHARED = 0.25
"""Share of the filled cells that a move must leave on filled ones."""
ONE_LOBE = 0.2
"""Correlation down to which moves belong to the peak at no move, however far it reaches along a street."""


def self_likeness(source: Layer, target: Layer, pose: Pose) -> float:
    """Return how well the scene that both show under a pose fits itself after another shift.

    A lattice (an orchard, a solar park, rows of equal houses) fits itself one period away: a pose that is off
    by a period has rivals, whether the search met them or not.

    Args:
        source, target: channels at the finest cells.
        pose: about the source raster's centre.

    Returns:
        The larger of both rasters' correlation with itself, of height and steps in the mean, at the best
        shift beyond the peak at none; 0 where there is nothing to compare.

    """
    part, (row, column) = target_under(source.grid, target.grid, pose, 0)
    if min(part.shape) < 3:
        return 0.0
    over = warp_to(source.channels.stack, source.grid, part, pose)
    under = target.channels.stack[:, row : row + part.height, column : column + part.width]
    both = (over[2] > FILLED) & (under[2] > FILLED)
    if not both.any():
        return 0.0
    window = _window(both)
    found = []
    for stack in (over, under):
        height, steps, mask = stack[(slice(None), *window)]
        mask = (mask > FILLED).astype(np.float32)
        found.append(_second_peak(height * mask, steps * mask, mask))
    return max(found)


def _window(both: np.ndarray) -> tuple[slice, slice]:
    """Return a window about the middle of what both fill."""
    slices = []
    for axis in (1, 0):
        share = np.cumsum(both.sum(axis=axis))
        middle = int(np.searchsorted(share, share[-1] / 2))
        first = max(0, min(middle - WINDOW_CELLS // 2, len(share) - WINDOW_CELLS))
        slices.append(slice(first, first + WINDOW_CELLS))
    return slices[0], slices[1]


def _second_peak(height: Image, steps: Image, mask: Image) -> float:
    """Return the highest correlation of an image with itself beyond the lobe around no shift."""
    rows, columns = (cv2.getOptimalDFTSize(2 * n - 1) for n in mask.shape)

    def correlated(a: Image, b: Image) -> Image:
        product = cv2.mulSpectrums(a, b, 0, conjB=True)
        found = cv2.idft(product, flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
        return np.asarray(np.fft.fftshift(found), np.float32)

    filled = spectrum(mask, (rows, columns))
    likeness = np.zeros((rows, columns), np.float32)
    for image in (height, steps):
        one, squares = (spectrum(one, (rows, columns)) for one in (image, image**2))
        norm = correlated(squares, filled) * correlated(filled, squares)
        # float32 sums of a whole image leave a trace where there is nothing
        floor = 1e-6 * float((image**2).sum()) ** 2 + 1e-12
        likeness += correlated(one, one) / np.sqrt(np.maximum(norm, floor)) / 2
    likeness[correlated(filled, filled) < LEAST_SHARED * mask.sum()] = -1.0
    lobes = cv2.connectedComponents((likeness > ONE_LOBE).astype(np.uint8))[1]
    beyond = lobes != lobes[rows // 2, columns // 2]
    return max(float(likeness[beyond].max(initial=0.0)), 0.0)
