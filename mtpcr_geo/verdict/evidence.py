"""What speaks for a result: gathered from a solved pair, to be judged by `assess`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.statistics import chance_within
from mtpcr_geo.core.types import Hypothesis, Matches, Pair, Rival, SolveSettings, TiePoints
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.match.base import margin_of
from mtpcr_geo.method.common_heights import COLUMN_CELLS, common_heights
from mtpcr_geo.method.overlap import overlap_of
from mtpcr_geo.method.scales import MAX_LEAST_OVERLAP_M2, ground_cell_for, scales_of, tolerance_for
from mtpcr_geo.method.shortcomings import what_is_missing
from mtpcr_geo.method.solve import solve_tie_points
from mtpcr_geo.method.upright import points_near, seen_upright
from mtpcr_geo.verdict.findings import UNBOUNDED_CHANCE
from mtpcr_geo.verdict.further import with_further
from mtpcr_geo.verdict.limits import Evidence
from mtpcr_geo.verdict.null import null_probability

GROUND_AGREES_M = 0.5
UNBOUNDED_CELLS = 2.0
MOST_CHANCE = 0.5
FEW_PLACES = 3.0
"""Radius within which the place is known, in distances from which on poses are distinct, below which the next
distinct pose is one of a few, weak by chance or missing."""
FAR_TOLERANCES, FAR_TURN_DEG = 5.0, 5.0
"""Tolerances in plan, or turn, from which on another pose is another place and not the same a little off."""


def gather(pair: Pair, tolerance: float | None = None) -> tuple[Evidence, dict[str, Any]]:
    """Gather the evidence for a pair's transform.

    Args:
        pair: solved, with rasters and tie points.
        tolerance: plan distance within which a held-out tie point agrees, metres; if None, one cell, or
            two where
            the matcher does not bound its matches: keypoints are coarser, and chance agreement rarer.

    Returns:
        The evidence, and further metrics: pose, uncertainty and tie residuals.

    """
    assert pair.T_target_source is not None
    assert pair.tie_points is not None
    cell = pair.cell
    matches = pair.matches
    radius = matches.search_radius_m if matches is not None else None
    tolerance = tolerance or tolerance_for(cell) * (1.0 if radius is not None else UNBOUNDED_CELLS)
    T = pair.T_target_source
    tie_points = pair.tie_points
    T_level = pair.levelled(T)
    residual = np.hypot(*(transforms.apply(T_level, tie_points.source) - tie_points.target)[:, :2].T)
    held_out = cross_validated(
        tie_points, tolerance, pair.solution.settings if pair.solution else SolveSettings()
    )
    agreeing = held_out < tolerance
    # ground and what stands on it are told apart along the vertical
    seen = seen_upright(pair)
    assert seen.T_target_source is not None
    moved = transforms.apply(seen.T_target_source, points_near(pair.source))
    overlap = overlap_of(moved, points_near(seen.target), ground_cell_for(cell))
    whole = moved if pair.source.near is None else transforms.apply(seen.T_target_source, pair.source.sample)
    ground = overlap.common_ground()
    shape = ground.shape()
    common = common_heights(moved, points_near(seen.target), COLUMN_CELLS * cell, tolerance_for(cell))
    icp = pair.refinement.icp if pair.refinement is not None else None
    evidence = Evidence(
        held_out=len(held_out),
        held_out_agreeing=int(agreeing.sum()),
        chance=chance_of(matches, tolerance),
        tolerance_m=tolerance,
        held_out_median_m=float(np.median(held_out[agreeing])) if agreeing.any() else None,
        margin=matches.margin if matches is not None else None,
        support=matches.support if matches is not None else None,
        overlap_m2=overlap.area_m2,
        overlap_source=float(overlap.select(whole).mean()),
        overlap_target=float(overlap.select(seen.target.sample).mean()),
        ground_cells=len(ground.step),
        ground_agreeing=int((np.abs(ground.step) < GROUND_AGREES_M).sum()),
        ground_spread_m=shape.spread_m if np.isfinite(shape.spread_m) else None,
        ground_relief_m=shape.relief_m if np.isfinite(shape.spread_m) else None,
        ground_noise_m=shape.noise_m if np.isfinite(shape.spread_m) else None,
        heights_elsewhere=common.elsewhere if common is not None and common.asked else None,
        repeats=matches is not None and matches.repeats,
        self_likeness=matches.self_likeness if matches is not None else None,
        refined_away_m=_refined_away(pair, T),
        refinement_lost=icp is not None and icp.lost_tie_points,
        null_ratio=matches.null_ratio if matches is not None else None,
        null_p=None if matches is None else null_probability(matches.strength, matches.mirrored_strengths),
        least_overlap_m2=_least_overlap_m2(pair),
        final_agreeing=int((residual < tolerance).sum()),
        missing=_missing(pair),
        rivals=rivals_of(pair, tolerance),
        narrow_prior=_narrow_prior(pair),
        mapped=pair.frame.crs is not None,
        not_levelled=tuple(
            f"the {side.role} was not levelled: {side.levelling.why or 'nothing tells its vertical'}"
            for side in (pair.source, pair.target)
            if side.levelling.method == "none" and not side.levelling.trusted
        ),
    )
    del moved, whole  # as large as the source
    evidence, further = with_further(evidence, seen, overlap, ground, tie_points, agreeing)
    if seen is not pair and evidence.uncertainty is not None:
        evidence = replace(evidence, uncertainty=_in_work_frame(evidence.uncertainty, pair))
    shift = T[:3, 3]
    offset = TransformChain.of(pair).vertical_offset_m
    more = {
        **({} if offset is None else {"vertical_offset_m": offset}),
        "yaw_deg": float(np.degrees(transforms.yaw_of(T[:3, :3]))),
        "tilt_deg": float(np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))),
        "shift_work_m": [float(v) for v in shift],
        "tie_points": len(tie_points.score),
        "tie_points_agreeing": int((residual < tolerance).sum()),
        **_agreeing_heights(pair, residual < tolerance),
        "held_out_expected": None if evidence.chance is None else evidence.chance * evidence.held_out,
        **further,
    }
    return evidence, more


def _narrow_prior(pair: Pair) -> bool:
    """Return whether the place was known so well beforehand that hardly any other pose was searched."""
    known, matches = pair.known, pair.matches
    if known is None or known.within_m is None or matches is None or matches.null_ratio is None:
        return False
    if pair.source.bev is None or pair.target.bev is None:
        return False
    return known.within_m < FEW_PLACES * scales_of(pair.source.bev, pair.target.bev).same_pose_m


def _in_work_frame(uncertainty: Uncertainty, pair: Pair) -> Uncertainty:
    """Take an uncertainty from the frame of the levelled target to that of its work coordinates."""
    T_work = transforms.inverse(pair.target.T_level_work)
    pivot, far = transforms.apply(T_work, np.array([uncertainty.pivot, uncertainty.far]))
    return replace(uncertainty, pivot=pivot, far=far, R_level=pair.target.T_level_work[:3, :3])


def chance_of(matches: Matches | None, tolerance: float) -> float | None:
    """Return how probably a match agrees with a pose by chance; None where that is not known.

    Args:
        matches: as their matcher found them.
        tolerance: plan distance within which one agrees, metres.

    """
    if matches is None:
        return None
    if matches.search_radius_m is not None:
        return chance_within(tolerance, matches.search_radius_m)
    if matches.by_chance is None:
        return None
    share, within = matches.by_chance
    return float(np.clip(share * (tolerance / within) ** 2, UNBOUNDED_CHANCE, MOST_CHANCE))


def _agreeing_heights(pair: Pair, agreeing: Mask) -> dict[str, Any]:
    """Return how the tie points that agree in plan compare in height, which they are not matched by."""
    names = (
        "tie_points_plan_median_m", "tie_points_height_median_m", "tie_points_height_off",
        "tie_points_height_tolerance_m",
    )  # fmt: skip
    if pair.tie_points is None or pair.T_target_source is None or not agreeing.any():
        return dict.fromkeys(names)
    T = pair.levelled(pair.T_target_source)
    gap = (transforms.apply(T, pair.tie_points.source) - pair.tie_points.target)[agreeing]
    rise = np.abs(gap[:, 2] - np.median(gap[:, 2]))
    most = max(3.0 * 1.4826 * float(np.median(rise)), tolerance_for(pair.cell))
    plan, height = np.median(np.hypot(gap[:, 0], gap[:, 1])), np.median(np.abs(gap[:, 2]))
    return dict(zip(names, (float(plan), float(height), int((rise > most).sum()), most), strict=True))


def rivals_of(pair: Pair, tolerance: float) -> tuple[Rival, ...]:
    """Return the matcher's other hypotheses, strongest first, by where they put the middle of the tie points.

    Args:
        pair: with matches and tie points.
        tolerance: plan distance within which a tie point agrees, metres.

    """
    hypotheses = pair.matches.hypotheses if pair.matches is not None else ()
    ranked = [one for one in hypotheses if one.strength is not None]
    if len(ranked) < 2 or pair.tie_points is None or not len(pair.tie_points):
        return ()
    middle = pair.tie_points.source[:, :2].mean(axis=0)
    best = ranked[0]
    found = []
    for other in sorted(ranked[1:], key=lambda one: -(one.strength or 0.0)):
        east, north = _placed(other, middle) - _placed(best, middle)
        turn = float((np.degrees(other.yaw - best.yaw) + 180.0) % 360.0 - 180.0)
        far = bool(np.hypot(east, north) > FAR_TOLERANCES * tolerance or abs(turn) > FAR_TURN_DEG)
        margin = margin_of([best.strength or 0.0, other.strength or 0.0])
        found.append(Rival(float(east), float(north), turn, margin, far))
    return tuple(found)


def _placed(hypothesis: Hypothesis, xy: Floats) -> Floats:
    """Return where a hypothesis puts a (2,) point of the levelled source, (2,) metres."""
    c, s = np.cos(hypothesis.yaw), np.sin(hypothesis.yaw)
    return np.asarray(np.array([[c, -s], [s, c]]) @ xy + hypothesis.shift)


def _missing(pair: Pair) -> str | None:
    """Say what keeps the rasters from giving many matches; None where nothing is seen to."""
    if pair.source.bev is None or pair.target.bev is None:
        return None
    return what_is_missing(pair.source.bev, pair.target.bev)


def _least_overlap_m2(pair: Pair) -> float:
    """Return the least overlap worth accepting, square metres, from the areas of both rasters."""
    if pair.source.bev is None or pair.target.bev is None:
        return MAX_LEAST_OVERLAP_M2
    return scales_of(pair.source.bev, pair.target.bev).least_overlap_m2


def agreement(pair: Pair, T: Floats, tolerance: float | None = None) -> tuple[int, int]:
    """Count what agrees with a transform: tie points in plan, and cells of common ground in height.

    Args:
        pair: with tie points and rasters.
        T: 4x4 from source to target work coordinates.
        tolerance: plan distance within which a tie point agrees, metres; one cell if None.

    """
    seen = seen_upright(pair.with_(T_target_source=T, refinement=None))
    assert seen.T_target_source is not None
    moved = transforms.apply(seen.T_target_source, points_near(pair.source))
    _, steps = overlap_of(moved, points_near(seen.target), ground_cell_for(pair.cell)).ground_steps()
    return tie_points_agreeing(pair, T, tolerance), int((np.abs(steps) < GROUND_AGREES_M).sum())


def tie_points_agreeing(pair: Pair, T: Floats, tolerance: float | None = None) -> int:
    """Count the tie points that a transform brings together in plan; arguments as for `agreement`."""
    return int(tie_point_agrees(pair, T, tolerance).sum())


def tie_point_agrees(pair: Pair, T: Floats, tolerance: float | None = None) -> Mask:
    """Return which tie points (n,) a transform brings together in plan; arguments as for `agreement`."""
    if pair.tie_points is None:
        return np.zeros(0, bool)
    T_level = pair.levelled(T)
    gap = transforms.apply(T_level, pair.tie_points.source) - pair.tie_points.target
    return np.asarray(np.hypot(gap[:, 0], gap[:, 1]) < (tolerance or tolerance_for(pair.cell)))


def cross_validated(tie_points: TiePoints, tolerance: float, settings: SolveSettings) -> Floats:
    """Hold out each fold in turn, solve from the others, and return each tie point's plan residual.

    Args:
        tie_points: with folds.
        tolerance: plan distance within which a tie point agrees, metres.
        settings: as the solver had them.

    Returns:
        (n,) metres; infinite where the others gave no transform.

    """
    residual = np.full(len(tie_points), np.inf)
    for fold in np.unique(tie_points.fold):
        out = tie_points.fold == fold
        try:
            solution, _ = solve_tie_points(tie_points, 1.5 * tolerance, settings, held_out=out)
        except RegistrationError:
            continue
        gap = transforms.apply(solution.T, tie_points.source[out]) - tie_points.target[out]
        residual[out] = np.hypot(gap[:, 0], gap[:, 1])
    return residual


def _refined_away(pair: Pair, T: Floats) -> float:
    """Return how far the refinement ended from where the tie points had led, in plan, metres."""
    if pair.refinement is None:
        return 0.0
    solved = pair.refinement.T_solved
    return moved_in_plan(pair, pair.refinement.T_before if solved is None else solved, T)


def middle_of_tie_points(pair: Pair) -> Floats | None:
    """Return the mean of the tie points' source ends, (3,) source work coordinates; None without any."""
    if pair.tie_points is None or not len(pair.tie_points):
        return None
    middle = pair.tie_points.source.mean(axis=0, keepdims=True)
    return np.asarray(transforms.apply(transforms.inverse(pair.source.T_level_work), middle)[0])


def moved_in_plan(pair: Pair, before: Floats, after: Floats) -> float:
    """Return how far apart two transforms put the middle of the tie points in plan, metres; 0 without any.

    Height is not counted: tie points are matched in plan, and take theirs from levelled rasters, which a
    degree of tilt raises by metres. That of the result is judged by the ground.

    Args:
        pair: with tie points.
        before, after: 4x4 from source to target work coordinates.

    """
    middle = middle_of_tie_points(pair)
    if middle is None:
        return 0.0
    moved = transforms.apply(after, middle[None])[0] - transforms.apply(before, middle[None])[0]
    return float(np.hypot(*(pair.target.T_level_work[:3, :3] @ moved)[:2]))
