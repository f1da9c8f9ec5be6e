"""Poses by likelihood: every place of the source against every place of the target, by dense descriptors.

A network that was trained to tell places apart gives for each pair of places the logarithm of how much
likelier their descriptors are if they show one place than if they do not. A pose is as likely as the product
over all pairs of places that it brings together, where some of them may be mistaken (mixture with a share of
pairs that say nothing). With cells in metres and a known vertical only a yaw and a shift are sought, so that
the sums of all shifts are counted at once, for one yaw after the other (a generalised Hough transform,
weighted; Ballard 1981, doi:10.1016/0031-3203(81)90009-1). No keypoint need be found twice: between the ground
and the air few are.

What a sum is worth depends on the overlap, for a large one gathers more by chance. The sums are therefore
taken from what pairs give on average, over the standard deviation of so many.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.match.base import TOLERATED_DEG
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.search import distinct
from mtpcr_geo.method.solve import fit_upright

TEMPERATURE = 0.07
"""By which the cosine of two descriptors is divided; that of the training."""
TRUSTED = 0.2
"""Share of pairs of one place whose descriptors tell so."""
LEAST_LOG_RATIO = 1.0
"""Logarithm of a likelihood ratio below which a pair is left out: it says next to nothing."""
YAW_STEP_DEG = 3.0
FEWEST_PAIRS = 160
"""Pairs of places that a pose must bring together; with fewer it counts as if there were so many."""
PEAKS = 3
"""Shifts of most evidence that are kept of each yaw."""
APART_DEG, APART_STEPS = 8.0, 4.0
"""Two poses are distinct where they turn, or move the middle of the source, apart by more than this."""
MOST_PLACES, FEWEST_PLACES, MOST_PAIRS = 4000, 1000, 64_000_000
"""Places of the source that are compared: of more, every so many-th, so that there are no more pairs with the
target's places than memory has room for; but of a very large target as many as the second number."""
BLOCK_PAIRS = 4_000_000
"""Pairs whose descriptors are compared at once."""
ROUNDS = 4
SMOOTHING = 1.0 / (4 * np.pi)
"""Sum of the squares of the weights of a Gaussian that is one bin wide."""


@dataclass(frozen=True)
class Places:
    """What a network says of the places of an image.

    Attributes:
        at: (n, 2) metres.
        descriptors: (n, d) float32 of unit length.
        step_m: distance between neighbouring places, metres.

    """

    at: Floats
    descriptors: NDArray[np.float32]
    step_m: float

    def __len__(self) -> int:
        return len(self.at)

    def thinned(self, most: int) -> Places:
        """Keep every so many-th, so that no more than `most` are left."""
        every = -(-len(self) // most)
        return self if every <= 1 else Places(self.at[::every], self.descriptors[::every], self.step_m)


@dataclass(frozen=True)
class TurnedPlaces:
    """The places of the source as the network sees them in one orientation of its image.

    Attributes:
        turn: radians by which the image was turned, counter-clockwise.
        places: where they lie in the unturned source.

    """

    turn: float
    places: Places


@dataclass(frozen=True)
class LikelyPose:
    """A pose and what speaks for it.

    Attributes:
        T: 4x4 planar pose, metres.
        strength: evidence over what its overlap gives by chance, in standard deviations of that.

    """

    T: Floats
    strength: float


@dataclass(frozen=True)
class _Pairs:
    """Pairs of places that speak for a pose: indices, weights, and mean and variance over all pairs."""

    source: NDArray[np.int32]
    target: NDArray[np.int32]
    weight: NDArray[np.float32]
    mean: float
    variance: float


def poses_by_likelihood(
    orientations: Sequence[TurnedPlaces], target: Places, *, most: int = 8, yaw: float | None = None
) -> list[LikelyPose]:
    """Find the poses under which the descriptors of both clouds agree best.

    Args:
        orientations: the source in orientations evenly round the circle, or in one where the yaw is known.
        target: the places of the target.
        most: poses returned.
        yaw: radians, where it is known: that of the only orientation.

    Returns:
        Distinct poses, those first for which most speaks.

    """
    room = int(np.clip(MOST_PAIRS // max(len(target), 1), FEWEST_PLACES, MOST_PLACES))
    seen = [TurnedPlaces(one.turn, one.places.thinned(room)) for one in orientations]
    seen = [one for one in seen if len(one.places)]
    if not seen or not len(target):
        return []
    middle = np.concatenate([one.places.at for one in seen]).mean(axis=0)
    half = np.pi / len(orientations) if yaw is None else np.radians(TOLERATED_DEG)
    found: list[tuple[Pose, int]] = []
    pairs = []
    for number, one in enumerate(seen):
        pairs.append(_compared(one.places, target))
        found += [(pose, number) for pose in _peaks(one, pairs[-1], target, middle, half)]
    found.sort(key=lambda peak: -peak[0].score)
    of = dict(found)
    turned, apart = np.radians(APART_DEG), APART_STEPS * target.step_m
    fitted: dict[Pose, Floats] = {}
    for pose in distinct(of, most, turned, apart):
        T = _fitted(pose, seen[of[pose]].places, pairs[of[pose]], target, middle)
        east, north = T[:2, :2] @ middle + T[:2, 3]
        fitted[Pose(transforms.yaw_of(T[:3, :3]), float(east), float(north), pose.score)] = T
    # neighbouring yaws may have come to one pose
    return [LikelyPose(fitted[pose], pose.score) for pose in distinct(fitted, most, turned, apart)]


def _compared(source: Places, target: Places) -> _Pairs:
    """Compare the descriptors of all places, and keep the pairs that speak for being one place."""
    rows = max(1, BLOCK_PAIRS // len(target))
    blocks = [slice(first, first + rows) for first in range(0, len(source), rows)]
    likeness = [
        source.descriptors[block] @ target.descriptors.T / np.float32(TEMPERATURE) for block in blocks
    ]
    top = np.float32(1.0 / TEMPERATURE)
    forth = [np.log(np.exp(part - top).mean(axis=1)) + top for part in likeness]
    back = np.log(sum(np.exp(part - top).sum(axis=0) for part in likeness) / len(source)) + top
    found = []
    for block, part, own in zip(blocks, likeness, forth, strict=True):
        ratio = part - (own[:, None] + back) / 2
        row, column = np.nonzero(ratio > LEAST_LOG_RATIO)
        weight = np.log1p(TRUSTED * np.expm1(ratio[row, column]))
        found.append((row + block.start, column, weight))
    s, t, w = (np.concatenate(parts) for parts in zip(*found, strict=True))
    count = len(source) * len(target)
    mean = float(w.sum(dtype=np.float64)) / count
    variance = float((w.astype(np.float64) ** 2).sum()) / count - mean**2
    return _Pairs(s.astype(np.int32), t.astype(np.int32), w.astype(np.float32), mean, variance)


def _peaks(one: TurnedPlaces, pairs: _Pairs, target: Places, middle: Floats, half: float) -> Iterator[Pose]:
    """Yield the strongest shifts of every yaw of an orientation as poses of the middle."""
    # takes half a second, which a search that asks no network does not wait for
    import scipy.fft

    if not len(pairs.weight) or pairs.variance <= 0.0:
        return
    edge = target.step_m / 2
    centre = (target.at.min(axis=0) + target.at.max(axis=0)) / 2
    offset, place = one.places.at - middle, target.at - centre
    reach = int((np.hypot(*offset.T).max() + np.hypot(*place.T).max()) / edge) + 2
    bins = 2 * reach + 2
    size = scipy.fft.next_fast_len(2 * bins, real=True)

    def counted(flat: NDArray[np.int64], weight: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
        counts = np.bincount(flat, weight, minlength=bins * bins)[: bins * bins].reshape(bins, bins)
        return np.asarray(counts, np.float32)

    def binned(places: Floats) -> NDArray[np.int64]:
        column, row = (np.floor(places / edge).astype(np.int64) + reach).T
        return np.asarray(row * bins + column)

    there = binned(place)
    spectrum = scipy.fft.rfft2(counted(there), (size, size))
    # of a sum of two bins: where it lies among the bins of shifts
    there = there[pairs.target] - reach * (bins + 1)
    pairs_of_place = np.bincount(pairs.source, minlength=len(offset))
    fewest = FEWEST_PAIRS * (edge / target.step_m) ** 2
    around = round(2 * APART_STEPS)
    steps = max(1, round(2 * half / np.radians(YAW_STEP_DEG)))
    for k in range(steps):
        yaw = one.turn - half + (k + 0.5) * 2 * half / steps
        own = binned(-offset @ transforms.yaw_matrix(yaw)[:2, :2].T)
        votes = counted(there + np.repeat(own, pairs_of_place), pairs.weight)
        common = scipy.fft.irfft2(spectrum * scipy.fft.rfft2(counted(own), (size, size)), (size, size))
        common = common[reach : reach + bins, reach : reach + bins]
        votes, common = (cv2.GaussianBlur(x.astype(np.float32), (0, 0), 1.0) for x in (votes, common))
        spread = np.sqrt(pairs.variance * SMOOTHING * np.maximum(common, fewest))
        strength = (votes - pairs.mean * np.maximum(common, 0.0)) / spread
        for _ in range(PEAKS):
            row, column = divmod(int(strength.argmax()), bins)
            value = float(strength[row, column])
            if value <= 0.0:
                break
            # each of the two that make a shift was rounded down by half a bin on average
            east, north = (np.array([column, row]) + 1.0 - reach) * edge + centre
            yield Pose(yaw, float(east), float(north), value)
            strength[
                max(row - around, 0) : row + around + 1, max(column - around, 0) : column + around + 1
            ] = 0.0


def _fitted(pose: Pose, source: Places, pairs: _Pairs, target: Places, middle: Floats) -> Floats:
    """Fit a pose to the pairs of places near it, each weighted by what it says and how near it is."""
    R = transforms.yaw_matrix(pose.yaw)
    T = transforms.compose(R, np.append(np.array([pose.east, pose.north]) - R[:2, :2] @ middle, 0.0))
    moved = source.at @ T[:2, :2].T + T[:2, 3]
    near = np.abs(moved[pairs.source] - target.at[pairs.target]).max(axis=1) < 2.0 * target.step_m
    s, t = source.at[pairs.source[near]], target.at[pairs.target[near]]
    for _ in range(ROUNDS):
        gap = np.hypot(*(s @ T[:2, :2].T + T[:2, 3] - t).T)
        weight = pairs.weight[near] * np.exp(-0.5 * (gap / target.step_m) ** 2)
        if (weight > 0.0).sum() < 2:
            break
        T = fit_upright(s, t, weight)
    return T
