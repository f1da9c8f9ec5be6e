"""Evidence that the fit did not use: quarters, free space, sliding, drift, and what tie points are worth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.types import Pair, TiePoints
from mtpcr_geo.method.neighbourhoods import spacings
from mtpcr_geo.method.overlap import CommonGround, Overlap
from mtpcr_geo.verdict.drift import drift_of
from mtpcr_geo.verdict.free_space import free_space_of
from mtpcr_geo.verdict.limits import Evidence
from mtpcr_geo.verdict.sliding import sliding_of
from mtpcr_geo.verdict.uncertainty import equations_of_pair, giving_way, quarter_spread, uncertainty_of

PATCH_SPACINGS = 2.0
"""Edge of a patch in distances between neighbouring tie points: patches overlap by half."""


def with_further(
    evidence: Evidence,
    pair: Pair,
    overlap: Overlap,
    ground: CommonGround,
    tie_points: TiePoints,
    agreeing: Mask,
) -> tuple[Evidence, dict[str, Any]]:
    """Add to the evidence what is independent of the fit, or tells how far it may be off.

    Args:
        evidence: so far.
        pair: with a transform.
        overlap: of both clouds under it.
        ground: that both see there.
        tie_points: all.
        agreeing: (n,) tie points that agree when held out.

    Returns:
        The evidence, and its metrics.

    """
    effective = effective_number(tie_points.source[:, :2], agreeing)
    free = free_space_of(overlap)
    metrics: dict[str, Any] = {
        "held_out_effective": effective[0],
        "held_out_effective_agreeing": effective[1],
        "solid_cells": free.cells,
        "free_space_conflicts": free.conflicts,
    }
    evidence = replace(evidence, free_space=free.share, objects_missing=free.missing)
    equations = equations_of_pair(pair, ground, evidence.tolerance_m)
    if equations is None:
        return evidence, metrics
    uncertainty = uncertainty_of(pair, equations, ground)
    if uncertainty is None:
        return evidence, metrics
    R_level = uncertainty.R_level
    apart_plan, apart_height = quarter_spread(equations, R_level)
    sliding = sliding_of(uncertainty, equations)
    drift = drift_of(equations, R_level, giving_way(equations))
    metrics |= uncertainty.metrics | {
        "quarters_apart_plan_m": apart_plan,
        "quarters_apart_height_m": apart_height,
        "weakest_motion_m": sliding.sigma_m,
        "weakest_motion_turning": sliding.turning,
        "drift_plan_m": None if drift is None else drift.plan_m,
        "drift_height_m": None if drift is None else drift.height_m,
        "drift_length_m": None if drift is None else drift.length_m,
        "drift_clearness": None if drift is None else drift.clear,
    }
    return (
        replace(
            evidence,
            uncertainty=uncertainty,
            quarters_m=(apart_plan, evidence.tolerance_m),
            sliding=sliding,
            drift=drift,
        ),
        metrics,
    )


def effective_number(xy: Floats, agreeing: Mask) -> tuple[int, int]:
    """Return how many independent places tie points stand for, and how many of these agree.

    Patches overlap by half, so that neighbours see the same and agree together. Tie points in one square of
    the edge of a patch count once, and agree where half of them do.

    Args:
        xy: (n, 2) metres.
        agreeing: (n,) which agree.

    """
    if len(xy) < 2:
        return len(xy), int(agreeing.sum())
    nearest = spacings(xy)
    edge = max(PATCH_SPACINGS * float(np.median(nearest)), 1e-6)
    _, number = np.unique(np.floor(xy / edge).astype(np.int64), axis=0, return_inverse=True)
    number = number.ravel()
    share = np.bincount(number, weights=agreeing.astype(float)) / np.bincount(number)
    return len(share), int((share >= 0.5).sum())
