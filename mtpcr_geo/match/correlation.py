"""The default matcher: a global search by correlation, judged at fine cells, then local patch matches.

The search works coarse to fine. A level proposes hypotheses, from height and step edges and from the terrain;
each is followed down to the finest cells and judged there, in one common way, before any is dropped. Where
the best stands clearly above the next distinct one and its patches agree with each other, the search ends;
else the next finer level is searched. The same search of the mirrored source, which has no right pose, tells
what chance and self-similarity score on this pair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Matches
from mtpcr_geo.match.candidates import Candidate, Pool, same_pose
from mtpcr_geo.match.descent import comb, comb_each, follow
from mtpcr_geo.match.judge import CLEAR_MARGIN, Judge
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.pyramid import Level, Pyramid, search_factors
from mtpcr_geo.match.reasons import nothing_to_compare
from mtpcr_geo.match.search import GlobalSearch, Layer, distinct
from mtpcr_geo.match.terrain import FEWEST_CELLS as FEWEST_GROUND_CELLS
from mtpcr_geo.match.terrain import Terrain, TerrainSearch, closest, place_on
from mtpcr_geo.method.ground import bare
from mtpcr_geo.method.scales import Scales, scales_of

COARSEST_YAW_STEP_DEG, FINEST_YAW_STEP_DEG = 4.0, 2.0
FEWEST_OVERLAP_CELLS = 20
PEAKS_A_YAW = 3
HYPOTHESES, MORE_HYPOTHESES = 10, 48
"""Hypotheses of a level followed at first, and at most where these do not convince: a small source has more
places to lie in a large target, and each costs less to follow."""
TERRAIN_HYPOTHESES, MORE_TERRAIN_HYPOTHESES = 6, 16
SETTLED_BY_TERRAIN = 40
"""Poses that the terrains propose, of which those are followed under which they are closest."""
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


DEFAULTS = CorrelationSettings()


def match(
    source: Bev,
    target: Bev,
    settings: CorrelationSettings = DEFAULTS,
    seed: int = 0,
    advance: Callable[[int], object] = lambda n: None,
    prior: Prior | None = None,
) -> Matches:
    """Match two height rasters of unknown relative yaw and shift.

    Where nothing is known of the pose it is the raster of fewer filled cells that is turned and moved,
    whichever is the source: source and target exchanged give the inverse.

    Args:
        source, target: rasters of one cell size, in levelled coordinates.
        settings: what governs the search.
        seed: of the sampling when patches vote.
        advance: called with 1 after each yaw searched.
        prior: what is known of the pose; None to search everywhere.

    Returns:
        Local matches under the best hypothesis (possibly few), and all hypotheses, best first.

    Raises:
        RegistrationError: if the rasters are too small or too empty to overlap enough.

    """
    if prior is None and (source.count > 0).sum() > (target.count > 0).sum():
        return exchanged(match(target, source, settings, seed, advance))
    scales = scales_of(source, target)
    search = _Search(source, target, scales, settings, seed, advance, prior)
    twin = None
    if settings.mirrored_null:
        null = None if prior is None else prior.mirrored()
        twin = _Search(
            mirror(source), target, scales, settings, seed, advance, null, search.pyramid, MIRRORED_HYPOTHESES
        )
    for factor, part in ((factor, part) for factor in search_factors(source, target) for part in (0, 1)):
        if not search.explore(factor, part) and part:
            continue
        if search.convinces():
            break
        if twin is not None and search.promises():
            twin.catch_up(search)
            if search.pool.over(twin.pool) >= CONVINCING_NULL_RATIO:
                break
    pool = search.pool
    if not pool.candidates:
        raise RegistrationError(nothing_to_compare(source, target, search.fewest(1), prior is not None))
    null_ratio = None
    if twin is not None:
        twin.catch_up(search)
        null_ratio = search.pool.over(twin.pool)
    best = pool.candidates[0]
    patches = best.patches
    assert patches is not None  # hypotheses in a pool are judged by patches
    pivot = centre_of(source.grid)
    radius = search.judge.radius_cells * source.grid.cell - source.grid.cell / 2
    report = {
        "cell_m": source.grid.cell,
        "extent_m": scales.extent_m,
        "patch_m": scales.patch_m if settings.patch_m is None else settings.patch_m,
        "search_radius_m": radius,
        "searched": [{"cell_m": level.cell_m, "scores": list(level.scores)} for level in search.levels],
        "margin": pool.margin,
        "support": best.support,
        "neg_log10_p": best.neg_log10_p,
        "support_next": max((c.support for c in pool.candidates[1:]), default=0.0),
        "patches": patches.patches,
        "scores": [round(c.pose.score, 3) for c in pool.candidates],
        "strengths": [round(strength, 3) for strength in pool.strengths],
        "ground_spread_m": [
            round(c.ground.spread_m, 3) if c.ground is not None and c.ground.known else None
            for c in pool.candidates
        ],
        "mirrored_strengths": None if twin is None else [round(c.strength, 3) for c in twin.pool.candidates],
        "null_ratio": null_ratio,
    }
    return Matches(
        source_px=patches.source_px,
        target_px=patches.target_px,
        score=np.clip(patches.score, 0.0, 1.0),
        hypotheses=tuple(
            replace(c.pose.hypothesis(pivot), strength=strength)
            for c, strength in zip(pool.candidates, pool.strengths, strict=True)
        ),
        search_radius_m=radius,
        margin=pool.margin,
        support=best.support,
        null_ratio=null_ratio,
        strength=best.strength,
        mirrored_strengths=None if twin is None else tuple(c.strength for c in twin.pool.candidates),
        report=report,
    )


def exchanged(matches: Matches) -> Matches:
    """Return the matches of the target to the source as those of the source to the target."""
    hypotheses = []
    for one in matches.hypotheses:
        c, s = np.cos(one.yaw), np.sin(one.yaw)
        east, north = one.shift
        back = (float(-(c * east + s * north)), float(s * east - c * north))
        hypotheses.append(replace(one, yaw=-one.yaw, shift=back))
    return replace(
        matches,
        source_px=matches.target_px,
        target_px=matches.source_px,
        hypotheses=tuple(hypotheses),
    )


def mirror(bev: Bev) -> Bev:
    """Reflect a raster east to west (x to -x): a scene of the same texture that has no right pose."""
    grid = bev.grid
    reflected = Grid(-(grid.west + grid.width * grid.cell), grid.north, grid.cell, grid.width, grid.height)
    return Bev(
        reflected,
        np.ascontiguousarray(bev.top[:, ::-1]),
        np.ascontiguousarray(bev.low[:, ::-1]),
        np.ascontiguousarray(bev.count[:, ::-1]),
    )


class _Search:
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
        shared: Pyramid | None = None,
        first: int = HYPOTHESES,
    ) -> None:
        self.pyramid = Pyramid(source, target, shared)
        self.scales, self.settings, self.advance, self.prior = scales, settings, advance, prior
        self.bare = (bare(source), bare(target))
        self.terrain = (
            Terrain.of(self.bare[0], scales.terrain_cell_m),
            Terrain.of(self.bare[1], scales.terrain_cell_m),
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
        self.done: list[tuple[int, int]] = []
        self.judged: list[Candidate] = []
        self.pool = Pool()
        self._proposed: dict[int, list[Pose]] = {}

    def explore(self, factor: int, part: int, known: float = 0.0) -> bool:
        """Propose at a level, and follow and judge the first or the second part of what was proposed.

        Args:
            factor: the level's cell as a multiple of the finest.
            part: 0 for the best hypotheses, 1 for the others.
            known: strength that matters; what cannot come within `CLEAR_MARGIN` of it is not followed.

        Returns:
            Whether there were any.

        """
        first = not self.done
        if factor not in self._proposed:
            self._proposed[factor] = self._propose(factor)
            cell = self.pyramid.source.grid.cell * factor
            scores = tuple(round(pose.score, 3) for pose in self._proposed[factor])
            self.levels.append(Level(factor, cell, scores))
        by_terrain: list[Pose] = []
        if first:
            by_terrain = self._propose_by_terrain(self.scales.terrain_cell_m, TERRAIN_HYPOTHESES)
            pose = None if self.prior is None else self.prior.pose(self.pyramid.at(1)[0].grid)
            by_terrain += [] if pose is None else [pose]
        elif part and len(self.levels) == 1:
            by_terrain = self._propose_by_terrain(self.scales.terrain_cell_m / 2, MORE_TERRAIN_HYPOTHESES)
        self.done.append((factor, part))
        proposed = self._proposed[factor]
        by_channels = proposed[self.first :] if part else proposed[: self.first]
        if not by_channels and not by_terrain:
            return False
        followed = [follow(self.pyramid, factor, by_channels, known / CLEAR_MARGIN)]
        near, radius = self.scales.same_pose_m / 2, self.scales.extent_m / 2
        others = [
            pose
            for pose in by_terrain
            if not any(same_pose(pose, other, near, radius) for other in followed[0].poses)
        ]
        followed.append(follow(self.pyramid, factor, self._on_level(factor, others)))
        # the lowest of a cell shifts with the grid it lies on: by terrain a pose may be some metres off
        combed = comb_each(self.pyramid, others, self.scales.terrain_cell_m)
        known = max([known, *(candidate.strength for candidate in self.judged)])
        now, left = self.judge.judge(
            [*combed, *(pose for descent in followed for pose in descent.poses)], known
        )
        self.judged += now
        bound = max(self.pool.bound, left, *(descent.bound for descent in followed))
        self._rank(bound)
        if self.pool.candidates:
            self._comb_about_the_best(known)
        return True

    def _rank(self, bound: float) -> None:
        """Rank what was judged; the best is judged at the finest cells, if a first look had been enough."""
        self.pool = Pool.of(self.judged, self.scales, bound)
        while self.pool.candidates and not self.pool.candidates[0].complete:
            best = self.pool.candidates[0]
            number = next(k for k, one in enumerate(self.judged) if one is best)
            self.judged[number] = self.judge.judge_one(best.pose)
            self.pool = Pool.of(self.judged, self.scales, bound)

    def _comb_about_the_best(self, known: float) -> None:
        """Judge the best place near the best hypothesis too, where that is another."""
        best = self.pool.candidates[0].pose
        near = comb(self.pyramid, best, self.scales.terrain_cell_m)
        if near.score > best.score and not same_pose(
            near, best, self.scales.cell_m, self.scales.extent_m / 2
        ):
            self.judged += self.judge.judge([near], known)[0]
            self._rank(self.pool.bound)

    def catch_up(self, other: _Search) -> None:
        """Search what another has searched, as far as it matters beside what that found."""
        known = other.pool.candidates[0].strength if other.pool.candidates else 0.0
        for factor, part in other.done[len(self.done) :]:
            self.explore(factor, part, known)

    def convinces(self) -> bool:
        """Return whether the best hypothesis is beyond doubt by itself."""
        if not self.pool.candidates or self.pool.margin < self.settings.convincing_margin:
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
            bool(self.pool.candidates)
            and self.pool.margin >= self.settings.convincing_margin
            and self.pool.candidates[0].neg_log10_p >= PROMISING_NEG_LOG10_P
        )

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
        count = round(2 * np.pi / step)
        yaws = np.arange(count) * (2 * np.pi / count)
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

    def _propose_by_terrain(self, cell_m: float, count: int) -> list[Pose]:
        """Propose poses, about the finest centre, under which the grounds have the same shape.

        Args:
            cell_m: cell in which they are compared, metres.
            count: how many to propose at most.

        """
        source, target = (Terrain.of(bev, max(cell_m, self.scales.cell_m)) for bev in self.bare)
        cell, prior = source.grid.cell, self.prior
        reached = target if prior is None else prior.terrain(source.grid, target)
        if reached is None or min(source.mask.sum(), reached.mask.sum()) < 4 * FEWEST_GROUND_CELLS:
            return []
        first = not self.done
        step = float(np.radians(COARSEST_YAW_STEP_DEG if first else FINEST_YAW_STEP_DEG))
        yaws = np.arange(round(2 * np.pi / step)) * step
        search = TerrainSearch(source, reached, max(self._least_m2 / cell**2, FEWEST_GROUND_CELLS))
        if prior is not None:
            yaws = prior.yaws(step)
            place = prior.place_of(source.grid)
            if place is not None:
                search.restrict(place, prior.radius_m)
        found = distinct(search.run(yaws), SETTLED_BY_TERRAIN, 2 * step, 3 * cell)
        found = closest(source, target, found, count, plane=not self.settings.trust_vertical)
        grid = self.pyramid.at(1)[0].grid
        return [place_on(pose, source, grid) for pose in found]

    def _on_level(self, factor: int, poses: list[Pose]) -> list[Pose]:
        """Express poses about the finest centre as poses about that of a level."""
        finest, grid = self.pyramid.source.grid, self.pyramid.at(factor)[0].grid
        return [pose_of(pose.hypothesis(centre_of(finest)), centre_of(grid)) for pose in poses]

    @property
    def _least_m2(self) -> float:
        given = self.settings.min_overlap_m2
        return self.scales.least_overlap_m2 if given is None else given
