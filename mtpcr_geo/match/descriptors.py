"""Classical keypoints that are always there: RootSIFT and ORB through OpenCV, and nearest neighbours.

OpenCV 5 also has ALIKED, DISK and LightGlueMatcher classes. They read ONNX files through OpenCV's own
network engine, with one fixed contract each; the models here go through onnxruntime instead, which runs
them on graphics cards too and lets a description file say what a model's inputs and outputs are.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.match.base import Features, PixelMatches

Indices = NDArray[np.int64]

BLOCK = 2048
"""Descriptors compared at once: bounds the distance matrix to some tens of MiB."""


class Extractor(Protocol):
    """Finds keypoints and describes them."""

    def extract(self, image: Grey, empty: int = 0) -> Features:
        """Find keypoints in a (h, w) uint8 image, extended by ``empty`` where need be."""


REMEMBERED = 20
"""Images of which features are kept: a target, and a source and its mirror image in eight orientations."""


class Remembering:
    """An `Extractor` that describes an image once, and remembers the last ones.

    Args:
        extractor: which does the work; it is asked from several threads.

    """

    def __init__(self, extractor: Extractor) -> None:
        self.extractor = extractor
        self._known: OrderedDict[tuple[bytes, tuple[int, ...], int], Features] = OrderedDict()
        self._lock = Lock()

    def forget(self) -> None:
        """Let go of what is remembered."""
        with self._lock:
            self._known.clear()

    def extract(self, image: Grey, empty: int = 0) -> Features:
        """Find keypoints in a (h, w) uint8 image, or return those that were found before."""
        key = hashlib.blake2b(image.tobytes()).digest(), image.shape, empty
        with self._lock:
            found = self._known.pop(key, None)
            if found is not None:
                self._known[key] = found
                return found
        found = self.extractor.extract(image, empty)
        with self._lock:
            self._known[key] = found
            while len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
        return found


class Pairing(Protocol):
    """Pairs the features of two images."""

    def pair(
        self, source: Features, target: Features, shapes: tuple[tuple[int, int], tuple[int, int]]
    ) -> tuple[Indices, Floats]:
        """Return (m, 2) indices into both, and (m,) scores in 0..1; shapes are (h, w) of the images."""


@dataclass(frozen=True)
class RootSift:
    """SIFT whose descriptors are compared by the Hellinger kernel (Arandjelovic and Zisserman 2012).

    Attributes:
        max_keypoints: strongest kept.
        contrast: least contrast; lower than OpenCV's 0.04, since lidar rasters are soft.

    """

    max_keypoints: int = 8192
    contrast: float = 0.01

    def extract(self, image: Grey, empty: int = 0) -> Features:
        """Find keypoints in a (h, w) uint8 image; descriptors are (n, 128), of unit length."""
        if min(image.shape) < 8:
            return _none(128)
        sift = cv2.SIFT.create(nfeatures=self.max_keypoints, contrastThreshold=self.contrast)
        found, descriptors = sift.detectAndCompute(image, None)
        if descriptors is None:
            return _none(128)
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
        return _sorted(found, root.astype(np.float32), self.max_keypoints)


@dataclass(frozen=True)
class Orb:
    """ORB: oriented FAST corners with binary descriptors.

    Attributes:
        max_keypoints: strongest kept.
        fast_threshold: least difference of grey values at a corner.

    """

    max_keypoints: int = 8192
    fast_threshold: int = 10

    def extract(self, image: Grey, empty: int = 0) -> Features:
        """Find keypoints in a (h, w) uint8 image; descriptors are (n, 32) uint8, 256 bits."""
        if min(image.shape) < 8:
            return _none(32, np.uint8)
        orb = cv2.ORB.create(
            nfeatures=self.max_keypoints, nlevels=4, fastThreshold=self.fast_threshold, edgeThreshold=16
        )
        found, descriptors = orb.detectAndCompute(image, None)
        if descriptors is None:
            return _none(32, np.uint8)
        return _sorted(found, descriptors, self.max_keypoints)


@dataclass(frozen=True)
class NearestNeighbours:
    """Nearest neighbours among descriptors.

    Attributes:
        ratio: the nearest must be closer than this times the second nearest (Lowe 2004); 1 turns it off.
        cross_check: the nearest neighbour must have this one for its nearest, too.
        least: least similarity, the cosine of descriptors of unit length; not for binary ones.

    """

    ratio: float = 0.9
    cross_check: bool = False
    least: float = -1.0

    def pair(
        self, source: Features, target: Features, shapes: tuple[tuple[int, int], tuple[int, int]]
    ) -> tuple[Indices, Floats]:
        """Return (m, 2) indices and (m,) scores: 1 less the ratio of the two nearest distances."""
        if len(source) < 1 or len(target) < 2:
            return np.empty((0, 2), np.int64), np.empty(0)
        nearest, first, second = _two_nearest(source.descriptors, target.descriptors)
        keep = first < self.ratio * second if self.ratio < 1.0 else np.ones(len(nearest), bool)
        if self.cross_check:
            back, _, _ = _two_nearest(target.descriptors, source.descriptors)
            keep &= back[nearest] == np.arange(len(nearest))
        if source.descriptors.dtype != np.uint8:
            keep &= 1.0 - first**2 / 2 >= self.least
        chosen = np.flatnonzero(keep)
        score = 1.0 - first[chosen] / np.maximum(second[chosen], 1e-9)
        return np.stack([chosen, nearest[chosen]], axis=1), np.clip(score, 0.0, 1.0)


@dataclass(frozen=True)
class FeatureMatcher:
    """An `ImageMatcher` of an extractor and a pairing."""

    extractor: Extractor
    pairing: Pairing
    any_yaw: bool

    def prepare(self, image: Grey, empty: int) -> tuple[Features, tuple[int, int]]:
        """Extract the features of an image."""
        return self.extractor.extract(image, empty), (image.shape[0], image.shape[1])

    def match(
        self,
        source: tuple[Features, tuple[int, int]],
        target: tuple[Features, tuple[int, int]],
        most: int | None = None,
    ) -> PixelMatches:
        """Pair the features of two images, or the best of each."""
        (s, shape_s), (t, shape_t) = source, target
        s, t = s.take(slice(most)), t.take(slice(most))
        # as if both were padded to one size, so that places are scaled alike
        shape = max(shape_s[0], shape_t[0]), max(shape_s[1], shape_t[1])
        index, score = self.pairing.pair(s, t, (shape, shape))
        return PixelMatches(s.px[index[:, 0]], t.px[index[:, 1]], score, s.px, t.px)


def _two_nearest(a: NDArray[np.generic], b: NDArray[np.generic]) -> tuple[Indices, Floats, Floats]:
    """Give, for each row of a, the nearest row of b, its distance, and that of the second nearest."""
    nearest = np.empty(len(a), np.int64)
    first, second = np.empty(len(a)), np.full(len(a), np.inf)
    other = _as_vectors(b)
    for start in range(0, len(a), BLOCK):
        part = slice(start, start + BLOCK)
        dot = _as_vectors(a[part]) @ other.T
        n = len(dot)
        best = np.argmax(dot, axis=1)
        nearest[part] = best
        first[part] = _distance(dot[np.arange(n), best], a.dtype)
        if other.shape[0] > 1:
            dot[np.arange(n), best] = -np.inf
            second[part] = _distance(dot.max(axis=1), a.dtype)
    return nearest, first, second


def _as_vectors(descriptors: NDArray[np.generic]) -> NDArray[np.float32]:
    """Turn bits into +-1, so that the dot product of binary descriptors counts agreeing bits."""
    if descriptors.dtype != np.uint8:
        return np.asarray(descriptors, np.float32)
    return np.unpackbits(np.asarray(descriptors, np.uint8), axis=1).astype(np.float32) * 2 - 1


def _distance(dot: NDArray[np.float32], dtype: np.dtype[np.generic]) -> Floats:
    if dtype == np.uint8:
        # 256 bits: the number that differ
        return np.asarray((256.0 - dot) / 2, np.float64)
    return np.asarray(np.sqrt(np.maximum(2.0 - 2.0 * dot, 0.0)), np.float64)


def _sorted(found: Sequence[cv2.KeyPoint], descriptors: NDArray[np.generic], most: int) -> Features:
    """Order by strength, then place: the order of threads must not show."""
    px = np.array([k.pt for k in found], np.float64).reshape(-1, 2)
    score = np.array([k.response for k in found], np.float32)
    angle = np.array([k.angle for k in found])
    order = np.lexsort((angle, px[:, 1], px[:, 0], -score))[:most]
    return Features(px[order], score[order], descriptors[order])


def _none(size: int, dtype: type[np.generic] = np.float32) -> Features:
    return Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, size), dtype))
