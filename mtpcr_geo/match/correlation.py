"""The default matcher: a global search by correlation, judged at fine cells, then local patch matches.

The search works coarse to fine. A level proposes hypotheses; each is followed down to the finest cells and
scored there, in one common way. Where the best stands clearly above the next distinct one and its patches
agree with each other, the search ends; else the next finer level is searched.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.statistics import chance_within, neg_log10_p
from mtpcr_geo.core.types import Bev, Hypothesis, Matches
from mtpcr_geo.match.base import margin_of
from mtpcr_geo.match.patches import PatchMatches, match_patches
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.search import GlobalSearch, Layer, angle_between, distinct, score_nearby
from mtpcr_geo.method.bev import coarsen
from mtpcr_geo.method.images import channels
from mtpcr_geo.method.solve import iterative_svd, ransac_upright

SEARCH_CELLS_M = (8.0, 4.0, 2.0)
LARGEST_SEARCH = 420
"""Cells along a raster's side up to which a level is searched over all yaws in about two seconds."""
PEAKS_A_YAW = 3
HYPOTHESES = 10
DROPPED_BELOW = 0.5
"""Share of the best score below which a hypothesis is not followed further."""
RADIUS_CELLS = 4
"""How far the final patch matches may lie from where the pose puts them, cells."""
AGREE_CELLS = 1.5


@dataclass(frozen=True)
class CorrelationSettings:
    """What governs the search.

    Attributes:
        yaw_step_deg: step of the search over all yaws.
        patch_m: edge of a patch of the local matches, metres.
        search_radius_m: how far a patch may lie from where the hypothesis puts it, metres.
        min_overlap_m2: smallest overlap considered, square metres.
        min_overlap_share: smallest overlap considered, as a share of the smaller raster.
        convincing_margin: best over next distinct score at fine cells that ends the search.
        convincing_surprise: digits of improbability of its patches' agreement that end it. Streets that run
            alike have given 11 digits to a pose 120 m off, where the true one had 48.

    """

    yaw_step_deg: float = 4.0
    patch_m: float = 24.0
    search_radius_m: float = 6.0
    min_overlap_m2: float = 400.0
    min_overlap_share: float = 0.03
    convincing_margin: float = 1.5
    convincing_neg_log10_p: float = 20.0


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


@dataclass(frozen=True)
class Candidate:
    """A hypothesis followed down to the finest cells.

    Attributes:
        pose: about the fine source raster's centre, with its score there.
        proposed: score at the level that proposed it.
        patches: local matches under it, where it was judged by them.
        supporting: (n,) patches that agree on one pose.

    """

    pose: Pose
    proposed: float
    patches: PatchMatches | None = None
    supporting: NDArray[np.bool_] | None = None

    @property
    def support(self) -> float:
        """Share of all patches tried that agree on one pose, less the two that any pose can please."""
        if self.patches is None or self.supporting is None:
            return 0.0
        return max(float(self.supporting.sum()) - 2.0, 0.0) / max(self.patches.patches, 8)

    @property
    def neg_log10_p(self) -> float:
        """Digits of improbability that so many of the patches matched agree by chance."""
        if self.patches is None or self.supporting is None:
            return 0.0
        agreeing = max(int(self.supporting.sum()) - 2, 0)
        return neg_log10_p(agreeing, len(self.patches), chance_within(AGREE_CELLS, RADIUS_CELLS - 0.5))

    @property
    def strength(self) -> float:
        """Score times support: what hypotheses are ranked by.

        Repetitive scenes give high scores to wrong poses with a large overlap; their patches disagree.
        """
        return self.pose.score * self.support


def match(
    source: Bev,
    target: Bev,
    settings: CorrelationSettings,
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
    pyramid = Pyramid(source, target)
    pool: list[Candidate] = []
    searched = []
    for factor in search_factors(source, target):
        found = _search(pyramid, factor, settings, advance, prior)
        searched.append({"cell_m": source.grid.cell * factor, "scores": [round(p.score, 3) for p in found]})
        pool = _distinct([*pool, *(_descend(pyramid, factor, pose) for pose in found)])
        pool = _distinct([_score_patches(pyramid, c, settings, seed) for c in _worth_judging(pool)])
        if (
            pool
            and _margin(pool) >= settings.convincing_margin
            and pool[0].neg_log10_p >= settings.convincing_neg_log10_p
        ):
            break
    if not pool:
        raise RegistrationError(
            "no pose brings the two rasters to overlap enough to compare; the clouds may be too small or too "
            f"sparse for cells of {source.grid.cell:g} m: give a finer --cell, or larger clouds"
        )
    best = pool[0]
    matches = best.patches
    assert matches is not None  # the best hypotheses are always judged by patches
    pivot = centre_of(source.grid)
    margin = _margin(pool)
    radius = (RADIUS_CELLS - 0.5) * source.grid.cell
    report = {
        "cell_m": source.grid.cell,
        "search_radius_m": radius,
        "searched": searched,
        "margin": margin,
        "support": best.support,
        "neg_log10_p": best.neg_log10_p,
        "support_next": max((c.support for c in pool[1:]), default=0.0),
        "patches": matches.patches,
        "scores": [round(c.pose.score, 3) for c in pool],
        "strengths": [round(c.strength, 3) for c in pool],
    }
    return Matches(
        source_px=matches.source_px,
        target_px=matches.target_px,
        score=np.clip(matches.score, 0.0, 1.0),
        hypotheses=tuple(c.pose.hypothesis(pivot) for c in pool),
        search_radius_m=radius,
        margin=margin,
        support=best.support,
        report=report,
    )


class Pyramid:
    """Both rasters' channels at every cell size asked for, made once."""

    def __init__(self, source: Bev, target: Bev) -> None:
        self._bevs = (source, target)
        self._layers: dict[int, tuple[Layer, Layer]] = {}

    def at(self, factor: int) -> tuple[Layer, Layer]:
        """Return source and target layers at ``factor`` times the finest cell."""
        if factor not in self._layers:
            coarse = [coarsen(bev, factor) for bev in self._bevs]
            source, target = (Layer(bev.grid, channels(bev)) for bev in coarse)
            self._layers[factor] = (source, target)
        return self._layers[factor]


def search_factors(source: Bev, target: Bev) -> list[int]:
    """Choose the levels of the global search, coarsest first, as multiples of the finest cell.

    The coarsest that still leaves a few dozen cells along the smaller raster, down to the finest that can
    be searched over all yaws in about two seconds.
    """
    cell = source.grid.cell
    longest = max(max(bev.grid.shape) for bev in (source, target)) * cell
    shortest = min(max(bev.grid.shape) for bev in (source, target)) * cell
    factors = []
    for wanted in SEARCH_CELLS_M:
        factor = max(1, round(wanted / cell))
        size = factor * cell
        if shortest / size >= 40 and longest / size <= LARGEST_SEARCH and factor not in factors:
            factors.append(factor)
    if not factors:
        fitting = max(longest / LARGEST_SEARCH, min(shortest / 40, SEARCH_CELLS_M[1]))
        factors.append(max(1, int(np.ceil(fitting / cell))))
    return factors


def _margin(pool: Sequence[Candidate]) -> float:
    return margin_of([candidate.strength for candidate in pool])


def _search(
    pyramid: Pyramid,
    factor: int,
    settings: CorrelationSettings,
    advance: Callable[[int], object],
    prior: Prior | None,
) -> list[Pose]:
    source, target = pyramid.at(factor)
    cell = source.grid.cell
    smaller = min(float(layer.channels.mask.sum()) for layer in (source, target))
    fewest = max(settings.min_overlap_m2 / cell**2, settings.min_overlap_share * smaller)
    steps = round(360.0 / settings.yaw_step_deg)
    yaws = np.arange(steps) * (2 * np.pi / steps)
    search = GlobalSearch(source, target, fewest)
    if prior is not None:
        known = pose_of(prior.hypothesis, centre_of(source.grid))
        search.restrict(known.east, known.north, prior.radius_m)
        yaws = prior.yaws(np.radians(settings.yaw_step_deg))
    poses = search.run(yaws, PEAKS_A_YAW, 4, advance)
    apart = distinct(poses, HYPOTHESES, np.radians(2 * settings.yaw_step_deg), 5 * cell)
    return [pose for i, pose in enumerate(apart) if i < 3 or pose.score >= DROPPED_BELOW * apart[0].score]


def _descend(pyramid: Pyramid, factor: int, pose: Pose) -> Candidate:
    """Follow a hypothesis from the level that proposed it to the finest cells."""
    proposed = pose.score
    level, step = factor, 1.0
    window = 2
    while True:
        source, target = pyramid.at(level)
        tries = [
            score_nearby(
                source, target, Pose(pose.yaw + np.radians(k * step), pose.east, pose.north), window
            )[0]
            for k in (-2, -1, 0, 1, 2)
        ]
        pose = max(tries, key=lambda p: p.score)
        if level == 1:
            return Candidate(pose, proposed)
        finer = max(1, level // 2)
        # the centre of the raster moves a little between levels: same pose, other pivot
        hypothesis = pose.hypothesis(centre_of(source.grid))
        pose = pose_of(hypothesis, centre_of(pyramid.at(finer)[0].grid))
        level, step, window = finer, step / 2, 3


def _worth_judging(pool: Sequence[Candidate]) -> list[Candidate]:
    """Leave out what scores far below the best; the runner-up always stays, for the margin's sake."""
    best = max((c.pose.score for c in pool), default=0.0)
    return [c for i, c in enumerate(pool) if i < 2 or c.pose.score >= DROPPED_BELOW * best]


def _distinct(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Sort by strength, then score, and join those that came down to the same place."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: (-c.strength, -c.pose.score)):
        if np.isfinite(candidate.pose.score) and not any(_same(candidate.pose, k.pose) for k in kept):
            kept.append(candidate)
    return kept[:HYPOTHESES]


def _same(a: Pose, b: Pose) -> bool:
    apart = float(np.hypot(a.east - b.east, a.north - b.north))
    return angle_between(a.yaw, b.yaw) < np.radians(5.0) and apart < 12.0


def _score_patches(
    pyramid: Pyramid, candidate: Candidate, settings: CorrelationSettings, seed: int
) -> Candidate:
    """Match patches around a hypothesis, let them correct it, and match again from there."""
    if candidate.patches is not None:
        return candidate
    source, target = pyramid.at(1)
    cell = source.grid.cell
    stride = max(4, round(settings.patch_m / 2 / cell))
    pose = candidate.pose
    radius = max(RADIUS_CELLS, round(settings.search_radius_m / cell))
    patches = match_patches(source, target, pose, window=radius, stride=stride)
    corrected = _corrected(pose, patches, _vote(patches, source, target, seed), source, target)
    rescored = score_nearby(source, target, corrected, 1)[0]
    # patches that do not agree must not carry a good hypothesis away
    if rescored.score >= pose.score:
        pose = rescored
    patches = match_patches(source, target, pose, window=RADIUS_CELLS, stride=stride)
    return Candidate(pose, candidate.proposed, patches, _vote(patches, source, target, seed))


def _vote(patches: PatchMatches, source: Layer, target: Layer, seed: int) -> NDArray[np.bool_]:
    """Mark the patches that agree on one yaw and shift."""
    s, t = source.grid.to_metres(patches.source_px), target.grid.to_metres(patches.target_px)
    return ransac_upright(s, t, AGREE_CELLS * source.grid.cell, seed, 500)[1]


def _corrected(
    pose: Pose, patches: PatchMatches, supporting: NDArray[np.bool_], source: Layer, target: Layer
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
        floor=AGREE_CELLS * source.grid.cell,
        upright=True,
    )
    east, north = transforms.apply(solution.T, np.array([[*centre_of(source.grid), 0.0]]))[0, :2]
    return Pose(
        transforms.yaw_of(solution.T[:3, :3]), float(east), float(north), pose.score, pose.overlap_cells
    )
