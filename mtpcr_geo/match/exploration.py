"""Exploring the levels of a search: proposing, following down, judging and ranking hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.candidates import Candidate, Pool, held_to, same_pose
from mtpcr_geo.match.descent import comb, comb_each, follow
from mtpcr_geo.match.judge import CLEAR_MARGIN, Judge
from mtpcr_geo.match.nearby import score_nearby
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.pyramid import Level, Pyramid
from mtpcr_geo.match.repetition import REPEATS, self_likeness
from mtpcr_geo.match.search import GlobalSearch, Layer, all_yaws, distinct
from mtpcr_geo.match.terrain import Terrain, cell_to_compare
from mtpcr_geo.match.terrain_search import propose
from mtpcr_geo.method.ground import bare
from mtpcr_geo.method.scales import Scales, tolerance_for

COARSEST_YAW_STEP_DEG, FINEST_YAW_STEP_DEG = 4.0, 2.0
FEWEST_OVERLAP_CELLS = 20
PEAKS_A_YAW = 3
HYPOTHESES, MORE_HYPOTHESES = 10, 48
"""Hypotheses of a level followed at first, and at most where these do not convince: a small source has more
places to lie in a large target, and each costs less to follow."""
TERRAIN_HYPOTHESES, MORE_TERRAIN_HYPOTHESES = 6, 16
MIRRORED_HYPOTHESES = 24
"""Hypotheses of a level of the mirrored search followed at first: where a scene repeats itself many score
alike, and the best of them must be met."""
SMALL_SITE_NEG_LOG10_P, SMALL_SITE_MARGIN, SMALL_SITE_SUPPORT = 8.0, 3.0, 0.5
"""What convinces where there are too few patches for `CorrelationSettings.convincing_neg_log10_p`."""
CONVINCING_SPREAD_M = 0.5
"""Spread of the grounds' height differences above which a pose does not convince by itself: roofs and crops
spread them so, and so does another row of the same houses."""
PROMISING_NEG_LOG10_P, CONVINCING_NULL_RATIO = 4.0, 2.0
"""Significance from which the mirrored source is asked before finer levels are searched, and the strength
over it that ends the search: wrong poses have reached 1.5."""
LEAST_SUPPORT_OF_ROWS = 0.5
"""Share of its patches that agree with which the best hypothesis may end the search of a scene that repeats
itself."""
CLEAR_LEAD = 3.0
"""Strength over the next distinct pose, and over the mirrored source's best, that ends the search of a scene
that does not repeat itself before the terrain is asked."""


@dataclass(frozen=True)
class CorrelationSettings:
    """What governs the search; lengths that are None follow from the data, see `mtpcr_geo.method.scales`.

    Attributes:
        yaw_step_deg: step of the search over all yaws.
        patch_m: edge of a patch of the local matches, metres.
        search_radius_m: how far a patch may lie from where the hypothesis puts it, metres.
        min_overlap_m2: smallest overlap considered, square metres.
        min_overlap_share: smallest overlap considered, as a share of the smaller raster.
        convincing_margin: best over next distinct strength that ends the search.
        convincing_neg_log10_p: significance of its patches' agreement that ends it. Streets that run
            alike have given 11 to a pose 120 m off, where the true one had 48.
        mirrored_null: search the mirrored source too.
        trust_vertical: whether both verticals are known, so that the terrains may differ by a shift alone.
        proposals: who proposes further poses where the search does not settle; None for nobody.

    """

    yaw_step_deg: float | None = None
    patch_m: float | None = None
    search_radius_m: float | None = None
    min_overlap_m2: float | None = None
    min_overlap_share: float = 0.03
    convincing_margin: float = 1.5
    convincing_neg_log10_p: float = 20.0
    mirrored_null: bool = True
    trust_vertical: bool = True
    proposals: Proposals | None = None


class Proposals(Protocol):
    """Proposes poses by other means than the search's own."""

    def poses(self, source: Bev, target: Bev) -> list[Hypothesis]:
        """Propose poses of the source over the target, both levelled rasters of one cell, best first."""


@dataclass(frozen=True)
class Step:
    """One step of a search.

    Attributes:
        factor: the level's cell as a multiple of the finest.
        part: 0 for the level's best hypotheses, 1 for its others.
        by: what proposes: height and step edges (the channels of the search), the terrain, or
            `CorrelationSettings.proposals`.

    """

    factor: int
    part: int
    by: Literal["channels", "terrain", "proposals"] = "channels"

    @property
    def by_terrain(self) -> bool:
        """Return whether the terrain proposes."""
        return self.by == "terrain"


def steps_of(factors: list[int]) -> Iterator[Step]:
    """Give the steps of a search in order: the terrain is asked on the first level.

    Args:
        factors: cells of the levels, as multiples of the finest, coarsest first.

    """
    for number, factor in enumerate(factors):
        for part in (0, 1):
            yield Step(factor, part)
            if number == 0:
                yield Step(factor, part, "terrain")


def proposing(factors: list[int]) -> Step:
    """Return the step by which others propose, after all of `steps_of`."""
    return Step(factors[len(factors) // 2], 0, "proposals")


class Exploration:
    """Explores the levels of one source against one target, part by part."""

    def __init__(
        self,
        source: Bev,
        target: Bev,
        scales: Scales,
        settings: CorrelationSettings,
        seed: int,
        advance: Callable[[int], object],
        prior: Prior | None = None,
        beside: Exploration | None = None,
        first: int = HYPOTHESES,
        grounds: tuple[Bev, Bev] | None = None,
    ) -> None:
        self.pyramid: Pyramid = Pyramid(source, target, None if beside is None else beside.pyramid)
        self.scales, self.settings, self.advance, self.prior = scales, settings, advance, prior
        self.bare: tuple[Bev, Bev] = grounds or (
            bare(source),
            bare(target) if beside is None else beside.bare[1],
        )
        self.ground_cell_m: float = (
            cell_to_compare(*self.bare, scales.terrain_cell_m) if beside is None else beside.ground_cell_m
        )
        self.terrain: tuple[Terrain, Terrain] = (
            Terrain.of(self.bare[0], self.ground_cell_m),
            Terrain.of(self.bare[1], self.ground_cell_m) if beside is None else beside.terrain[1],
        )
        self.judge = Judge(
            self.pyramid,
            self.terrain,
            scales,
            patch_m=scales.patch_m if settings.patch_m is None else settings.patch_m,
            search_radius_m=scales.search_radius_m
            if settings.search_radius_m is None
            else settings.search_radius_m,
            trust_vertical=settings.trust_vertical,
            seed=seed,
        )
        room = target.grid.width * target.grid.height / max(source.grid.width * source.grid.height, 1)
        self.first = first
        self.most = int(np.clip(HYPOTHESES * room, first, MORE_HYPOTHESES))
        self.levels: list[Level] = []
        self.done: list[Step] = []
        self.judged: list[Candidate] = []
        self.pool = Pool()
        self.proposed = False
        self._left: list[Pose] = []
        self._known, self._bound = 0.0, 0.0
        self._proposed: dict[int, list[Pose]] = {}
        self._followed: list[Pose] = []
        self._likeness: tuple[Pose, float] | None = None

    def explore(self, step: Step, known: float = 0.0) -> bool:
        """Propose by one step of the search, follow what it proposes down to the finest cells and judge it.

        Args:
            step: the step.
            known: strength that matters; what cannot come within `CLEAR_MARGIN` of it is not followed.

        Returns:
            Whether anything was proposed.

        """
        first = not self.done
        self.done.append(step)
        given_known, known = known, max([known, *self.pool.strengths[:1]])
        best = self.pool.candidates[:1]
        if step.by == "proposals":
            poses, bound = self._by_proposals(step), 0.0
        elif step.by_terrain:
            poses, bound = self._by_terrain(step)
        else:
            poses, bound = self._by_channels(step, known)
            given = self.prior.pose(self.pyramid.at(1)[0].grid) if first and self.prior is not None else None
            poses += [] if given is None else self._nearby(step.factor, [given])
        if not poses:
            return False
        self._known, self._bound = max(self._known, given_known), max(self._bound, bound)
        self._judge(poses, known)
        if self.pool.candidates and (step.by != "channels" or self.repeats()):
            self._comb_about_the_best(known)
        self.proposed |= step.by == "proposals" and self.pool.candidates[:1] != best
        return True

    def _by_channels(self, step: Step, known: float) -> tuple[list[Pose], float]:
        """Return what height and step edges propose, at the finest cells, and a bound of what was left."""
        factor = step.factor
        if factor not in self._proposed:
            self._proposed[factor] = self._propose(factor)
            cell = self.pyramid.source.grid.cell * factor
            scores = tuple(round(pose.score, 3) for pose in self._proposed[factor])
            self.levels.append(Level(factor, cell, scores))
        proposed = self._proposed[factor]
        some = proposed[self.first :] if step.part else proposed[: self.first]
        if not some:
            return [], 0.0
        descent = follow(self.pyramid, factor, some, known / CLEAR_MARGIN)
        self._followed += descent.poses
        return list(descent.poses), descent.bound

    def _by_terrain(self, step: Step) -> tuple[list[Pose], float]:
        """Return what the terrains propose, at the finest cells, without what the channels had proposed."""
        share, count = (2, MORE_TERRAIN_HYPOTHESES) if step.part else (1, TERRAIN_HYPOTHESES)
        cell_m = self.scales.terrain_cell_m / share
        proposed = self._propose_by_terrain(cell_m, count, COARSEST_YAW_STEP_DEG / share)
        if step.part:
            more = self._propose_by_terrain(cell_m, TERRAIN_HYPOTHESES, COARSEST_YAW_STEP_DEG, robustly=True)
            proposed = distinct([*proposed, *more], len(proposed) + len(more), np.radians(1.0), cell_m / 2)
        others = self._others(proposed)
        # where crowns of other years fit better a few metres off, the ground knows the place; but strengths
        # are made of the channels' score, and not of the ground's evidence
        there = [score_nearby(*self.pyramid.at(1), pose, 1)[0] for pose in others]
        return [*there, *self._nearby(step.factor, others)], 0.0

    def _by_proposals(self, step: Step) -> list[Pose]:
        """Return what others propose, at the finest cells, without what the channels had proposed."""
        assert self.settings.proposals is not None
        centre = centre_of(self.pyramid.source.grid)
        found = self.settings.proposals.poses(self.pyramid.source, self.pyramid.target)
        return self._nearby(step.factor, self._others([pose_of(one, centre) for one in found]))

    def _others(self, poses: list[Pose]) -> list[Pose]:
        """Keep the poses that are none of those that the channels had proposed."""
        near, radius = self.scales.same_pose_m / 2, self.scales.extent_m / 2
        return [
            pose
            for pose in poses
            if not any(same_pose(pose, other, near, radius) for other in self._followed)
        ]

    def _nearby(self, factor: int, poses: list[Pose]) -> list[Pose]:
        """Return the best places near poses that are some metres off, followed down and combed for.

        The lowest point of a cell shifts with the grid it lies on, and a prior is as good as it is.
        """
        descent = follow(self.pyramid, factor, self._on_level(factor, poses))
        return [*comb_each(self.pyramid, poses, self.scales.terrain_cell_m), *descent.poses]

    def _judge(self, poses: list[Pose], known: float) -> None:
        """Judge poses and rank; of what was left, judge what the best turned out not to be clear of.

        How much the ground takes off a strength is known only when another hypothesis shows how well the
        grounds can agree.
        """
        while True:
            now, left = self.judge.judge(poses, known, self.judged)
            self.judged += now
            self._left += left
            self._rank()
            known = max([self._known, *self.pool.strengths[:1]])
            poses = [pose for pose in self._left if pose.score * CLEAR_MARGIN >= known]
            if not poses:
                return
            self._left = [pose for pose in self._left if pose.score * CLEAR_MARGIN < known]

    def _rank(self) -> None:
        """Rank what was judged; the best is judged at the finest cells, if a first look had been enough."""
        bound = max([self._bound, *(pose.score for pose in self._left)])
        self.pool = Pool.of(self._among(), self.scales, bound)
        while self.pool.candidates and not self.pool.candidates[0].complete:
            best = self.pool.candidates[0]
            number = next(k for k, one in enumerate(self.judged) if one is best)
            self.judged[number] = self.judge.judge_one(best.pose)
            self.pool = Pool.of(self._among(), self.scales, bound)

    def _among(self) -> list[Candidate]:
        """Return what was judged, as far as the prior holds it."""
        slack = tolerance_for(self.scales.cell_m)
        return held_to(self.prior, self.judged, self.pyramid.source.grid, slack)

    def _comb_about_the_best(self, known: float) -> None:
        """Judge the best place near the best hypothesis too, where that is another."""
        best = self.pool.candidates[0].pose
        near = comb(self.pyramid, best, self.scales.terrain_cell_m)
        if near.score > best.score and not same_pose(
            near, best, self.scales.cell_m, self.scales.extent_m / 2
        ):
            self._judge([near], known)

    def catch_up(self, other: Exploration) -> None:
        """Search what another has searched, as far as it matters beside what that found."""
        known = max(other.pool.strengths[:1], default=0.0)
        for step in other.done[len(self.done) :]:
            if step.by == "proposals" and not other.proposed:
                # they made no difference there, and are dear
                self.done.append(step)
            else:
                self.explore(step, known)

    def repeats(self) -> bool:
        """Return whether the scene under the best hypothesis fits itself after a shift."""
        return self.likeness >= REPEATS

    @property
    def likeness(self) -> float:
        """Correlation of the scene under the best hypothesis with itself, see `self_likeness`."""
        if not self.pool.candidates:
            return 0.0
        pose = self.pool.candidates[0].pose
        if self._likeness is None or self._likeness[0] != pose:
            self._likeness = pose, self_likeness(*self.pyramid.at(1), pose)
        return self._likeness[1]

    def settles(self) -> bool:
        """Return whether nothing more need be searched.

        The best hypothesis convinces by itself; where the scene repeats itself, that counts once the terrain
        was asked too.
        """
        return self.convinces() and (self.asked_terrain or not self.repeats())

    def may_end_search(self) -> bool:
        """Return whether the best hypothesis may end the search.

        What wins by the ground alone may be beaten by one that nothing has proposed yet; so may, where the
        scene repeats itself, one under which most patches disagree.
        """
        if not self.pool.by_itself(self._among()):
            return False
        return self.pool.candidates[0].support >= LEAST_SUPPORT_OF_ROWS or not self.repeats()

    @property
    def asked_terrain(self) -> bool:
        """Whether the terrain has proposed."""
        return any(step.by_terrain for step in self.done)

    def convinces(self) -> bool:
        """Return whether the best hypothesis is beyond doubt by itself."""
        if not self.may_end_search() or self.pool.margin < self.settings.convincing_margin:
            return False
        best = self.pool.candidates[0]
        if best.ground is not None and best.ground.known and best.ground.spread_m > CONVINCING_SPREAD_M:
            return False
        if best.neg_log10_p >= self.settings.convincing_neg_log10_p:
            return True
        return (
            best.neg_log10_p >= SMALL_SITE_NEG_LOG10_P
            and self.pool.margin >= SMALL_SITE_MARGIN
            and best.support >= SMALL_SITE_SUPPORT
        )

    def promises(self) -> bool:
        """Return whether the best hypothesis stands out, so that the mirrored source may tell what by."""
        return (
            self.may_end_search()
            and self.pool.margin >= self.settings.convincing_margin
            and self.pool.candidates[0].neg_log10_p >= PROMISING_NEG_LOG10_P
        )

    def leads(self) -> bool:
        """Return whether the best hypothesis stands out so far that the mirrored source alone may end it."""
        return self.promises() and self.pool.margin >= CLEAR_LEAD and not self.repeats()

    def _yaw_step(self, source: Layer) -> float:
        """Step over all yaws, radians: about a cell and a half at the smaller raster's rim."""
        if self.settings.yaw_step_deg is not None:
            return float(np.radians(self.settings.yaw_step_deg))
        sides = [max(layer.grid.shape) for layer in (source, self.pyramid.at(1)[1])]
        rim = min(sides[0], sides[1] * self.pyramid.at(1)[1].grid.cell / source.grid.cell) / 2
        step = np.degrees(1.5 / max(rim, 1.0))
        return float(np.radians(np.clip(step, FINEST_YAW_STEP_DEG, COARSEST_YAW_STEP_DEG)))

    def fewest(self, factor: int) -> float:
        """Return how many cells of a level both rasters must fill at a pose for it to be considered."""
        layers = self.pyramid.at(factor)
        smaller = min(float(layer.channels.mask.sum()) for layer in layers)
        share = self.settings.min_overlap_share * smaller
        return max(self._least_m2 / layers[0].grid.cell ** 2, share, FEWEST_OVERLAP_CELLS)

    def _propose(self, factor: int) -> list[Pose]:
        """Propose the poses under which both channels agree best at a level."""
        source, target = self.pyramid.at(factor)
        cell, prior = source.grid.cell, self.prior
        fewest = self.fewest(factor)
        step = self._yaw_step(source)
        yaws = all_yaws(step)
        reached = target if prior is None else prior.layer(source.grid, target)
        if reached is None:
            return []
        search = GlobalSearch(source, reached, fewest)
        if prior is not None:
            yaws = prior.yaws(step)
            place = prior.place_of(source.grid)
            if place is not None:
                search.restrict(place, prior.radius_m)
        poses = search.run(yaws, PEAKS_A_YAW, 4, self.advance)
        return distinct(poses, self.most, 2 * step, 5 * cell)

    def _propose_by_terrain(
        self, cell_m: float, count: int, step_deg: float, *, robustly: bool = False
    ) -> list[Pose]:
        """Propose poses, about the finest centre, under which the grounds have the same shape."""
        found = propose(
            self.bare,
            max(cell_m, self.scales.cell_m),
            count,
            step_deg,
            least_m2=self._least_m2,
            prior=self.prior,
            plane=not self.settings.trust_vertical,
            robustly=robustly,
        )
        centre = centre_of(self.pyramid.at(1)[0].grid)
        return [pose_of(one, centre) for one in found]

    def _on_level(self, factor: int, poses: list[Pose]) -> list[Pose]:
        """Express poses about the finest centre as poses about that of a level."""
        finest, grid = self.pyramid.source.grid, self.pyramid.at(factor)[0].grid
        return [pose_of(pose.hypothesis(centre_of(finest)), centre_of(grid)) for pose in poses]

    @property
    def _least_m2(self) -> float:
        given = self.settings.min_overlap_m2
        return self.scales.least_overlap_m2 if given is None else given
