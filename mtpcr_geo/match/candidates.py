"""Hypotheses judged at the finest cells, and the pool in which they are ranked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mtpcr_geo.core.arrays import Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.statistics import chance_within, neg_log10_p
from mtpcr_geo.match.base import LARGEST_MARGIN, margin_of
from mtpcr_geo.match.patches import PatchMatches
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.match.terrain import GroundComparison
from mtpcr_geo.method.scales import Scales

RADIUS_TOLERANCES = 4.0
"""How far the final patch matches may lie from where the pose puts them, tolerances."""
AGREE_TOLERANCES = 1.5
SAME_YAW_DEG = 5.0
GROUND_SCALE_M = 0.05
"""Spread of the ground's height differences that borders of cells and noise cause, and that says nothing."""
MOST_BY_RELIEF = 400.0
"""Times at most by which a pose may be likelier for how much less the grounds differ than they vary: a
twentieth of the relief is left then."""
HALF_POWER_TIMES_FEWEST = 5.0
"""Times the fewest cells that are ground enough to compare: with these its logarithm counts by half."""


LEAST_BY_ITSELF = 0.5
"""Share of the greatest strength, the ground left out, with which the best hypothesis may end a search."""


CLEARLY_BEYOND = 1.3
"""Times that a pose beyond a prior is stronger than all within it, from which on the prior does not hold: the
margin that a pose must have over others to be accepted."""


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
        strengths: of the best, score times support, times how well the ground agrees; of each other, that
            over how many times stronger the best one is, see `GroundWeights.ratio`.
        bound: no hypothesis left unjudged is stronger than this.

    """

    candidates: tuple[Candidate, ...] = ()
    strengths: tuple[float, ...] = ()
    bound: float = 0.0

    @classmethod
    def of(cls, candidates: Sequence[Candidate], scales: Scales, bound: float = 0.0) -> Pool:
        """Rank candidates by strength and the ground, and join those that came down to the same place."""
        ground = GroundWeights.of(candidates)
        kept: list[Candidate] = []
        for candidate in sorted(candidates, key=lambda c: (-ground.weighed(c), -c.pose.score)):
            if not any(
                same_pose(candidate.pose, other.pose, scales.same_pose_m, scales.extent_m / 2)
                for other in kept
            ):
                kept.append(candidate)
        if not kept:
            return cls(bound=bound)
        best = kept[0]
        most = ground.weighed(best)
        others = [(most / max(ground.ratio(best, other), 1.0), other) for other in kept[1:]]
        others.sort(key=lambda one: -one[0])
        return cls((best, *(c for _, c in others)), (most, *(s for s, _ in others)), bound)

    @property
    def margin(self) -> float:
        """Strength of the best over that of the next distinct hypothesis, at least."""
        return margin_of(self.strengths, floor=self.bound)

    def by_itself(self, judged: Sequence[Candidate]) -> bool:
        """Return whether the best hypothesis is among the strongest that were judged, the ground left out."""
        most = max((candidate.strength for candidate in judged), default=0.0)
        return bool(self.candidates) and self.candidates[0].strength >= LEAST_BY_ITSELF * most

    def over(self, other: Pool) -> float:
        """Return the strength of the best over the greatest of another pool, at least.

        The ground weighs in both alike, held against the best of either: a lattice of rows fits the rows of
        its mirror image as well as its own, but not the terrain beneath.
        """
        best = self.candidates[0]
        if all(any(_known(c) for c in pool.candidates) for pool in (self, other)):
            ground = GroundWeights.of([*self.candidates, *other.candidates])
        else:
            ground = GroundWeights(unseen=True)
        ratio = min((ground.ratio(best, c) for c in other.candidates), default=LARGEST_MARGIN)
        if other.bound > 0.0 and best.strength > 0.0:
            ratio = min(ratio, ground.weighed(best) / other.bound)
        return ratio


@dataclass(frozen=True)
class GroundWeights:
    """How the ground weighs hypotheses of one search against each other.

    Under the right pose both grounds differ by noise, by what grew, and by what either cloud did not see: by
    about as much as they do under the best hypothesis. Under a wrong one they differ by as much as they vary.
    Of Gaussian heights with n independent places the likelihood of either is a power of the variance. A
    strength is multiplied by the first over the second, and by how much less a pose lets them differ than
    they vary, so that flat ground, which fits anywhere, tells nothing, and steep ground that fits tells most.
    A slope that lies on a slope is one coincidence: what they vary by is the geometric mean of that and of
    what is left beside their own planes. The power of a variance is one at most, since neighbouring heights
    go together, and less where few cells are compared, of which some agree by luck; ground that is not seen
    tells nothing.

    How many times stronger the best one is counts the second factor alone, or both if that is less: that
    others lie on ground unlike the source's speaks against these, not for the best. On the one flat place of
    a hilly site whatever is flat beats all that was found beside it.

    Attributes:
        least_m: least spread of the ground's height differences of all hypotheses, metres; 0 if unknown.
        most: what the ground tells at most of any hypothesis.
        unseen: whether the ground is left out.

    """

    least_m: float = 0.0
    most: float = 1.0
    unseen: bool = False

    @classmethod
    def of(cls, candidates: Sequence[Candidate]) -> GroundWeights:
        """Weigh by the ground of all candidates of a search."""
        known = [c.ground for c in candidates if c.ground is not None and c.ground.known]
        if not known:
            return cls()
        weights = cls(min(one.spread_m for one in known))
        return replace(weights, most=max(weights.factor(c.ground) for c in candidates))

    def weighed(self, candidate: Candidate) -> float:
        """Return a hypothesis' strength times its weight, which is 1 at most."""
        return candidate.strength * self.factor(candidate.ground)

    def ratio(self, best: Candidate, other: Candidate) -> float:
        """Return how many times stronger one hypothesis is than another, `LARGEST_MARGIN` at most."""
        if best.strength <= 0.0:
            return 1.0
        if other.strength <= 0.0:
            return LARGEST_MARGIN
        (by_spread, by_relief), (spread_of_other, relief_of_other) = (
            self._likelihoods(one.ground) for one in (best, other)
        )
        both = by_spread * by_relief / (spread_of_other * relief_of_other)
        return min(min(both, by_relief / relief_of_other) * best.strength / other.strength, LARGEST_MARGIN)

    def factor(self, ground: GroundComparison | None) -> float:
        """Return the weight of a comparison of both grounds, 0 to 1."""
        by_spread, by_relief = self._likelihoods(ground)
        return by_spread * by_relief / self.most

    def _likelihoods(self, ground: GroundComparison | None) -> tuple[float, float]:
        """Return what the spread tells beside the least of all, and what it tells beside the relief."""
        if ground is None or not ground.known or self.unseen:
            return 1.0, 1.0
        noise = GROUND_SCALE_M**2
        differ = noise + ground.spread_m**2
        power = ground.cells / (ground.cells + HALF_POWER_TIMES_FEWEST * ground.fewest)
        beside_least = (noise + self.least_m**2) / differ
        relief = np.sqrt((noise + ground.relief_m**2) * (noise + ground.beyond_plane_m**2))
        beside_relief = float(np.clip(relief / differ, 1.0, MOST_BY_RELIEF))
        return float(beside_least**power), beside_relief**power


def _known(candidate: Candidate) -> bool:
    return candidate.ground is not None and candidate.ground.known


def held_to(prior: Prior | None, judged: list[Candidate], grid: Grid, slack_m: float) -> list[Candidate]:
    """Return the candidates that lie within a prior; all where it holds nothing, or is clearly wrong.

    Poses leave its range where they are followed down and combed for. Along rows of trees or panels they come
    to the next one, which fits as well, and is no rival of what is known to lie elsewhere. Where what lies
    beyond fits clearly better than all within, it is the prior that is wrong: that is for the verdict to say.

    Args:
        prior: what is known beforehand.
        judged: candidates.
        grid: of the source's raster, about whose centre poses are.
        slack_m: see `Prior.allows`.

    """
    if prior is None or not prior.holds:
        return judged
    within = [one for one in judged if prior.allows(one.pose, grid, slack_m)]
    ground = GroundWeights.of(judged)
    best, most = (max((ground.weighed(one) for one in some), default=0.0) for some in (within, judged))
    return within if within and CLEARLY_BEYOND * best >= most else judged


def same_pose(a: Pose, b: Pose, apart_m: float, radius_m: float) -> bool:
    """Return whether two poses are one: near in place, and in yaw or in what it moves at the rim."""
    angle = angle_between(a.yaw, b.yaw)
    near = float(np.hypot(a.east - b.east, a.north - b.north)) < apart_m
    return near and (angle < np.radians(SAME_YAW_DEG) or angle * radius_m < apart_m)
