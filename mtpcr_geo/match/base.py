"""What matchers have in common: what they are given, what they find, what they promise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Matches

Advance = Callable[[int], object]


@dataclass(frozen=True)
class View:
    """One cloud as matchers see it.

    Attributes:
        bev: its height raster, in levelled coordinates.
        image: (h, w) uint8 on the raster's grid; None for matchers that work on heights.
        empty: grey value of empty cells, by which images are extended.

    """

    bev: Bev
    image: Grey | None = None
    empty: int = 127

    @property
    def grid(self) -> Grid:
        """Where raster and image lie."""
        return self.bev.grid


@dataclass(frozen=True)
class DescribedPlaces:
    """Descriptors of places on a lattice over an image, where it shows something.

    Attributes:
        px: (n, 2) float64 pixel coordinates (column, row).
        descriptors: (n, d) float32 of unit length.
        step_px: distance between neighbouring places, pixels.

    """

    px: Floats
    descriptors: NDArray[np.float32]
    step_px: float


@dataclass(frozen=True)
class Features:
    """Keypoints of an image, best first.

    Attributes:
        px: (n, 2) float64 pixel coordinates (column, row), pixel centres at integers.
        score: (n,) float32 strength, whatever its scale.
        descriptors: (n, d) float32 of unit length, or uint8 bits for binary descriptors.
        places: what the extractor says of all places of the image, keypoints or not; None if it does not.

    """

    px: Floats
    score: NDArray[np.float32]
    descriptors: NDArray[Any]
    places: DescribedPlaces | None = None

    def __len__(self) -> int:
        return len(self.score)

    def take(self, chosen: NDArray[Any] | slice) -> Features:
        """Keep some, by mask, index or slice."""
        return Features(self.px[chosen], self.score[chosen], self.descriptors[chosen])


@dataclass(frozen=True)
class PixelMatches:
    """Pairs of pixels in two images.

    Attributes:
        source_px, target_px: (n, 2) float64 pixel coordinates (column, row).
        score: (n,) in 0..1.
        source_keypoints, target_keypoints: (k, 2) all keypoints found, matched or not.

    """

    source_px: Floats
    target_px: Floats
    score: Floats
    source_keypoints: Floats = field(default_factory=lambda: np.empty((0, 2)))
    target_keypoints: Floats = field(default_factory=lambda: np.empty((0, 2)))

    def __len__(self) -> int:
        return len(self.score)

    def take(self, chosen: NDArray[Any]) -> PixelMatches:
        """Keep some of the pairs, by mask or by index."""
        return PixelMatches(
            self.source_px[chosen],
            self.target_px[chosen],
            self.score[chosen],
            self.source_keypoints,
            self.target_keypoints,
        )


class ImageMatcher(Protocol):
    """Finds pairs of pixels in two images that are turned against each other by little, or by any angle."""

    @property
    def any_yaw(self) -> bool:
        """Return whether it finds its way at any angle; else the source is turned for it."""

    def prepare(self, image: Grey, empty: int) -> Any:
        """Do what concerns one image alone; the target's is done once and used for every orientation.

        Args:
            image: (h, w) uint8.
            empty: grey value by which it may be extended.

        """

    def match(self, source: Any, target: Any, most: int | None = None) -> PixelMatches:
        """Match two prepared images, by at most so many keypoints of each where that saves time."""


class Matcher(Protocol):
    """Finds point pairs in two rasters at any yaw: what a `mtpcr.match` stage calls."""

    @property
    def needs_image(self) -> bool:
        """Return whether the views must carry images."""

    @property
    def needs_one_cell(self) -> bool:
        """Return whether both rasters must have cells of one size."""

    def match(
        self, source: View, target: View, *, seed: int = 0, yaw: float | None = None, advance: Advance = ...
    ) -> Matches:
        """Match the source's view to the target's.

        Args:
            source, target: the views.
            seed: of random choices.
            yaw: radians, if it is known to some 20 degrees: then no other need be tried.
            advance: called with 1 after each orientation tried.

        Raises:
            RegistrationError: if there is nothing to match.

        """


def one_to_one(found: PixelMatches, apart_px: float = 1.0) -> PixelMatches:
    """Keep the best of the pairs that share a place in either image, so that each adds something new.

    Args:
        found: pairs.
        apart_px: edge of the squares within which places count as one, pixels.

    """
    order = np.argsort(-found.score, kind="stable")
    seen: tuple[set[tuple[int, int]], set[tuple[int, int]]] = (set(), set())
    kept = []
    places = [np.floor(px[order] / apart_px + 0.5).astype(int) for px in (found.source_px, found.target_px)]
    for rank, (s, t) in enumerate(zip(*places, strict=True)):
        source, target = (int(s[0]), int(s[1])), (int(t[0]), int(t[1]))
        if source in seen[0] or target in seen[1]:
            continue
        seen[0].add(source)
        seen[1].add(target)
        kept.append(order[rank])
    return found.take(np.array(kept, np.int64))


TOLERATED_DEG = 26.0
"""Rotation that descriptors tolerate: an orientation of the source tells of yaws no farther from it."""
LARGEST_MARGIN = 1000.0


def margin_of(strengths: Sequence[float], floor: float = 0.0) -> float:
    """Return how many times stronger the best hypothesis is than the next distinct one.

    Args:
        strengths: of the hypotheses, best first, each at least 0.
        floor: what the next one counts at least, such as one match.

    Returns:
        The ratio, 1000 at most; 1 where there is no hypothesis, or the best is worth nothing.

    """
    if not strengths or strengths[0] <= 0.0:
        return 1.0
    following = max(strengths[1] if len(strengths) > 1 else 0.0, floor)
    return LARGEST_MARGIN if following <= 0.0 else min(strengths[0] / following, LARGEST_MARGIN)
