"""Assessment: whether a result may be believed.

The verdict never rests on the fit's own residual. It rests on what the fit did not see or could not have
arranged: tie points held out from the solve, how far the best hypothesis stands above the next distinct
one, and
how much ground both clouds share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.statistics import neg_log10_p
from mtpcr_geo.core.types import Verdict, VerdictName

Floats = NDArray[np.float64]

FEWEST_GROUND_CELLS = 30
KEPT_SHARE = 0.5
"""Share of the agreeing tie points that refinement must not lose."""

UNBOUNDED_CHANCE = 0.02
"""Chance agreement of a held-out tie point whose matcher searches the whole raster: an upper bound."""


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on.

    Attributes:
        held_out: number of tie points held out from the solve.
        held_out_agreeing: of these, tie points that the result brings together within the tolerance, in plan.
        chance: share of held-out tie points that would agree if they were random within the matcher's reach;
            None where the matcher does not bound its matches, so that chance agreement is negligible.
        tolerance_m: the tolerance.
        held_out_median_m: median plan residual of the agreeing held-out tie points, metres.
        margin: strength of the best hypothesis over the next distinct one; None where the matcher gives none.
        support: share of the patches in the overlap that agree on the pose; None likewise.
        null_ratio: strength of the best hypothesis over the best that the mirrored source reaches, where
            there is no right pose; None where it was not searched.
        overlap_m2: area both clouds cover under the result, square metres.
        least_overlap_m2: the least overlap worth accepting, from both clouds' areas, square metres.
        overlap_source, overlap_target: shares of each cloud's area that lie in the overlap.
        ground_cells: cells where both see the ground.
        ground_agreeing: of these, cells whose heights agree.
        refined_away_m: how far the refinement moved the overlap from the solution in plan, metres.
        final_agreeing: of all tie points, those that agree with the final transform; None if not counted.
        refinement_lost: whether surfaces fit better where the tie points do not agree, and the tie points
            were followed.
        contradictions: what was known beforehand and is not so, a sentence each.

    """

    held_out: int
    held_out_agreeing: int
    chance: float | None
    tolerance_m: float
    held_out_median_m: float | None
    margin: float | None
    support: float | None
    overlap_m2: float
    overlap_source: float
    overlap_target: float
    ground_cells: int
    ground_agreeing: int
    refined_away_m: float
    final_agreeing: int | None = None
    refinement_lost: bool = False
    null_ratio: float | None = None
    least_overlap_m2: float = 400.0
    contradictions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Limits:
    """Limits between the verdicts.

    Attributes:
        neg_log10_p: significance that the held-out tie points must reach to be believed: -log10 of the
            probability that chance makes so many agree.
        doubtful_neg_log10_p: below this the result is refused.
        agreeing: share of the held-out tie points that must agree to accept.
        margin: least strength over the next hypothesis to accept.
        null_ratio: least strength over the best of the mirrored source to accept.
        overlap_m2: least overlap to accept, square metres; that of the evidence if None.
        refined_away: most tolerances by which the refinement may move the overlap away from the tie points.
        ground_agreeing: share of the common ground that must agree in height to accept, where any is seen.
            Of flat ground 60 to 66 % agrees under poses a whole block off, and 74 % and more under true ones.

    """

    neg_log10_p: float = 6.0
    doubtful_neg_log10_p: float = 3.0
    agreeing: float = 0.15
    margin: float = 1.3
    null_ratio: float = 1.6
    overlap_m2: float | None = None
    refined_away: float = 2.0
    ground_agreeing: float = 0.7


def assess(evidence: Evidence, limits: Limits, more: dict[str, Any] | None = None) -> Verdict:
    """Judge a registration.

    Args:
        evidence: what is known.
        limits: where the verdicts part.
        more: further metrics to keep beside the verdict's own.

    """
    digits = neg_log10_p_of(evidence)
    share = evidence.held_out_agreeing / max(evidence.held_out, 1)
    refusals, doubts = [], []
    reported = (
        f"{evidence.held_out_agreeing} of {evidence.held_out} held-out tie points agree "
        f"within {evidence.tolerance_m:g} m"
    )
    if evidence.held_out < 4:
        doubts.append(
            f"only {evidence.held_out} tie points could be held out, too few to check the result by"
        )
    elif digits < limits.doubtful_neg_log10_p:
        refusals.append(f"{reported}, no more than chance would give")
    elif digits < limits.neg_log10_p or share < limits.agreeing:
        doubts.append(f"{reported}, hardly more than chance would give")
    if evidence.margin is not None:
        if evidence.margin < 1.0:
            refusals.append(f"another pose fits better (margin {evidence.margin:.2f})")
        elif evidence.margin < limits.margin:
            doubts.append(
                f"another pose fits nearly as well (margin {evidence.margin:.2f}, wanted {limits.margin:g})"
            )
    if evidence.refined_away_m > limits.refined_away * evidence.tolerance_m:
        doubts.append(
            f"the refinement went {evidence.refined_away_m:.1f} m away from where the tie points had led"
        )
    if evidence.refinement_lost:
        doubts.append(
            "the refinement lost the tie points and was not followed; the result is as exact as they are"
        )
    final = evidence.final_agreeing
    if final is not None and final < KEPT_SHARE * evidence.held_out_agreeing:
        refusals.append(
            f"the final transform agrees with {final} tie points only, {evidence.held_out_agreeing} agreed "
            f"before"
        )
    ground = evidence.ground_agreeing / max(evidence.ground_cells, 1)
    if evidence.ground_cells >= FEWEST_GROUND_CELLS and ground < limits.ground_agreeing:
        doubts.append(f"only {ground:.0%} of the ground that both clouds see agrees in height")
    if evidence.null_ratio is not None and evidence.null_ratio < limits.null_ratio:
        doubts.append(
            f"it fits only {evidence.null_ratio:.2f} times as well as the mirrored source, which has no "
            f"right pose (wanted {limits.null_ratio:g})"
        )
    least = evidence.least_overlap_m2 if limits.overlap_m2 is None else limits.overlap_m2
    shared = f"the clouds share only {evidence.overlap_m2:.0f} m2 under this result, wanted {least:.0f}"
    if evidence.overlap_m2 < least / 4:
        refusals.append(shared)
    elif evidence.overlap_m2 < least:
        doubts.append(shared)
    doubts += evidence.contradictions
    if len(doubts) >= 2 and digits < limits.neg_log10_p:
        refusals.append("several checks fail at once: " + "; ".join(doubts))
        doubts = []
    name: VerdictName = "refused" if refusals else "doubtful" if doubts else "accepted"
    reasons = [*refusals, *doubts]
    if name == "accepted":
        reasons = [reported]
        if evidence.margin is not None:
            reasons.append(f"the next distinct pose is {evidence.margin:.1f} times weaker")
        if evidence.null_ratio is not None:
            reasons.append(
                f"the mirrored source, which has no right pose, fits {evidence.null_ratio:.1f} times worse"
            )
        reasons.append(
            f"the clouds share {evidence.overlap_m2:.0f} m2: {evidence.overlap_source:.0%} of the source, "
            f"{evidence.overlap_target:.0%} of the target"
        )
    metrics: dict[str, Any] = {
        "held_out_tie_points": evidence.held_out,
        "held_out_agreeing": evidence.held_out_agreeing,
        "held_out_agreeing_share": share,
        "held_out_tolerance_m": evidence.tolerance_m,
        "held_out_median_m": evidence.held_out_median_m,
        "neg_log10_p": digits,
        "hypothesis_margin": evidence.margin,
        "patch_support": evidence.support,
        "null_ratio": evidence.null_ratio,
        "overlap_m2": evidence.overlap_m2,
        "overlap_source": evidence.overlap_source,
        "overlap_target": evidence.overlap_target,
        "ground_cells": evidence.ground_cells,
        "ground_agreeing": evidence.ground_agreeing,
        "refined_away_m": evidence.refined_away_m,
    }
    return Verdict(name, tuple(reasons), metrics | (more or {}))


def neg_log10_p_of(evidence: Evidence) -> float:
    """How improbable the agreement of the held-out tie points is by chance, in digits."""
    chance = UNBOUNDED_CHANCE if evidence.chance is None else evidence.chance
    return neg_log10_p(evidence.held_out_agreeing, evidence.held_out, chance)
