"""The default matcher: a global search by correlation, judged at fine cells, then local patch matches.

The search works coarse to fine. A level proposes hypotheses, from height and step edges and from the terrain;
each is followed down to the finest cells and judged there, in one common way, before any is dropped. Where
the best stands clearly above the next distinct one and its patches agree with each other, the search ends;
else the next finer level is searched. The same search of the mirrored source, which has no right pose, tells
what chance and self-similarity score on this pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Mask
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Hypothesis, Matches
from mtpcr_geo.match.base import margin_of
from mtpcr_geo.match.candidates import AGREE_TOLERANCES, RADIUS_TOLERANCES, Candidate, Pool, same_pose
from mtpcr_geo.match.patches import PatchMatches, match_patches
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.pyramid import Pyramid, search_factors
from mtpcr_geo.match.reasons import nothing_to_compare
from mtpcr_geo.match.search import GlobalSearch, Layer, distinct, score_nearby
from mtpcr_geo.match.terrain import FEWEST_CELLS as FEWEST_GROUND_CELLS
from mtpcr_geo.match.terrain import Terrain, TerrainSearch, compare_ground, place_on
from mtpcr_geo.method.scales import Scales, scales_of
from mtpcr_geo.method.solve import iterative_svd, ransac_upright

COARSEST_YAW_STEP_DEG, FINEST_YAW_STEP_DEG = 4.0, 2.0
FEWEST_OVERLAP_CELLS = 20
PEAKS_A_YAW = 3
HYPOTHESES = 10
TERRAIN_HYPOTHESES = 6
MIRRORED_HYPOTHESES = 24
"""Hypotheses kept of a level of the mirrored search: where a scene repeats itself many score alike, and the
best of them must be met."""
CLEAR_MARGIN = 4.0
"""Times by which the best strength exceeds a hypothesis' score, which bounds its strength, where patches need
not be asked: the margin could not fall below this."""
SMALL_SITE_NEG_LOG10_P, SMALL_SITE_MARGIN, SMALL_SITE_SUPPORT = 8.0, 3.0, 0.5
"""What convinces where there are too few patches for `CorrelationSettings.convincing_neg_log10_p`."""
MAX_RADIUS_CELLS = 10
ESTIMATE_CELLS = 20_000.0
"""Cells that tell which yaw and shift fit best on the way down to the finest level."""


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


@dataclass(frozen=True)
class Prior:
    """What is known beforehand of the pose: the clouds' own georeference, say.

    Attributes:
        hypothesis: the pose as known.
        radius_m: how far the source may lie from there.
        yaw_range: how far it may be turned from there, radians.

    """

    hypothesis: Hypothesis
    radius_m: float
    yaw_range: float

    def yaws(self, step: float) -> NDArray[np.float64]:
        """Yaws to search, radians, at most ``step`` apart, the known one among them."""
        count = 2 * max(1, int(np.ceil(self.yaw_range / step))) + 1
        return self.hypothesis.yaw + np.linspace(-self.yaw_range, self.yaw_range, count)


def match(
    source: Bev,
    target: Bev,
    settings: CorrelationSettings = DEFAULTS,
    seed: int = 0,
    advance: Callable[[int], object] = lambda n: None,
    prior: Prior | None = None,
) -> Matches:
    """Match two height rasters of unknown relative yaw and shift.

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
    scales = scales_of(source, target)
    search = _Search(source, target, scales, settings, seed, advance)
    pool, searched = search.explore(prior)
    if not pool.candidates:
        raise RegistrationError(nothing_to_compare(source, target, search.fewest(1), prior is not None))
    mirrored = None
    if settings.mirrored_null and prior is None:
        twin = _Search(
            mirror(source),
            target,
            scales,
            settings,
            seed,
            advance,
            search.pyramid,
            MIRRORED_HYPOTHESES,
        )
        mirrored, _ = twin.explore(None, [level.factor for level in searched], pool.candidates[0].strength)
    best = pool.candidates[0]
    patches = best.patches
    assert patches is not None  # hypotheses in a pool are judged by patches
    pivot = centre_of(source.grid)
    radius = _radius_cells(scales) * source.grid.cell - source.grid.cell / 2
    null_ratio = None
    if mirrored is not None:
        strongest = max((c.strength for c in mirrored.candidates), default=0.0)
        null_ratio = margin_of([best.strength, strongest], floor=mirrored.bound)
    report = {
        "cell_m": source.grid.cell,
        "extent_m": scales.extent_m,
        "patch_m": scales.patch_m if settings.patch_m is None else settings.patch_m,
        "search_radius_m": radius,
        "searched": [{"cell_m": level.cell_m, "scores": list(level.scores)} for level in searched],
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
        "mirrored_strengths": None
        if mirrored is None
        else [round(c.strength, 3) for c in mirrored.candidates],
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
        report=report,
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


@dataclass(frozen=True)
class Level:
    """One level of a search.

    Attributes:
        factor: its cell as a multiple of the finest.
        cell_m: its cell, metres.
        scores: of the hypotheses it proposed.

    """

    factor: int
    cell_m: float
    scores: tuple[float, ...]


class _Search:
    """Explores the levels of one source against one target."""

    def __init__(
        self,
        source: Bev,
        target: Bev,
        scales: Scales,
        settings: CorrelationSettings,
        seed: int,
        advance: Callable[[int], object],
        shared: Pyramid | None = None,
        keep: int = HYPOTHESES,
    ) -> None:
        self.pyramid = Pyramid(source, target, shared)
        self.scales, self.settings, self.seed, self.advance = scales, settings, seed, advance
        self.keep = keep
        self.terrain_source = Terrain.of(source, scales.terrain_cell_m)
        self.terrain_target = Terrain.of(target, scales.terrain_cell_m)

    def explore(
        self, prior: Prior | None, factors: Sequence[int] | None = None, known: float = 0.0
    ) -> tuple[Pool, list[Level]]:
        """Search level by level until a pose convinces; all of ``factors`` where they are given.

        Hypotheses that cannot come near the strength ``known`` are not judged by patches.
        """
        judged: list[Candidate] = []
        pool, levels, bound = Pool(), [], 0.0
        for factor in factors or search_factors(self.pyramid.source, self.pyramid.target):
            found = self._propose(factor, prior)
            cell = self.pyramid.source.grid.cell * factor
            levels.append(Level(factor, cell, tuple(round(pose.score, 3) for pose in found)))
            if not levels[1:] and prior is None:
                found = [*found, *self._propose_by_terrain(factor)]
            now, left = self._judge([self._descend(factor, pose) for pose in found], known)
            judged, bound = [*judged, *now], max(bound, left)
            known = max([known, *(candidate.strength for candidate in judged)])
            pool = Pool.of(judged, self.scales, bound)
            if factors is None and self._convinces(pool):
                break
        return pool, levels

    def _convinces(self, pool: Pool) -> bool:
        if not pool.candidates or pool.margin < self.settings.convincing_margin:
            return False
        best = pool.candidates[0]
        if best.neg_log10_p >= self.settings.convincing_neg_log10_p:
            return True
        return (
            best.neg_log10_p >= SMALL_SITE_NEG_LOG10_P
            and pool.margin >= SMALL_SITE_MARGIN
            and best.support >= SMALL_SITE_SUPPORT
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
        least = self.settings.min_overlap_m2
        least = self.scales.least_overlap_m2 if least is None else least
        share = self.settings.min_overlap_share * smaller
        return max(least / layers[0].grid.cell ** 2, share, FEWEST_OVERLAP_CELLS)

    def _propose(self, factor: int, prior: Prior | None) -> list[Pose]:
        source, target = self.pyramid.at(factor)
        cell = source.grid.cell
        fewest = self.fewest(factor)
        step = self._yaw_step(source)
        count = round(2 * np.pi / step)
        yaws = np.arange(count) * (2 * np.pi / count)
        search = GlobalSearch(source, target, fewest)
        if prior is not None:
            known = pose_of(prior.hypothesis, centre_of(source.grid))
            search.restrict(known.east, known.north, prior.radius_m)
            yaws = prior.yaws(step)
        poses = search.run(yaws, PEAKS_A_YAW, 4, self.advance)
        return distinct(poses, self.keep, 2 * step, 5 * cell)

    def _propose_by_terrain(self, factor: int) -> list[Pose]:
        """Propose the poses under which the grounds have the same shape, about the centre of a level."""
        source, target = self.terrain_source, self.terrain_target
        cell = source.grid.cell
        least = self.settings.min_overlap_m2
        least = self.scales.least_overlap_m2 if least is None else least
        step = COARSEST_YAW_STEP_DEG
        yaws = np.radians(np.arange(0.0, 360.0, step))
        if min(source.mask.sum(), target.mask.sum()) < 4 * FEWEST_GROUND_CELLS:
            return []
        poses = TerrainSearch(source, target, max(least / cell**2, FEWEST_GROUND_CELLS)).run(yaws)
        found = distinct(poses, TERRAIN_HYPOTHESES, np.radians(2 * step), 3 * cell)
        grid = self.pyramid.at(factor)[0].grid
        return [place_on(pose, source, grid) for pose in found]

    def _descend(self, factor: int, pose: Pose) -> Candidate:
        """Follow a hypothesis from the level that proposed it to the finest cells."""
        level, step = factor, 1.0
        window = 2
        while True:
            source, target = self.pyramid.at(level)
            tries = [
                score_nearby(
                    source,
                    target,
                    Pose(pose.yaw + np.radians(k * step), pose.east, pose.north),
                    window,
                    ESTIMATE_CELLS,
                )[0]
                for k in (-2, -1, 0, 1, 2)
            ]
            pose = max(tries, key=lambda p: p.score)
            if level == 1:
                return Candidate(score_nearby(source, target, pose, 1)[0])
            finer = max(1, level // 2)
            # the centre of the raster moves a little between levels: same pose, other pivot
            hypothesis = pose.hypothesis(centre_of(source.grid))
            pose = pose_of(hypothesis, centre_of(self.pyramid.at(finer)[0].grid))
            level, step, window = finer, step / 2, 3

    def _judge(self, candidates: Sequence[Candidate], known: float) -> tuple[list[Candidate], float]:
        """Judge hypotheses by patches and by the ground, those of the highest score at fine cells first.

        A strength is at most the score. What cannot come within `CLEAR_MARGIN` of the best is left with the
        score as its bound, unjudged.

        Args:
            candidates: at the finest cells.
            known: strength reached by any hypothesis so far.

        Returns:
            What was judged, and the highest score of what was not.

        """
        ranked = sorted(candidates, key=lambda c: -c.pose.score)
        separate: list[Candidate] = []
        near = self.scales.same_pose_m / 4
        for candidate in ranked:
            if np.isfinite(candidate.pose.score) and not any(
                same_pose(candidate.pose, other.pose, near, np.inf) for other in separate
            ):
                separate.append(candidate)
        judged: list[Candidate] = []
        for candidate in separate:
            if candidate.pose.score * CLEAR_MARGIN < known:
                return judged, candidate.pose.score
            judged.append(self._judge_one(candidate))
            known = max(known, judged[-1].strength)
        return judged, 0.0

    def _judge_one(self, candidate: Candidate) -> Candidate:
        """Match patches around a hypothesis, let them correct it, and match again from there."""
        source, target = self.pyramid.at(1)
        cell = source.grid.cell
        settings, scales = self.settings, self.scales
        patch = scales.patch_m if settings.patch_m is None else settings.patch_m
        wide = scales.search_radius_m if settings.search_radius_m is None else settings.search_radius_m
        stride = max(4, round(patch / 2 / cell))
        pose = candidate.pose
        narrow = _radius_cells(scales)
        agree = AGREE_TOLERANCES * scales.tolerance_m
        radius = min(max(narrow, round(wide / cell)), MAX_RADIUS_CELLS)
        patches = match_patches(source, target, pose, window=radius, stride=stride)
        corrected = _corrected(
            pose, patches, _vote(patches, source, target, agree, self.seed), source, target, agree
        )
        rescored = score_nearby(source, target, corrected, 1)[0]
        # patches that do not agree must not carry a good hypothesis away
        if rescored.score >= pose.score:
            pose = rescored
        patches = match_patches(source, target, pose, window=narrow, stride=stride)
        supporting = _vote(patches, source, target, agree, self.seed)
        ground = compare_ground(
            self.terrain_source,
            self.terrain_target,
            pose.hypothesis(centre_of(source.grid)),
            plane=not settings.trust_vertical,
        )
        return Candidate(pose, patches, supporting, ground)


def _radius_cells(scales: Scales) -> int:
    """Return how far the final patch matches may lie from where the pose puts them, cells."""
    return max(1, round(RADIUS_TOLERANCES * scales.tolerance_m / scales.cell_m))


def _vote(patches: PatchMatches, source: Layer, target: Layer, agree_m: float, seed: int) -> Mask:
    """Mark the patches that agree on one yaw and shift within ``agree_m`` metres."""
    s, t = source.grid.to_metres(patches.source_px), target.grid.to_metres(patches.target_px)
    return ransac_upright(s, t, agree_m, seed, 500)[1]


def _corrected(
    pose: Pose, patches: PatchMatches, supporting: Mask, source: Layer, target: Layer, agree_m: float
) -> Pose:
    """Fit yaw and shift to the patches, starting from those that agree."""
    if supporting.sum() < 4:
        return pose
    flat = np.zeros((len(patches), 1))
    solution = iterative_svd(
        np.hstack([source.grid.to_metres(patches.source_px), flat]),
        np.hstack([target.grid.to_metres(patches.target_px), flat]),
        start=supporting,
        weight=patches.score**2,
        floor=agree_m,
        upright=True,
    )
    east, north = transforms.apply(solution.T, np.array([[*centre_of(source.grid), 0.0]]))[0, :2]
    return Pose(
        transforms.yaw_of(solution.T[:3, :3]), float(east), float(north), pose.score, pose.overlap_cells
    )
