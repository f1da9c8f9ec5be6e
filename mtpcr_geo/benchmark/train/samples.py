"""Pairs of patches with known correspondences, cut from two views of one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.train.views import View
from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.method.images import EMPTY_GREY

ROTATION_DEG = 25.0
"""Rotation between the patches of a pair at most; the sweep of orientations leaves 22.5 degrees."""
CELL_RATIOS = {1.12: 0.75, 1.7: 0.25}
"""Ratio of the cells of two views at most, and the share of pairs drawn with it."""
ACROSS_SHARE = 0.7
"""Share of pairs of a ground view with an aerial one; the others are two views of one kind."""
LARGEST_STRETCH = 0.06
"""Natural logarithm of the factor at most by which a patch is cut larger or smaller than its cell says."""
POINTS = 128
"""Correspondences of a pair."""
PEAK_RADIUS = 4
LEAST_PEAK = 0.15
CELL_PX = 8
"""Edge of the detector's cells."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Sample:
    """Two patches of one place.

    Attributes:
        images: two (size, size) uint8.
        filled: two (size, size) bool.
        M: (2, 3) affine map from pixels of the first to pixels of the second.

    """

    images: tuple[Grey, Grey]
    filled: tuple[Mask, Mask]
    M: Floats


@dataclass(frozen=True)
class Labels:
    """What the detector and the descriptor are to learn from a sample.

    Attributes:
        points: two (POINTS, 2) float32, the same places in either patch.
        valid: (POINTS,) bool, False where there were not so many places.
        cells: two (rows, columns) int64: the pixel of the cell that is a keypoint, 64 for none, -1 where
            nothing is known.

    """

    points: tuple[NDArray[np.float32], NDArray[np.float32]]
    valid: Mask
    cells: tuple[NDArray[np.int64], NDArray[np.int64]]


def choose_views(views: Sequence[View], rng: np.random.Generator) -> tuple[View, View]:
    """Draw two views of like cells, from the ground and from the air or both of a kind."""
    while True:
        first = views[int(rng.integers(len(views)))]
        across = rng.random() < ACROSS_SHARE
        ratio = float(rng.choice(list(CELL_RATIOS), p=list(CELL_RATIOS.values())))
        others = [
            view
            for view in views
            if view is not first
            and (view.from_ground != first.from_ground) == across
            and max(view.cell / first.cell, first.cell / view.cell) < ratio
        ]
        if others:
            return first, others[int(rng.integers(len(others)))]


def draw_sample(
    views: Sequence[View], rng: np.random.Generator, size: int, *, shift: float = 0.2, tries: int = 8
) -> Sample:
    """Cut two patches of one place, turned, scaled and shifted against each other, and spoil them.

    Args:
        views: of one site.
        rng: of the draw.
        size: edge of the patches, pixels.
        shift: of the second patch at most, as a share of the edge.
        tries: places tried; the last is taken whatever it shows.

    """
    one, other = choose_views(views, rng)
    # magnified twice, as small images are, or about as they come
    zoom = rng.uniform(0.45, 0.6) if rng.random() < 0.5 else rng.uniform(0.8, 1.15)
    mirrored = rng.random() < 0.5
    sample = None
    for _ in range(tries):
        middle = _common_place(one, other, rng)
        turn = rng.uniform(0.0, 2 * np.pi)
        turns = turn, turn + np.radians(rng.uniform(-ROTATION_DEG, ROTATION_DEG))
        places = middle, middle + rng.uniform(-shift, shift, 2) * size * zoom * other.cell
        patches = []
        for view, angle, place in zip((one, other), turns, places, strict=True):
            scale = zoom * view.cell * np.exp(rng.uniform(-LARGEST_STRETCH, LARGEST_STRETCH))
            A = _patch_to_site(size, angle, scale, place, mirrored)
            patches.append((*_cut(view, A, size), A))
        (a, filled_a, A), (b, filled_b, B) = patches
        M = _compose(_inverse(B), A)
        sample = Sample((a, b), (filled_a, filled_b), M)
        # a thinned cloud fills few of the pixels that it covers
        covered = [
            cv2.dilate(filled.astype(np.uint8), np.ones((7, 7), np.uint8)) for filled in (filled_a, filled_b)
        ]
        shared = _warp(covered[1], M, size, 0) & covered[0]
        if shared.mean() > 0.25 and a.std() > 4.0 and b.std() > 4.0:
            break
    assert sample is not None
    return spoil(sample, rng)


def _common_place(one: View, other: View, rng: np.random.Generator) -> Floats:
    """Draw a place of a view, in the site's frame, that the other has filled too, if there soon is one."""
    places = one.places[rng.integers(len(one.places), size=32)]
    px = np.rint(_apply(other.to_pixel, places)).astype(np.int64)
    height, width = other.filled.shape
    inside = np.asarray((px >= 0).all(axis=1) & (px < [width, height]).all(axis=1))
    column, row = np.where(inside[:, None], px, 0).T
    both = other.filled[row, column] & inside
    return np.asarray(places[int(np.argmax(both))])


def spoil(sample: Sample, rng: np.random.Generator) -> Sample:
    """Blank discs and single pixels, change the gain and add noise, in either patch by itself."""
    images, filled = [], []
    for image, there in zip(sample.images, sample.filled, strict=True):
        size, kept = len(image), there.copy()
        if rng.random() < 0.5:
            for _ in range(rng.integers(1, 4)):
                hole = np.zeros(image.shape, np.uint8)
                x, y = (int(value) for value in rng.integers(0, size, 2))
                cv2.circle(hole, (x, y), int(rng.uniform(0.05, 0.2) * size), (1,), -1)
                kept &= hole == 0
        if rng.random() < 0.3:
            kept &= rng.random(image.shape) > rng.uniform(0.0, 0.3)
        value = image.astype(np.float32)
        value = EMPTY_GREY + (value - EMPTY_GREY) * np.float32(rng.uniform(0.7, 1.4))
        value += rng.normal(0.0, rng.uniform(0.0, 6.0), image.shape).astype(np.float32)
        spoilt = np.where(kept | ~there, np.where(there, value, image), EMPTY_GREY)
        images.append(np.clip(np.rint(spoilt), 0, 255).astype(np.uint8))
        filled.append(kept)
    return Sample((images[0], images[1]), (filled[0], filled[1]), sample.M)


def label(sample: Sample, rng: np.random.Generator) -> Labels:
    """Label a sample: keypoints are corners that both patches show at one place.

    The corner response of the second patch is brought onto the first by the known pose; the geometric mean of
    both is high only where both have a corner. Its peaks are the keypoints of both.
    """
    size = len(sample.images[0])
    responses = [_corners(image) for image in sample.images]
    overlap = _warp(sample.filled[1].astype(np.uint8), sample.M, size, 0).astype(bool) & sample.filled[0]
    both = np.sqrt(responses[0] * _warp(responses[1], sample.M, size, 0.0)) * cv2.dilate(
        overlap.astype(np.uint8), np.ones((3, 3), np.uint8)
    )
    window = np.ones((2 * PEAK_RADIUS + 1,) * 2, np.uint8)
    peaks = (both >= cv2.dilate(both, window)) & (both > LEAST_PEAK)
    rows, columns = np.nonzero(peaks)
    order = np.argsort(-both[rows, columns], kind="stable")
    px = np.stack([columns, rows], axis=1)[order].astype(np.float64)
    moved = _apply(sample.M, px)
    inside = ((moved > 3) & (moved < size - 4) & (px > 3) & (px < size - 4)).all(axis=1)
    px, moved = px[inside], moved[inside]
    cells = (
        _cells(px, _known(sample, size)),
        _cells(moved, _known(_reversed(sample), size)),
    )
    rows, columns = np.nonzero(overlap)
    if len(rows):
        more = rng.permutation(len(rows))[: 2 * POINTS]
        extra = np.stack([columns, rows], axis=1)[more].astype(np.float64)
        extra_moved = _apply(sample.M, extra)
        near = ((extra_moved > 3) & (extra_moved < size - 4)).all(axis=1)
        # two thirds keypoints, as far as there are so many
        some = slice(2 * POINTS // 3)
        px, moved = np.concatenate([px[some], extra[near]]), np.concatenate([moved[some], extra_moved[near]])
    points = np.full((2, POINTS, 2), size / 2, np.float32)
    n = min(len(px), POINTS)
    points[0, :n], points[1, :n] = px[:n], moved[:n]
    return Labels((points[0], points[1]), np.arange(POINTS) < n, cells)


def _corners(image: Grey) -> NDArray[np.float32]:
    """Return the smaller eigenvalue of the structure tensor, 1 for the strong corners of the image."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.2)
    response = np.sqrt(np.maximum(cv2.cornerMinEigenVal(smooth, 5, ksize=3), 0.0))
    strong = float(np.quantile(response, 0.98))
    return np.asarray(np.minimum(response / max(strong, 1e-6), 1.5), np.float32)


def _known(sample: Sample, size: int) -> Mask:
    """Return the (rows, columns) cells of the first patch of which the second tells whether they repeat."""
    seen = _warp(sample.filled[1].astype(np.uint8), sample.M, size, 0).astype(np.float32)
    own = sample.filled[0].astype(np.float32)
    n = size // CELL_PX

    def share(image: NDArray[np.float32]) -> Floats:
        return np.asarray(image.reshape(n, CELL_PX, n, CELL_PX).mean(axis=(1, 3)))

    # nothing repeats where there is nothing
    return np.asarray((share(seen * own) > 0.2) | (share(own) == 0.0))


def _cells(px: Floats, known: Mask) -> NDArray[np.int64]:
    cells = np.where(known, CELL_PX * CELL_PX, -1).astype(np.int64)
    # strongest last, so that it stays
    whole = np.rint(px[::-1]).astype(np.int64)
    column, row = whole.T
    cells[row // CELL_PX, column // CELL_PX] = (row % CELL_PX) * CELL_PX + column % CELL_PX
    return cells


def _reversed(sample: Sample) -> Sample:
    return Sample(sample.images[::-1], sample.filled[::-1], _inverse(sample.M))


def _patch_to_site(size: int, angle: float, scale: float, place: Floats, mirrored: bool) -> Floats:
    c, s = np.cos(angle) * scale, np.sin(angle) * scale
    L = np.array([[c, s], [s, -c]]) @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    middle = np.full(2, (size - 1) / 2)
    return np.column_stack([L, place - L @ middle])


def _cut(view: View, A: Floats, size: int) -> tuple[Grey, Mask]:
    back = _compose(view.to_pixel, A)
    image = cv2.warpAffine(
        view.image, back, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT, borderValue=(float(EMPTY_GREY),),
    )  # fmt: skip
    filled = _warp(view.filled.astype(np.uint8), back, size, 0)
    return np.asarray(image, np.uint8), filled.astype(bool)


def _warp(image: NDArray[Any], back: Floats, size: int, empty: float) -> NDArray[Any]:
    flags = (cv2.INTER_NEAREST if image.dtype == np.uint8 else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(
            image, back, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=(empty,)
        )
    )


def _apply(M: Floats, px: Floats) -> Floats:
    return np.asarray(px @ M[:, :2].T + M[:, 2])


def _compose(outer: Floats, inner: Floats) -> Floats:
    return np.column_stack([outer[:, :2] @ inner[:, :2], outer[:, :2] @ inner[:, 2] + outer[:, 2]])


def _inverse(M: Floats) -> Floats:
    L = np.linalg.inv(M[:, :2])
    return np.column_stack([L, -L @ M[:, 2]])
