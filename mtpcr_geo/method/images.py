"""Images of a height raster: grey values (Eq. 3), enhancement (Eq. 4), band-passed heights, step edges.

The band-passed height shows roofs, crowns and kerbs alike whatever the terrain beneath; the step edges
show facades and eaves, which are all that a street-level scan shares with a view from above.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Grey, Image
from mtpcr_geo.core.types import Bev, Look

Gain = Literal["saturated", "normalised"]
LOOKS: tuple[Look, ...] = get_args(Look)

EMPTY_GREY = 127
GREY_PER_METRE = 20.0

FINE_SIGMA_CELLS = 0.7
WIDE_SIGMA_M = 12.0
HEIGHT_CLIP_M = 8.0
STEP_FLOOR_M = 1.0
STEP_RANGE_M = 5.0
_TINY_WEIGHT = 1e-3

W1 = np.full((3, 3), -2.0, np.float32)
W1[1, 1] = 32.0
"""First high-pass filter of Eq. 4; its sum is 16."""

W2 = np.full((3, 3), -1.0, np.float32)
W2[1, 1] = 10.0
"""Second high-pass filter of Eq. 4; its sum is 2."""


def grey(bev: Bev, *, printed: bool = False) -> Grey:
    """Make the grey image (Eq. 3): 0..255 from the lowest to the highest point, 0 where empty.

    Args:
        bev: the raster; zmin and zmax are those of all its points.
        printed: take the floor of the fraction alone, as printed, which leaves 0 or 255.

    Returns:
        (h, w) uint8.

    """
    filled = bev.count > 0
    if not filled.any():
        return np.zeros(bev.grid.shape, np.uint8)
    low, high = (float(value) for value in height_span(bev))
    span = max(high - low, 1e-6)
    fraction = (np.where(filled, bev.top, low).astype(np.float64) - low) / span
    scaled = np.floor(fraction) * 255 if printed else np.floor(255 * fraction)
    return np.where(filled, np.clip(scaled, 0, 255), 0).astype(np.uint8)


def height_span(bev: Bev) -> tuple[float, float]:
    """Return zmin and zmax over all points of a raster, metres; NaN where it is empty."""
    filled = bev.count > 0
    if not filled.any():
        return float("nan"), float("nan")
    return float(bev.low[filled].min()), float(bev.top[filled].max())


def enhance(image: Grey, gain: Gain = "saturated") -> Grey:
    """Sharpen a grey image by both high-pass filters (Eq. 4).

    Args:
        image: (h, w) uint8.
        gain: "saturated" cuts to 0..255 after each filter, as image libraries do; the filters multiply
            the mean by 16 and by 2, so most of the image becomes white. "normalised" divides each by its
            sum, and cuts once at the end.

    Returns:
        (h, w) uint8.

    """
    if gain == "saturated":
        return np.asarray(cv2.filter2D(cv2.filter2D(image, -1, W1), -1, W2), np.uint8)
    once = cv2.filter2D(image.astype(np.float32), -1, W1 / W1.sum())
    twice = cv2.filter2D(once, -1, W2 / W2.sum())
    return np.asarray(np.clip(np.rint(twice), 0, 255), np.uint8)


def masked_blur(image: Image, mask: Image, sigma_cells: float, weight: Image | None = None) -> Image:
    """Gaussian mean over the filled cells only (normalised convolution).

    Args:
        image: (h, w) values, 0 where empty.
        mask: (h, w) 1 where filled, 0 where empty.
        sigma_cells: standard deviation in cells.
        weight: (h, w) the same mean of the mask, where it is known; see `blurred_mask`.

    """
    if weight is None:
        weight = blurred_mask(mask, sigma_cells)
    total = cv2.GaussianBlur(image * mask, (0, 0), sigma_cells, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(total / np.maximum(weight, _TINY_WEIGHT), np.float32)


def blurred_mask(mask: Image, sigma_cells: float) -> Image:
    """Gaussian mean of a mask, (h, w): the weight of the filled cells about each."""
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), sigma_cells, borderType=cv2.BORDER_CONSTANT), np.float32)


def filled_height(bev: Bev) -> tuple[Image, Image]:
    """Return the highest z relative to its median, 0 where empty, and the mask of filled cells."""
    filled = bev.count > 0
    middle = np.median(bev.top[filled]) if filled.any() else 0.0
    height = np.where(filled, bev.top - np.float32(middle), np.float32(0))
    return np.asarray(height, np.float32), filled.astype(np.float32)


def band_pass(height: Image, mask: Image, cell: float, weight: Image | None = None) -> Image:
    """Height above its surroundings: smoothed by 0.7 cell, less the mean over 12 m, clipped to 8 m.

    Args:
        height: (h, w) metres, 0 where empty.
        mask: (h, w) 1 where filled.
        cell: edge of a cell, metres.
        weight: (h, w) mean of the mask over 12 m, where it is known.

    Returns:
        (h, w) metres, 0 where empty.

    """
    wide = masked_blur(height, mask, _wide_sigma(cell), weight)
    fine = masked_blur(height, mask, FINE_SIGMA_CELLS)
    return np.asarray(np.clip(fine - wide, -HEIGHT_CLIP_M, HEIGHT_CLIP_M) * mask, np.float32)


def step_edges(height: Image, mask: Image, cell: float, weight: Image | None = None) -> Image:
    """Height steps: the range within 3 x 3 filled cells, 1..6 m mapped to 0..1, locally centred.

    Args:
        height: (h, w) metres, 0 where empty.
        mask: (h, w) 1 where filled.
        cell: edge of a cell, metres.
        weight: (h, w) mean of the mask over 12 m, where it is known.

    Returns:
        (h, w) unitless, 0 where empty, with zero mean over 12 m.

    """
    far = np.float32(1e6)
    window = np.ones((3, 3), np.uint8)
    high = cv2.dilate(np.where(mask > 0, height, -far), window)
    low = cv2.erode(np.where(mask > 0, height, far), window)
    step = np.clip((high - low - STEP_FLOOR_M) / STEP_RANGE_M, 0.0, 1.0).astype(np.float32) * mask
    centred = step - masked_blur(step, mask, _wide_sigma(cell), weight)
    return np.asarray(centred * mask, np.float32)


def _wide_sigma(cell: float) -> float:
    """Return the standard deviation of the wide mean, in cells of some metres."""
    return max(WIDE_SIGMA_M / cell, 1.5)


@dataclass(frozen=True)
class Channels:
    """The two channels on which correlation works, and where they are known.

    Attributes:
        height: (h, w) float32 band-passed height, metres, 0 where empty.
        steps: (h, w) float32 centred step edges, 0 where empty.
        mask: (h, w) float32, 1 where filled.

    """

    height: Image
    steps: Image
    mask: Image

    @cached_property
    def stack(self) -> Image:
        """All three as one (3, h, w) array: height, steps, mask."""
        return np.stack([self.height, self.steps, self.mask])


def channels(bev: Bev) -> Channels:
    """Make the correlation channels of a height raster."""
    height, mask = filled_height(bev)
    cell = bev.grid.cell
    # both take off a wide mean over the same cells: its weights are a third of the work
    weight = blurred_mask(mask, _wide_sigma(cell))
    return Channels(band_pass(height, mask, cell, weight), step_edges(height, mask, cell, weight), mask)


def band_image(bev: Bev) -> Grey:
    """Make the grey image of the band-passed height: 127 + 20 per metre, 127 where empty: (h, w) uint8.

    It shows a roof of three metres alike on a hill and in a valley, and has no edge where the data end.
    """
    height, mask = filled_height(bev)
    grey = EMPTY_GREY + GREY_PER_METRE * band_pass(height, mask, bev.grid.cell)
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


def image_of(bev: Bev, look: Look) -> Grey:
    """Make the image that keypoint matchers see: (h, w) uint8.

    Args:
        bev: the raster.
        look: "band_pass" (ours); "paper" (Eq. 3 corrected, Eq. 4 saturating); "paper_normalised" (Eq. 4
            divided by the filters' sums); "grey" (Eq. 3 corrected alone); "grey_printed" (Eq. 3 as printed,
            which is black but for the highest cell).

    """
    if look == "band_pass":
        return band_image(bev)
    plain = grey(bev, printed=look == "grey_printed")
    if look in ("grey", "grey_printed"):
        return plain
    return enhance(plain, "saturated" if look == "paper" else "normalised")


def empty_grey(look: Look) -> int:
    """Return the grey value of empty cells in an image of that look."""
    return EMPTY_GREY if look == "band_pass" else 0
