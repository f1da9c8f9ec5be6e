"""Poses by vote: every keypoint votes with its likeliest partners, and the yaw and shift of most votes wins.

Between a view from the ground and one from the air few keypoints have their partner for nearest descriptor,
but many have it among the nearest ten. With cells in metres and a known vertical only a yaw and a shift are
sought, so that all these candidates can be counted at once: wrong ones spread over all shifts, right ones
fall on one (a generalised Hough transform; Ballard 1981, doi:10.1016/0031-3203(81)90009-1). Consensus among
mutual nearest neighbours alone loses such poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.base import TOLERATED_DEG, Features, PixelMatches, one_to_one
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.search import angle_between, distinct
from mtpcr_geo.method.solve import fit_upright

YAW_STEPS_DEG = (0.5, 3.0)
"""Finest and coarsest step between yaws; between them it moves keypoints by the tolerance."""
MOST_BINS = 1000
"""Bins of shifts along an edge at most; where clouds are larger the bins grow."""
PEAKS = 3
"""Shifts of most votes that are kept of each yaw."""
EXAMINED = 24
"""Distinct poses of most votes whose votes are counted one to one."""
APART_DEG, APART_TOLERANCES = 5.0, 8.0
"""Two poses are distinct where they turn or move the source's keypoints apart by more than this."""
KEPT = 8
"""Poses handed on."""
ROUNDS = 5
LEAST_STRENGTH = 6.0
"""Agreeing pairs that the next pose counts at least: of a handful one more or less is chance."""


@dataclass(frozen=True)
class Candidates:
    """The candidates of one orientation of the source.

    Attributes:
        turn: radians by which the source's image was turned, counter-clockwise.
        source_px: (n, 2) keypoints, pixels of the unturned image.
        source: (n, 2) the same, metres.
        partner: (n, k) indices of the target's keypoints with the nearest descriptors.
        likeness: (n, k) cosines of the descriptors.

    """

    turn: float
    source_px: Floats
    source: Floats
    partner: NDArray[np.int64]
    likeness: Floats


@dataclass(frozen=True)
class VotedPose:
    """A pose and the candidates that agree on it.

    Attributes:
        T: 4x4 planar pose, metres.
        found: one-to-one pairs that agree, pixels of the unturned images.
        likelihood: what speaks for it beyond the pairs, see `mtpcr_geo.match.likelihood`; None if not asked.

    """

    T: Floats
    found: PixelMatches
    likelihood: float | None = None

    @property
    def strength(self) -> float:
        """Return how many pairs agree, less the two that always do; its geometric mean with a likelihood."""
        return self._weighed(max(len(self.found) - 2.0, 0.0))

    @property
    def as_rival(self) -> float:
        """Return the strength that another pose is held against: of a handful of pairs one more is chance."""
        return self._weighed(max(len(self.found) - 2.0, LEAST_STRENGTH))

    def _weighed(self, agreeing: float) -> float:
        # the mean, so that a margin of these is one like those of other matchers
        return agreeing if self.likelihood is None else float(np.sqrt(agreeing * self.likelihood))


def agreeing_keypoints(one: Candidates, T: Floats, target: Floats, tolerance: float) -> int:
    """Count the keypoints of an orientation of which a candidate agrees with a pose.

    Args:
        one: the candidates.
        T: 4x4 planar pose, metres.
        target: (m, 2) keypoints of the target, metres.
        tolerance: plan distance within which candidates agree, metres.

    """
    moved = one.source @ T[:2, :2].T + T[:2, 3]
    gap = np.linalg.norm(target[one.partner] - moved[:, None], axis=2)
    return int((gap < tolerance).any(axis=1).sum())


def candidates_of(
    turn: float, source: Features, source_px: Floats, target: Features, grid: Grid, candidates: int
) -> Candidates:
    """Find the candidates of the keypoints of one orientation.

    Args:
        turn: radians by which the source's image was turned.
        source: its keypoints, with descriptors of unit length.
        source_px: (n, 2) where they lie in the unturned image, pixels.
        target: the target's keypoints.
        grid: of the source.
        candidates: partners of a keypoint.

    """
    k = min(candidates, len(target))
    if not len(source) or not k:
        none = np.empty((len(source), 0))
        return Candidates(turn, source_px, grid.to_metres(source_px), none.astype(np.int64), none)
    likeness = np.asarray(source.descriptors @ target.descriptors.T, np.float64)
    some = np.sort(np.argpartition(-likeness, k - 1, axis=1)[:, :k], axis=1)
    order = np.argsort(-np.take_along_axis(likeness, some, axis=1), axis=1, kind="stable")
    partner = np.take_along_axis(some, order, axis=1)
    return Candidates(
        turn, source_px, grid.to_metres(source_px), partner, np.take_along_axis(likeness, partner, axis=1)
    )


def poses_by_votes(
    orientations: Sequence[Candidates], target_px: Floats, grid: Grid, tolerance: float, most: int = KEPT
) -> list[VotedPose]:
    """Find the poses on which most candidates agree.

    Args:
        orientations: the candidates of each orientation tried.
        target_px: (m, 2) keypoints of the target, pixels.
        grid: of the target.
        tolerance: plan distance within which candidates agree, metres.
        most: poses returned.

    Returns:
        Distinct poses, those first that most pairs agree on, counted one to one.

    """
    target = grid.to_metres(target_px)
    places = np.concatenate([one.source for one in orientations])
    if not len(places) or not len(target):
        return []
    middle = places.mean(axis=0)
    peaks = sorted(_peaks(orientations, target, middle, tolerance), key=lambda pose: -pose.score)
    turned, apart = np.radians(APART_DEG), APART_TOLERANCES * tolerance
    counted = [
        _count(orientations, target_px, target, grid, pose, middle, tolerance)
        for pose in distinct(peaks, EXAMINED, turned, apart)
    ]
    counted.sort(key=lambda one: -len(one.found))
    by_pose = {_about(middle, one): one for one in counted}
    return [by_pose[pose] for pose in distinct(by_pose, most, turned, apart)]


def votes_for(
    poses: Sequence[Floats],
    orientations: Sequence[Candidates],
    target_px: Floats,
    grid: Grid,
    tolerance: float,
) -> list[VotedPose]:
    """Find the candidates that agree on given poses, which stay as they are.

    A pose that was fitted to thousands of places is better than what some dozens of keypoints make of it.

    Args:
        poses: 4x4 planar poses, metres.
        orientations: the candidates of each orientation tried.
        target_px: (m, 2) keypoints of the target, pixels.
        grid: of the target.
        tolerance: plan distance within which candidates agree, metres.

    Returns:
        What was found of each pose, in the order given.

    """
    target, origin = grid.to_metres(target_px), np.zeros(2)
    return [
        _count(
            orientations, target_px, target, grid,
            Pose(transforms.yaw_of(T[:3, :3]), float(T[0, 3]), float(T[1, 3])), origin, tolerance, 0,
        )
        for T in poses
    ]  # fmt: skip


def strengths_of(voted: Sequence[VotedPose]) -> list[float]:
    """Return the strength of each pose."""
    return [one.strength for one in voted]


def _peaks(
    orientations: Sequence[Candidates], target: Floats, middle: Floats, tolerance: float
) -> Iterator[Pose]:
    """Yield the strongest shifts of every yaw as poses of the middle, scored by their votes."""
    offsets = [one.source - middle for one in orientations]
    far = np.concatenate([np.hypot(*one.T) for one in offsets])
    finest, coarsest = YAW_STEPS_DEG
    step = np.clip(np.degrees(tolerance / max(float(np.quantile(far, 0.9)), 1e-6)), finest, coarsest)
    centre = (target.min(axis=0) + target.max(axis=0)) / 2
    radius = float(far.max()) + float(np.hypot(*(target - centre).T).max()) + tolerance
    edge = max(tolerance, 2 * radius / MOST_BINS)
    bins = int(2 * radius / edge) + 2
    around = round(APART_TOLERANCES * tolerance / edge)
    count = int(np.ceil(360.0 / step))
    for yaw in 2 * np.pi * np.arange(count) / count:
        R = transforms.yaw_matrix(float(yaw))[:2, :2]
        votes = np.zeros(bins * bins)
        for one, offset in zip(orientations, offsets, strict=True):
            if angle_between(one.turn, float(yaw)) > np.radians(TOLERATED_DEG) or not one.partner.size:
                continue
            shift = (target - centre)[one.partner] - (offset @ R.T)[:, None]
            column, row = np.floor((shift + radius) / edge).astype(np.int64).reshape(-1, 2).T
            votes += np.bincount(row * bins + column, minlength=bins * bins)
        if not votes.any():
            continue
        # windows of two bins, so that no peak is split between all it falls into
        summed = cv2.boxFilter(
            votes.reshape(bins, bins).astype(np.float32), -1, (2, 2), normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )  # fmt: skip
        for _ in range(PEAKS):
            row, column = divmod(int(summed.argmax()), bins)
            # the window of a bin ends with it
            place = np.array([column, row]) * edge - radius + centre
            yield Pose(float(yaw), float(place[0]), float(place[1]), float(summed[row, column]), 0)
            summed[max(row - around, 0) : row + around + 1, max(column - around, 0) : column + around + 1] = 0


def _about(middle: Floats, one: VotedPose) -> Pose:
    """Return a pose by where it puts the middle of the source's keypoints."""
    place = one.T[:2, :2] @ middle + one.T[:2, 3]
    return Pose(transforms.yaw_of(one.T[:3, :3]), float(place[0]), float(place[1]), float(len(one.found)), 0)


def _count(
    orientations: Sequence[Candidates],
    target_px: Floats,
    target: Floats,
    grid: Grid,
    pose: Pose,
    middle: Floats,
    tolerance: float,
    rounds: int = ROUNDS,
) -> VotedPose:
    """Fit a pose to the candidates near it, and count those that agree one to one."""
    yaw = pose.yaw
    shift = np.array([pose.east, pose.north]) - transforms.yaw_matrix(yaw)[:2, :2] @ middle
    near = [one for one in orientations if angle_between(one.turn, yaw) <= np.radians(TOLERATED_DEG)]
    # a pose that was fitted elsewhere may lie just beyond the only orientation
    near = near or [min(orientations, key=lambda one: angle_between(one.turn, yaw))]
    k = [one.partner.shape[1] for one in near]
    s = np.concatenate([np.repeat(one.source, n, axis=0) for one, n in zip(near, k, strict=True)])
    s_px = np.concatenate([np.repeat(one.source_px, n, axis=0) for one, n in zip(near, k, strict=True)])
    partner = np.concatenate([one.partner.ravel() for one in near])
    likeness = np.concatenate([one.likeness.ravel() for one in near])
    t = target[partner]
    T = transforms.compose(transforms.yaw_matrix(yaw), np.append(shift, 0.0))
    reach = 2.0 * tolerance
    agreeing = np.zeros(len(s), bool)
    for _ in range(rounds):
        gap = np.hypot(*(s @ T[:2, :2].T + T[:2, 3] - t).T)
        now = gap < reach
        if now.sum() < 2 or (reach == tolerance and (now == agreeing).all()):
            break
        agreeing = now
        T = fit_upright(s[agreeing], t[agreeing])
        reach = tolerance
    agreeing = np.hypot(*(s @ T[:2, :2].T + T[:2, 3] - t).T) < tolerance
    pairs = PixelMatches(s_px[agreeing], target_px[partner[agreeing]], np.clip(likeness[agreeing], 0.0, 1.0))
    return VotedPose(T, one_to_one(pairs, tolerance / grid.cell))
