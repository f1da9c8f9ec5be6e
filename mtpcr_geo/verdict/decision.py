"""Assessment: whether a result may be believed.

The verdict never rests on the fit's own residual. It rests on what the fit did not see or could not have
arranged: ties withheld from the solve, how far the best hypothesis stands above the next distinct one, and
how much ground both clouds share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.statistics import surprise
from mtpcr_geo.core.types import Verdict, VerdictName

Floats = NDArray[np.float64]

FEWEST_GROUND_CELLS = 30
KEPT_SHARE = 0.5
"""Share of the agreeing ties that refinement must not lose."""

UNBOUNDED_CHANCE = 0.02
"""Chance agreement of a withheld tie whose matcher looks for it in the whole raster, judged generously."""


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on.

    Attributes:
        withheld: number of ties withheld from the solve.
        withheld_agreeing: of these, ties that the result brings together within the tolerance, in plan.
        chance: share of withheld ties that would agree if they were random within the matcher's reach;
            None where the matcher does not bound its matches, so that chance agreement is negligible.
        tolerance_m: the tolerance.
        withheld_median_m: median plan residual of the agreeing withheld ties, metres.
        margin: strength of the best hypothesis over the next distinct one; None where the matcher gives none.
        support: share of the patches in the overlap that agree on the pose; None likewise.
        overlap_m2: area both clouds cover under the result, square metres.
        overlap_source, overlap_target: shares of each cloud's area that lie in the overlap.
        ground_cells: cells where both see the ground.
        ground_agreeing: of these, cells whose heights agree.
        refined_away_m: how far the refinement moved the overlap from the solution in plan, metres.
        final_agreeing: of all ties, those that agree with the final transform; None if not counted.
        refinement_lost: whether surfaces fit better where the ties do not agree, and the ties were followed.

    """

    withheld: int
    withheld_agreeing: int
    chance: float | None
    tolerance_m: float
    withheld_median_m: float | None
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


@dataclass(frozen=True)
class Limits:
    """Limits between the verdicts.

    Attributes:
        surprise: digits of improbability that the withheld ties must reach to be believed: -log10 of the
            probability that chance makes so many agree.
        doubtful_surprise: below this the result is refused.
        agreeing: share of the withheld ties that must agree to accept.
        margin: least strength over the next hypothesis to accept.
        overlap_m2: least overlap to accept, square metres.
        refined_away: most tolerances by which the refinement may move the overlap away from the ties.
        ground_agreeing: share of the common ground that must agree in height to accept, where any is seen.
            Of flat ground 60 to 66 % agrees under poses a whole block off, and 74 % and more under true ones.

    """

    surprise: float = 6.0
    doubtful_surprise: float = 3.0
    agreeing: float = 0.15
    margin: float = 1.3
    overlap_m2: float = 400.0
    refined_away: float = 2.0
    ground_agreeing: float = 0.7


def assess(evidence: Evidence, limits: Limits, more: dict[str, Any] | None = None) -> Verdict:
    """Judge a registration.

    Args:
        evidence: what is known.
        limits: where the verdicts part.
        more: further metrics to keep beside the verdict's own.

    """
    digits = surprise_of(evidence)
    share = evidence.withheld_agreeing / max(evidence.withheld, 1)
    refusals, doubts = [], []
    told = (
        f"{evidence.withheld_agreeing} of {evidence.withheld} withheld ties agree "
        f"within {evidence.tolerance_m:g} m"
    )
    if evidence.withheld < 4:
        doubts.append(f"only {evidence.withheld} ties could be withheld, too few to check the result by")
    elif digits < limits.doubtful_surprise:
        refusals.append(f"{told}, no more than chance would give")
    elif digits < limits.surprise or share < limits.agreeing:
        doubts.append(f"{told}, hardly more than chance would give")
    if evidence.margin is not None:
        if evidence.margin < 1.0:
            refusals.append(f"another pose fits better (margin {evidence.margin:.2f})")
        elif evidence.margin < limits.margin:
            doubts.append(
                f"another pose fits nearly as well (margin {evidence.margin:.2f}, wanted {limits.margin:g})"
            )
    if evidence.refined_away_m > limits.refined_away * evidence.tolerance_m:
        doubts.append(f"the refinement went {evidence.refined_away_m:.1f} m away from where the ties had led")
    if evidence.refinement_lost:
        doubts.append("the refinement lost the ties and was not followed; the result is as exact as they are")
    final = evidence.final_agreeing
    if final is not None and final < KEPT_SHARE * evidence.withheld_agreeing:
        refusals.append(
            f"the final transform agrees with {final} ties only, {evidence.withheld_agreeing} agreed before"
        )
    ground = evidence.ground_agreeing / max(evidence.ground_cells, 1)
    if evidence.ground_cells >= FEWEST_GROUND_CELLS and ground < limits.ground_agreeing:
        doubts.append(f"only {ground:.0%} of the ground that both clouds see agrees in height")
    if evidence.overlap_m2 < limits.overlap_m2 / 4:
        refusals.append(f"the clouds share only {evidence.overlap_m2:.0f} m2 under this result")
    elif evidence.overlap_m2 < limits.overlap_m2:
        doubts.append(f"the clouds share only {evidence.overlap_m2:.0f} m2 under this result")
    if len(doubts) >= 2 and digits < limits.surprise:
        refusals.append("several checks fail at once: " + "; ".join(doubts))
        doubts = []
    name: VerdictName = "refused" if refusals else "doubtful" if doubts else "accepted"
    reasons = [*refusals, *doubts]
    if name == "accepted":
        reasons = [told]
        if evidence.margin is not None:
            reasons.append(f"the next distinct pose is {evidence.margin:.1f} times weaker")
        reasons.append(
            f"the clouds share {evidence.overlap_m2:.0f} m2: {evidence.overlap_source:.0%} of the source, "
            f"{evidence.overlap_target:.0%} of the target"
        )
    metrics: dict[str, Any] = {
        "withheld_ties": evidence.withheld,
        "withheld_agreeing": evidence.withheld_agreeing,
        "withheld_agreeing_share": share,
        "withheld_tolerance_m": evidence.tolerance_m,
        "withheld_median_m": evidence.withheld_median_m,
        "surprise_digits": digits,
        "hypothesis_margin": evidence.margin,
        "patch_support": evidence.support,
        "overlap_m2": evidence.overlap_m2,
        "overlap_source": evidence.overlap_source,
        "overlap_target": evidence.overlap_target,
        "ground_cells": evidence.ground_cells,
        "ground_agreeing": evidence.ground_agreeing,
        "refined_away_m": evidence.refined_away_m,
    }
    return Verdict(name, tuple(reasons), metrics | (more or {}))


def surprise_of(evidence: Evidence) -> float:
    """How improbable the agreement of the withheld ties is by chance, in digits."""
    chance = UNBOUNDED_CHANCE if evidence.chance is None else evidence.chance
    return surprise(evidence.withheld_agreeing, evidence.withheld, chance)
