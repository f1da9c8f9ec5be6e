"""Images turned and magnified for networks that bear little of either, and the way back to the rasters."""

from __future__ import annotations

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.base import DescribedPlaces
from mtpcr_geo.match.likelihood import Places

ZOOM = 2.0
NOT_TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def places_on_ground(places: DescribedPlaces, back: Floats, zoom: float, grid: Grid) -> Places:
    """Take places of a magnified, turned image to metres.

    Args:
        places: in pixels of that image.
        back: (2, 3) affine map from there to pixels of the image not turned.
        zoom: by which it was magnified.
        grid: of the raster.

    """
    at = grid.to_metres(shrunk(affine(back, places.px), zoom))
    return Places(at, places.descriptors, places.step_px / zoom * grid.cell)


def shrunk(px: Floats, zoom: float) -> Floats:
    """Take (n, 2) pixels of a magnified image back to those of the image."""
    return np.asarray((px + 0.5) / zoom - 0.5)


def magnified(image: Grey, zoom: float) -> Grey:
    """Magnify a (h, w) uint8 image, with pixel (c, r) going to ``(c + 0.5) * zoom - 0.5`` and so on."""
    if zoom == 1.0:
        return image
    height, width = image.shape
    size = (round(width * zoom), round(height * zoom))
    M = np.array([[zoom, 0.0, 0.5 * zoom - 0.5], [0.0, zoom, 0.5 * zoom - 0.5]])
    # not cv2.resize, which would round the scale to whole pixels
    bigger = cv2.warpAffine(image, M, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(bigger, np.uint8)


def reduced(image: Grey, by: int, fill: int) -> Grey:
    """Shrink a (h, w) uint8 image by a whole factor, each pixel the mean of its part: `shrunk` by 1 / factor.

    Args:
        image: the image.
        by: the factor.
        fill: grey value by which it is extended to whole pixels.

    """
    if by == 1:
        return image
    height, width = image.shape
    rows, columns = -(-height // by), -(-width // by)
    whole = cv2.copyMakeBorder(
        image, 0, rows * by - height, 0, columns * by - width, cv2.BORDER_CONSTANT, value=(float(fill),)
    )
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)


def turn_image(image: Grey, turn: float, fill: int) -> tuple[Grey, Floats]:
    """Turn an image counter-clockwise (north up) onto a canvas that holds all of it.

    Args:
        image: (h, w) uint8.
        turn: radians.
        fill: grey value of what lies outside.

    Returns:
        The turned image, and the (2, 3) affine map from its pixels to those of the image given.

    """
    if turn == 0.0:
        return image, NOT_TURNED
    height, width = image.shape
    c, s = np.cos(turn), np.sin(turn)
    # rows run south, so that counter-clockwise seen from above turns (column, row) by minus the angle
    R = np.array([[c, s], [-s, c]])
    size = np.ceil(np.abs(R) @ [width, height]).astype(int)
    middle, new_middle = np.array([width - 1, height - 1]) / 2, (size - 1) / 2
    back = np.column_stack([R.T, middle - R.T @ new_middle])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpAffine(
        image,
        back,
        (int(size[0]), int(size[1])),
        flags=flags,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(float(fill),),
    )
    return np.asarray(turned, np.uint8), back


def affine(M: Floats, px: Floats) -> Floats:
    """Apply a (2, 3) affine map to (n, 2) pixels."""
    return np.asarray(px @ M[:, :2].T + M[:, 2])
