"""What speaks for a result: gathered from a solved pair, to be judged by `assess`."""

from __future__ import annotations

from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.statistics import chance_within
from mtpcr_geo.core.types import Floats, Pair, Ties
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.method.overlap import overlap_of
from mtpcr_geo.method.solve import solve_ties
from mtpcr_geo.verdict.decision import Evidence

GROUND_AGREES_M = 0.5
UNBOUNDED_CELLS = 2.0
TIES_A_PATCH = 4
"""Patches overlap by half, so about four ties tell what one independent tie would."""


def gather(pair: Pair, tolerance: float | None = None) -> tuple[Evidence, dict[str, Any]]:
    """Gather the evidence for a pair's transform.

    Args:
        pair: solved, with rasters and ties.
        tolerance: plan distance within which a withheld tie agrees, metres; if None, one cell, or two where
            the matcher does not bound its matches: keypoints are coarser, and chance agreement rarer.

    Returns:
        The evidence, and further metrics: pose, uncertainty and tie residuals.

    """
    assert pair.T_target_source is not None
    assert pair.ties is not None
    cell = pair.cell
    matched = pair.matches.report if pair.matches is not None else {}
    tolerance = tolerance or max(cell, 1.0) * (1.0 if "reach_m" in matched else UNBOUNDED_CELLS)
    T = pair.T_target_source
    ties = pair.ties
    T_level = pair.target.T_level_work @ T @ transforms.inverse(pair.source.T_level_work)
    residual = np.hypot(*(transforms.apply(T_level, ties.source) - ties.target)[:, :2].T)
    withheld = cross_validated(ties, tolerance, pair.solve_report)
    agreeing = withheld < tolerance
    moved = transforms.apply(T, pair.source.sample)
    overlap = overlap_of(moved, pair.target.sample)
    _, steps = overlap.ground_steps()
    evidence = Evidence(
        withheld=len(withheld),
        withheld_agreeing=int(agreeing.sum()),
        chance=chance_within(tolerance, matched["reach_m"]) if "reach_m" in matched else None,
        tolerance_m=tolerance,
        withheld_median_m=float(np.median(withheld[agreeing])) if agreeing.any() else None,
        margin=matched.get("margin"),
        support=matched.get("support"),
        overlap_m2=overlap.area_m2,
        overlap_source=float(overlap.select(moved).mean()),
        overlap_target=float(overlap.select(pair.target.sample).mean()),
        ground_cells=len(steps),
        ground_agreeing=int((np.abs(steps) < GROUND_AGREES_M).sum()),
        refined_away_m=_refined_away(pair, T),
        refinement_lost=pair.refine_report.get("icp", {}).get("lost_ties", False),
        final_agreeing=int((residual < tolerance).sum()),
    )
    shift = T[:3, 3]
    offset = TransformChain.of(pair).vertical_offset_m
    more = {
        **({} if offset is None else {"vertical_offset_m": offset}),
        "yaw_deg": float(np.degrees(transforms.yaw_of(T[:3, :3]))),
        "tilt_deg": float(np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))),
        "shift_work_m": [float(v) for v in shift],
        "ties": len(ties.score),
        "ties_agreeing": int((residual < tolerance).sum()),
        **_uncertainty(
            ties,
            residual,
            tolerance,
            transforms.apply(T_level, pair.source.levelled_sample.mean(axis=0)[None])[0],
        ),
    }
    return evidence, more


def agreement(pair: Pair, T: Floats, tolerance: float | None = None) -> tuple[int, int]:
    """Count what agrees with a transform: ties in plan, and cells of common ground in height.

    Args:
        pair: with ties and rasters.
        T: 4x4 from source to target work coordinates.
        tolerance: plan distance within which a tie agrees, metres; one cell if None.

    """
    _, steps = overlap_of(transforms.apply(T, pair.source.sample), pair.target.sample).ground_steps()
    return ties_agreeing(pair, T, tolerance), int((np.abs(steps) < GROUND_AGREES_M).sum())


def ties_agreeing(pair: Pair, T: Floats, tolerance: float | None = None) -> int:
    """Count the ties that a transform brings together in plan; arguments as for `agreement`."""
    if pair.ties is None:
        return 0
    T_level = pair.target.T_level_work @ T @ transforms.inverse(pair.source.T_level_work)
    gap = transforms.apply(T_level, pair.ties.source) - pair.ties.target
    return int((np.hypot(gap[:, 0], gap[:, 1]) < (tolerance or max(pair.cell, 1.0))).sum())


def cross_validated(ties: Ties, tolerance: float, solved: dict[str, Any]) -> Floats:
    """Withhold each fold in turn, solve from the others, and give every tie's plan residual while withheld.

    Args:
        ties: ties with folds.
        tolerance: as given to the solver, metres.
        solved: the solver's report, for the settings it ran with.

    Returns:
        (n,) metres; infinite where the others gave no transform.

    """
    residual = np.full(len(ties.score), np.inf)
    for fold in np.unique(ties.fold):
        out = ties.fold == fold
        try:
            solution, _ = solve_ties(
                ties.source,
                ties.target,
                ties.score,
                out,
                tolerance=1.5 * tolerance,
                **solved.get("settings", {}),
            )
        except RegistrationError:
            continue
        gap = transforms.apply(solution.T, ties.source[out]) - ties.target[out]
        residual[out] = np.hypot(gap[:, 0], gap[:, 1])
    return residual


def _refined_away(pair: Pair, T: Floats) -> float:
    """How far the refinement moved the middle of the ties in plan, metres.

    Height is not counted: ties are matched in plan, and take theirs from levelled rasters, which a degree
    of tilt raises by metres. That of the result is judged by the ground.
    """
    before = pair.refine_report.get("T_before")
    if before is None or pair.ties is None or not len(pair.ties.source):
        return 0.0
    middle = transforms.apply(
        transforms.inverse(pair.source.T_level_work), pair.ties.source.mean(axis=0, keepdims=True)
    )
    moved = transforms.apply(T, middle)[0] - transforms.apply(before, middle)[0]
    return float(np.hypot(*(pair.target.T_level_work[:3, :3] @ moved)[:2]))


def _uncertainty(ties: Ties, residual: Floats, tolerance: float, centroid: Floats) -> dict[str, Any]:
    """One standard deviation of yaw and plan position, from the scatter and spread of the ties.

    Args:
        ties: all ties.
        residual: (n,) their plan residuals, metres.
        tolerance: within which a tie agrees, metres.
        centroid: (3,) where the source's centroid comes to lie, in the target's levelled frame.

    """
    near = residual < 2.5 * tolerance
    if near.sum() < 6:
        return {"sigma_yaw_deg": None, "sigma_plan_m": None, "sigma_plan_source_centroid_m": None}
    xy = ties.target[near, :2]
    # a Rayleigh median is 1.1774 standard deviations of one coordinate
    scatter = float(np.median(residual[near])) / 1.1774
    independent = max(float(near.sum()) / TIES_A_PATCH, 1.5)
    middle = xy.mean(axis=0)
    arm = max(float(np.sqrt(((xy - middle) ** 2).sum(axis=1).mean())), 1.0)
    plan = scatter / np.sqrt(independent)
    yaw = plan / arm
    lever = float(np.linalg.norm(centroid[:2] - middle))
    return {
        "sigma_yaw_deg": float(np.degrees(yaw)),
        "sigma_plan_m": float(plan),
        "sigma_plan_source_centroid_m": float(np.hypot(plan, yaw * lever)),
    }
