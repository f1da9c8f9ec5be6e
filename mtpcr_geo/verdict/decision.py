"""Assessment: whether a result may be believed.

The verdict never rests on the fit's own residual. It rests on what the fit did not see or could not have
arranged: tie points held out from the solve, how far the best hypothesis stands above the next distinct
one, and how much ground both clouds share. Each check that is not met says what was found, what was wanted,
and what to do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mtpcr_geo.core.types import Verdict, VerdictName
from mtpcr_geo.core.wording import only
from mtpcr_geo.verdict.checks import checks_of, warnings_of
from mtpcr_geo.verdict.findings import (
    FEWEST_GROUND_CELLS,
    CheckFinding,
    against_others,
    agreement_beyond_chance,
    chance_text,
    few_finding,
    ground_checked,
    ground_finding,
    ground_shape_finding,
    heights_finding,
    held_out_finding,
    margin_finding,
    neg_log10_p_of,
    null_finding,
    objects_finding,
    overlap_finding,
    probability_finding,
    refinement_findings,
    terrain_of_rows_finding,
)
from mtpcr_geo.verdict.limits import Evidence, Limits
from mtpcr_geo.verdict.probability import probability_of, probability_of_precise
from mtpcr_geo.verdict.sentence import sentence_of

__all__ = ["Evidence", "Limits", "assess"]


def assess(evidence: Evidence, limits: Limits, more: dict[str, Any] | None = None) -> Verdict:
    """Judge a registration.

    Args:
        evidence: what is known.
        limits: where the verdicts part.
        more: further metrics to keep beside the verdict's own.

    """
    metrics = metrics_of(evidence)
    probability = metrics["probability"] = probability_of(metrics)
    known = {} if evidence.uncertainty is None else evidence.uncertainty.metrics
    metrics["probability_precise"] = probability_of_precise(metrics | known)
    if probability is None:
        judged = held_out_finding(evidence, limits)
        weak = bool(metrics["neg_log10_p"] < limits.neg_log10_p)
    else:
        judged = probability_finding(evidence, limits, probability)
        weak = False  # the probability weighs the evidence together already
        if probability >= limits.sure_probability and not evidence.repeats:
            limits = replace(limits, ground_shape=max(limits.ground_shape, limits.ground_shape_if_sure))
    judgements: dict[str, list[CheckFinding | None]] = {
        "probability": [judged],
        "tie points": [few_finding(evidence)],
        "next distinct pose": [margin_finding(evidence, limits)],
        "mirrored source": [null_finding(evidence, limits)],
        "refinement": [*refinement_findings(evidence, limits)],
        "ground heights": [ground_finding(evidence, limits)],
        "ground shape": [ground_shape_finding(evidence, limits), terrain_of_rows_finding(evidence, limits)],
        "objects": [objects_finding(evidence, limits)],
        "common heights": [heights_finding(evidence, limits)],
        "shared ground": [overlap_finding(evidence, limits)],
    }
    judged_so = {name: [found for found in some if found is not None] for name, some in judgements.items()}
    findings = [found for some in judged_so.values() for found in some]
    refusals = [found.text for found in findings if found.refuses]
    doubts = [found.text for found in findings if not found.refuses]
    doubts += evidence.contradictions
    if len(doubts) >= 2 and weak and not refusals:
        refusals = [f"{len(doubts)} checks are not met, and the rest of the evidence does not make up for it"]
    name: VerdictName = "refused" if refusals else "doubtful" if doubts else "accepted"
    reasons = [*refusals, *doubts] if name != "accepted" else _grounds(evidence, probability)
    rivals = tuple(rival for rival in evidence.rivals if rival.margin < limits.margin)
    notes = not_checked(evidence, name) + warnings_of(evidence)
    return Verdict(
        name,
        (*reasons, *notes),
        metrics | (more or {}),
        () if name == "accepted" else rivals,
        sentence=sentence_of(name, probability, evidence.uncertainty, reasons, mapped=evidence.mapped),
        checks=checks_of(evidence, limits, probability, {key for key, some in judged_so.items() if some}),
        uncertainty=evidence.uncertainty,
    )


def metrics_of(evidence: Evidence) -> dict[str, Any]:
    """Return the evidence by the names that it has in ``run.json``."""
    return {
        "held_out_tie_points": evidence.held_out,
        "held_out_agreeing": evidence.held_out_agreeing,
        "held_out_agreeing_share": evidence.held_out_agreeing / max(evidence.held_out, 1),
        "held_out_tolerance_m": evidence.tolerance_m,
        "held_out_median_m": evidence.held_out_median_m,
        "neg_log10_p": neg_log10_p_of(evidence),
        "hypothesis_margin": evidence.margin,
        "patch_support": evidence.support,
        "null_ratio": evidence.null_ratio,
        "narrow_prior": evidence.narrow_prior,
        "null_p": evidence.null_p,
        "overlap_m2": evidence.overlap_m2,
        "overlap_source": evidence.overlap_source,
        "overlap_target": evidence.overlap_target,
        "ground_cells": evidence.ground_cells,
        "ground_agreeing": evidence.ground_agreeing,
        "ground_checked": ground_checked(evidence),
        "ground_spread_m": evidence.ground_spread_m,
        "ground_relief_m": evidence.ground_relief_m,
        "ground_noise_m": evidence.ground_noise_m,
        "repeats": evidence.repeats,
        "self_likeness": evidence.self_likeness,
        "objects_missing": evidence.objects_missing,
        "heights_elsewhere": None if evidence.heights_elsewhere is None else evidence.heights_elsewhere[0],
        "refined_away_m": evidence.refined_away_m,
        "refinement_lost": evidence.refinement_lost,
    }


def _grounds(evidence: Evidence, probability: float | None) -> list[str]:
    """Return what an acceptance rests on."""
    grounds = [] if probability is None else [f"the pose is right with {chance_text(probability)}"]
    grounds.append(agreement_beyond_chance(evidence))
    grounds += against_others(evidence)
    return [
        *grounds,
        f"the clouds share {evidence.overlap_m2:.0f} m2: {evidence.overlap_source:.0%} of the source, "
        f"{evidence.overlap_target:.0%} of the target",
    ]


def not_checked(evidence: Evidence, name: VerdictName) -> list[str]:
    """Return what could not be checked, or was not known, whatever the verdict."""
    notes = []
    if not ground_checked(evidence):
        notes.append(
            f"not checked: the heights of the ground, which both clouds see in "
            f"{only(evidence.ground_cells, 'cell')} (wanted {FEWEST_GROUND_CELLS})"
        )
    if name != "accepted":
        notes += [
            f"{text}; if it leans, that spoils the match: name its CRS, or level it beforehand"
            for text in evidence.not_levelled
        ]
    return notes
