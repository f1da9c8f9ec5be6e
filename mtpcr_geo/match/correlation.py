"""The default matcher: a global search by correlation, judged at fine cells, then local patch matches.

The search works coarse to fine. A level proposes hypotheses, from height and step edges and from the terrain;
each is followed down to the finest cells and judged there, in one common way, before any is dropped. Where
the best stands clearly above the next distinct one and its patches agree with each other, the search ends;
else the next finer level is searched. The same search of the mirrored source, which has no right pose, tells
what chance and self-similarity score on this pair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Hypothesis, Matches
from mtpcr_geo.match.base import margin_of
from mtpcr_geo.match.candidates import Candidate, Pool
from mtpcr_geo.match.descent import follow
from mtpcr_geo.match.judge import CLEAR_MARGIN, Judge
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.pyramid import Level, Pyramid, search_factors
from mtpcr_geo.match.search import GlobalSearch, Layer, distinct
from mtpcr_geo.match.terrain import FEWEST_CELLS as FEWEST_GROUND_CELLS
from mtpcr_geo.match.terrain import Terrain, TerrainSearch, place_on
from mtpcr_geo.method.scales import Scales, scales_of

COARSEST_YAW_STEP_DEG, FINEST_YAW_STEP_DEG = 4.0, 2.0
FEWEST_OVERLAP_CELLS = 20
PEAKS_A_YAW = 3
HYPOTHESES = 10
TERRAIN_HYPOTHESES = 6
MIRRORED_HYPOTHESES = 24
"""Hypotheses kept of a level of the mirrored search: where a scene repeats itself many score alike, and the
best of them must be met."""
SMALL_SITE_NEG_LOG10_P, SMALL_SITE_MARGIN, SMALL_SITE_SUPPORT = 8.0, 3.0, 0.5
"""What convinces where there are too few patches for `CorrelationSettings.convincing_neg_log10_p`."""
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
    twin = None
    if settings.mirrored_null and prior is None:
        twin = _Search(
            mirror(source), target, scales, settings, seed, advance, search.pyramid, MIRRORED_HYPOTHESES
        )
    for factor in search_factors(source, target):
        search.explore(factor, prior)
        if search.convinces():
            break
        if twin is not None and search.promises():
            twin.catch_up(search)
            if search.over(twin) >= CONVINCING_NULL_RATIO:
                break
    pool = search.pool
    if not pool.candidates:
        raise RegistrationError(
            "no pose brings the two rasters to overlap enough to compare; the clouds may be too small or too "
            f"sparse for cells of {source.grid.cell:g} m: give a finer --cell, or larger clouds"
        )
    null_ratio = None
    if twin is not None:
        twin.catch_up(search)
        null_ratio = search.over(twin)
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
        hypotheses=tuple(c.pose.hypothesis(pivot) for c in pool.candidates),
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
        self.terrain = (Terrain.of(source, scales.terrain_cell_m), Terrain.of(target, scales.terrain_cell_m))
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
        self.levels: list[Level] = []
        self.judged: list[Candidate] = []
        self.pool = Pool()

    def explore(self, factor: int, prior: Prior | None, known: float = 0.0) -> None:
        """Search one more level.

        Args:
            factor: its cell as a multiple of the finest.
            prior: what is known of the pose.
            known: strength that matters; what cannot come within `CLEAR_MARGIN` of it is not followed.

        """
        proposed = self._propose(factor, prior)
        by_terrain = self._propose_by_terrain(factor) if not self.levels and prior is None else []
        cell = self.pyramid.source.grid.cell * factor
        self.levels.append(Level(factor, cell, tuple(round(pose.score, 3) for pose in proposed)))
        followed = [
            follow(self.pyramid, factor, proposed, known / CLEAR_MARGIN),
            follow(self.pyramid, factor, by_terrain),
        ]
        known = max([known, *(candidate.strength for candidate in self.judged)])
        poses = [pose for descent in followed for pose in descent.poses]
        now, left = self.judge.judge(poses, known)
        self.judged += now
        bound = max(self.pool.bound, left, *(descent.bound for descent in followed))
        self.pool = Pool.of(self.judged, self.scales, bound)

    def catch_up(self, other: _Search) -> None:
        """Search the levels that another has searched, as far as they matter beside what it found."""
        known = other.pool.candidates[0].strength if other.pool.candidates else 0.0
        for level in other.levels[len(self.levels) :]:
            self.explore(level.factor, None, known)

    def over(self, other: _Search) -> float:
        """Return the strength of the best over the greatest of another search, at least."""
        strongest = max((candidate.strength for candidate in other.pool.candidates), default=0.0)
        return margin_of([self.pool.candidates[0].strength, strongest], floor=other.pool.bound)

    def convinces(self) -> bool:
        """Return whether the best hypothesis is beyond doubt by itself."""
        if not self.pool.candidates or self.pool.margin < self.settings.convincing_margin:
            return False
        best = self.pool.candidates[0]
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

    def _propose(self, factor: int, prior: Prior | None) -> list[Pose]:
        source, target = self.pyramid.at(factor)
        cell = source.grid.cell
        smaller = min(float(layer.channels.mask.sum()) for layer in (source, target))
        least = self.settings.min_overlap_m2
        least = self.scales.least_overlap_m2 if least is None else least
        fewest = max(least / cell**2, self.settings.min_overlap_share * smaller, FEWEST_OVERLAP_CELLS)
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
        source, target = self.terrain
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
