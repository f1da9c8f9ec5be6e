"""Hypotheses judged at the finest cells, and the pool in which they are ranked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import Mask
from mtpcr_geo.core.statistics import chance_within, neg_log10_p
from mtpcr_geo.match.base import margin_of
from mtpcr_geo.match.patches import PatchMatches
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.match.terrain import GroundComparison
from mtpcr_geo.method.scales import Scales

RADIUS_TOLERANCES = 4.0
"""How far the final patch matches may lie from where the pose puts them, tolerances."""
AGREE_TOLERANCES = 1.5
SAME_YAW_DEG = 5.0
GROUND_SCALE_M = 0.1
"""Spread of the ground's height differences, beyond the least of all hypotheses, that halves a strength."""


@dataclass(frozen=True)
class Candidate:
    """A hypothesis followed down to the finest cells.

    Attributes:
        pose: about the fine source raster's centre, with its score there.
        patches: local matches under it, where it was judged by them.
        supporting: (n,) patches that agree on one pose.
        ground: how the shapes of both grounds compare under it.
        complete: whether it was judged at the finest cells; else its patches are those of a first look, on
            the rasters of a coarser level.

    """

    pose: Pose
    patches: PatchMatches | None = None
    supporting: Mask | None = None
    ground: GroundComparison | None = None
    complete: bool = True

    @property
    def support(self) -> float:
        """Share of all patches tried that agree on one pose, less the two that any pose can please."""
        if self.patches is None or self.supporting is None:
            return 0.0
        return max(float(self.supporting.sum()) - 2.0, 0.0) / max(self.patches.patches, 8)

    @property
    def neg_log10_p(self) -> float:
        """Minus log10 of the probability that so many of the matched patches agree by chance."""
        if self.patches is None or self.supporting is None:
            return 0.0
        agreeing = max(int(self.supporting.sum()) - 2, 0)
        chance = chance_within(AGREE_TOLERANCES, RADIUS_TOLERANCES - 0.5)
        return neg_log10_p(agreeing, len(self.patches), chance)

    @property
    def strength(self) -> float:
        """Score times support: what hypotheses are ranked by, before the ground is asked.

        Repetitive scenes give high scores to wrong poses with a large overlap; their patches disagree.
        """
        return self.pose.score * self.support


@dataclass(frozen=True)
class Pool:
    """Judged hypotheses, best first.

    Attributes:
        candidates: the hypotheses.
        strengths: of each: score times support, times how well the ground agrees.
        bound: no hypothesis left unjudged is stronger than this.

    """

    candidates: tuple[Candidate, ...] = ()
    strengths: tuple[float, ...] = ()
    bound: float = 0.0

    @classmethod
    def of(cls, candidates: Sequence[Candidate], scales: Scales, bound: float = 0.0) -> Pool:
        """Rank candidates by strength and the ground, and join those that came down to the same place."""
        least = least_spread(candidates)
        ranked = [(weighed(c, least), c) for c in candidates]
        ranked.sort(key=lambda one: (-one[0], -one[1].pose.score))
        kept: list[tuple[float, Candidate]] = []
        for strength, candidate in ranked:
            if not any(
                same_pose(candidate.pose, other.pose, scales.same_pose_m, scales.extent_m / 2)
                for _, other in kept
            ):
                kept.append((strength, candidate))
        return cls(tuple(c for _, c in kept), tuple(s for s, _ in kept), bound)

    @property
    def margin(self) -> float:
        """Strength of the best over that of the next distinct hypothesis, at least."""
        return margin_of(self.strengths, floor=self.bound)

    def over(self, other: Pool) -> float:
        """Return the strength of the best over the greatest of another pool, at least.

        The ground weighs in both alike, held against the least spread of either: a lattice of rows fits the
        rows of its mirror image as well as its own, but not the terrain beneath.
        """
        mine, theirs = (
            [c for c in pool.candidates if c.ground is not None and c.ground.known] for pool in (self, other)
        )
        least = min(least_spread(mine), least_spread(theirs)) if mine and theirs else None
        if least is None:
            best, rivals = self.candidates[0].strength, [c.strength for c in other.candidates]
        else:
            best = weighed(self.candidates[0], least)
            rivals = [weighed(c, least) for c in other.candidates]
        return margin_of([best, max(rivals, default=0.0)], floor=other.bound)


def weighed(candidate: Candidate, least_m: float) -> float:
    """Return a hypothesis' strength, times how well the ground agrees.

    Args:
        candidate: the hypothesis.
        least_m: least spread of the ground's height differences of all hypotheses, metres.

    """
    return candidate.strength * _ground_factor(candidate.ground, least_m)


def least_spread(candidates: Sequence[Candidate]) -> float:
    """Return the least spread of the ground's height differences of all candidates, metres; 0 if unknown."""
    known = [c.ground.spread_m for c in candidates if c.ground is not None and c.ground.known]
    return min(known, default=0.0)


def _ground_factor(ground: GroundComparison | None, least_m: float) -> float:
    """Return 1 where the grounds agree as well as they do anywhere, less where they differ in shape."""
    scale = GROUND_SCALE_M + least_m
    full = 1.0 + (least_m / scale) ** 2
    if ground is None or not ground.known:
        return 0.5 * full
    return full / (1.0 + (ground.spread_m / scale) ** 2)


def same_pose(a: Pose, b: Pose, apart_m: float, radius_m: float) -> bool:
    """Return whether two poses are one: near in place, and in yaw or in what it moves at the rim."""
    angle = angle_between(a.yaw, b.yaw)
    near = float(np.hypot(a.east - b.east, a.north - b.north)) < apart_m
    return near and (angle < np.radians(SAME_YAW_DEG) or angle * radius_m < apart_m)
