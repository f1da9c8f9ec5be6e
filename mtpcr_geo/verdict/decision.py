"""Assessment: whether a result may be believed.

The verdict never rests on the fit's own residual. It rests on what the fit did not see or could not have
arranged: tie points held out from the solve, how far the best hypothesis stands above the next distinct
one, and how much ground both clouds share. Each check that is not met says what was found, what was wanted,
and what to do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.statistics import neg_log10_p
from mtpcr_geo.core.types import Rival, Verdict, VerdictName
from mtpcr_geo.core.wording import beside, only, percent
from mtpcr_geo.verdict.probability import probability_of

Floats = NDArray[np.float64]

FEWEST_GROUND_CELLS = 30
FEWEST_HELD_OUT = 4
FLAT_GROUND_M = 0.15
"""Spread of the height differences below which they are noise, and say nothing of the ground's shape."""
LITTLE_SHARED = 0.2
MOST_NAMED = 3
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
        missing: what keeps the rasters from giving many matches and what to do, where that is seen.
        rivals: the other hypotheses, strongest first.
        mapped: whether the target's frame has east and north.
        not_levelled: for each cloud whose vertical is not known and was not found, a sentence that says so.
        overlap_source, overlap_target: shares of each cloud's area that lie in the overlap.
        ground_cells: cells where both see the ground.
        ground_agreeing: of these, cells whose heights agree.
        ground_spread_m, ground_relief_m: spread of the height differences between both grounds, and relief
            that they have, metres, see `method.overlap.GroundShape`; None where it was not to be told.
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
    ground_spread_m: float | None = None
    ground_relief_m: float | None = None
    missing: str | None = None
    rivals: tuple[Rival, ...] = ()
    mapped: bool = True
    not_levelled: tuple[str, ...] = ()


@dataclass(frozen=True)
class Limits:
    """Limits between the verdicts.

    Attributes:
        probability: probability of being right to accept, where it is known.
        doubtful_probability: below this the result is refused.
        neg_log10_p: where no probability is known, significance that the held-out tie points must reach to
            be believed: -log10 of the probability that chance makes so many agree.
        doubtful_neg_log10_p: below this the result is refused.
        agreeing: where no probability is known, share of the held-out tie points that must agree to accept.
        margin: least strength over the next hypothesis to accept.
        null_ratio: least strength over the best of the mirrored source to accept.
        overlap_m2: least overlap to accept, square metres; that of the evidence if None.
        refined_away: most tolerances by which the refinement may move the overlap away from the tie points.
        ground_agreeing: share of the common ground that must agree in height to accept, where any is seen.
            Of flat ground 60 to 66 % agrees under poses a whole block off, and 74 % and more under true ones.
        ground_shape: most spread of the height differences between both grounds, as a share of the relief
            that they have, to accept. Of two places that have nothing to do with each other it is 1.4; under
            true poses of repeating sites it is 0.2 at most, under wrong ones 1.0 to 1.7.

    """

    probability: float = 0.95
    doubtful_probability: float = 0.5
    neg_log10_p: float = 6.0
    doubtful_neg_log10_p: float = 3.0
    agreeing: float = 0.15
    margin: float = 1.3
    null_ratio: float = 1.3
    overlap_m2: float | None = None
    refined_away: float = 2.0
    ground_agreeing: float = 0.7
    ground_shape: float = 0.35


def assess(evidence: Evidence, limits: Limits, more: dict[str, Any] | None = None) -> Verdict:
    """Judge a registration.

    Args:
        evidence: what is known.
        limits: where the verdicts part.
        more: further metrics to keep beside the verdict's own.

    """
    metrics = metrics_of(evidence)
    probability = metrics["probability"] = probability_of(metrics)
    if probability is None:
        judged = held_out_finding(evidence, limits)
        weak = metrics["neg_log10_p"] < limits.neg_log10_p
    else:
        judged = probability_finding(evidence, limits, probability)
        weak = probability < limits.probability
    findings = [
        judged,
        margin_finding(evidence, limits),
        null_finding(evidence, limits),
        *refinement_findings(evidence, limits),
        ground_finding(evidence, limits),
        ground_shape_finding(evidence, limits),
        overlap_finding(evidence, limits),
    ]
    refusals = [found.text for found in findings if found is not None and found.refuses]
    doubts = [found.text for found in findings if found is not None and not found.refuses]
    doubts += evidence.contradictions
    if len(doubts) >= 2 and weak and not refusals:
        refusals = [f"{len(doubts)} checks are not met, and the rest of the evidence does not make up for it"]
    name: VerdictName = "refused" if refusals else "doubtful" if doubts else "accepted"
    reasons = [*refusals, *doubts] if name != "accepted" else _grounds(evidence, probability)
    rivals = tuple(rival for rival in evidence.rivals if rival.margin < limits.margin)
    notes = not_checked(evidence, name)
    return Verdict(name, (*reasons, *notes), metrics | (more or {}), () if name == "accepted" else rivals)


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
        "overlap_m2": evidence.overlap_m2,
        "overlap_source": evidence.overlap_source,
        "overlap_target": evidence.overlap_target,
        "ground_cells": evidence.ground_cells,
        "ground_agreeing": evidence.ground_agreeing,
        "ground_checked": ground_checked(evidence),
        "ground_spread_m": evidence.ground_spread_m,
        "ground_relief_m": evidence.ground_relief_m,
        "refined_away_m": evidence.refined_away_m,
        "refinement_lost": evidence.refinement_lost,
    }


def _grounds(evidence: Evidence, probability: float | None) -> list[str]:
    """Return what an acceptance rests on."""
    grounds = [] if probability is None else [f"the pose is right with {_chance(probability)}"]
    grounds.append(_agreement(evidence))
    grounds += _against_others(evidence)
    return [
        *grounds,
        f"the clouds share {evidence.overlap_m2:.0f} m2: {evidence.overlap_source:.0%} of the source, "
        f"{evidence.overlap_target:.0%} of the target",
    ]


def _agreement(evidence: Evidence) -> str:
    return (
        f"{evidence.held_out_agreeing} of {evidence.held_out} held-out tie points agree "
        f"within {evidence.tolerance_m:g} m"
    )


def ground_checked(evidence: Evidence) -> bool:
    """Return whether both clouds see enough ground in common to compare its heights."""
    return evidence.ground_cells >= FEWEST_GROUND_CELLS


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


@dataclass(frozen=True)
class CheckFinding:
    """A check that is not met.

    Attributes:
        text: what was found, what was wanted, what to do.
        refuses: whether it refuses the result; else it makes it doubtful.

    """

    text: str
    refuses: bool = False


def probability_finding(evidence: Evidence, limits: Limits, probability: float) -> CheckFinding | None:
    """Judge the probability of being right, and say what it follows from."""
    if probability >= limits.probability:
        return None
    found = [_agreement(evidence), *_against_others(evidence)]
    value, wanted = percent(probability, limits.probability)
    return CheckFinding(
        f"the pose is right with a probability of {value} only (wanted {wanted}): {'; '.join(found)}; "
        f"{_for_more_evidence(evidence)}",
        refuses=probability < limits.doubtful_probability,
    )


def _against_others(evidence: Evidence) -> list[str]:
    """Say how far the pose stands above the next distinct one and the mirrored source."""
    found = []
    if evidence.margin is not None:
        found.append(f"the next distinct pose is {_times(evidence.margin, 'weaker', 'stronger')}")
    if evidence.null_ratio is not None:
        worse = _times(evidence.null_ratio, "worse", "better")
        found.append(f"the mirrored source, which has no right pose, fits {worse}")
    return found


def _times(ratio: float, below: str, above: str) -> str:
    """Say by how many times something lies below one, or above it."""
    return f"{ratio:.1f} times {below}" if ratio >= 1.0 else f"{1.0 / max(ratio, 0.01):.1f} times {above}"


def _chance(probability: float) -> str:
    """Say a probability; what is nearly sure is said as such, since no run could show more digits."""
    return "a probability of more than 99 %" if probability > 0.99 else f"a probability of {probability:.0%}"


def _for_more_evidence(evidence: Evidence) -> str:
    """Say what would tell more."""
    if evidence.missing is not None:
        return evidence.missing
    if max(evidence.overlap_source, evidence.overlap_target) < LITTLE_SHARED:
        return _for_more_tie_points(evidence)
    return _OTHER_PLACES


def held_out_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge how many held-out tie points agree, and whether they are enough to tell."""
    digits = neg_log10_p_of(evidence)
    share = evidence.held_out_agreeing / max(evidence.held_out, 1)
    if evidence.held_out < FEWEST_HELD_OUT:
        return CheckFinding(
            f"{only(evidence.held_out, 'tie point')} found, too few to check the result by (wanted "
            f"{FEWEST_HELD_OUT}); {_for_more_tie_points(evidence)}"
        )
    reached, wanted = beside(digits, limits.neg_log10_p, 1)
    if digits < limits.neg_log10_p and best_neg_log10_p(evidence) < limits.neg_log10_p:
        return CheckFinding(
            f"{_agreement(evidence)}: so few tie points cannot rule out chance, even if all agree "
            f"(significance {reached}, wanted {wanted}); {_for_more_tie_points(evidence)}",
            refuses=digits < limits.doubtful_neg_log10_p,
        )
    if digits < limits.doubtful_neg_log10_p:
        reached, wanted = beside(digits, limits.doubtful_neg_log10_p, 1)
        return CheckFinding(
            f"{_agreement(evidence)}, no more than chance would give (significance {reached}, refused below "
            f"{wanted}); {evidence.missing or _OTHER_PLACES}",
            refuses=True,
        )
    if digits < limits.neg_log10_p:
        return CheckFinding(
            f"{_agreement(evidence)}, hardly more than chance would give (significance {reached}, wanted "
            f"{wanted}); look at the result before use"
        )
    if share < limits.agreeing:
        found, least = percent(share, limits.agreeing)
        return CheckFinding(
            f"{_agreement(evidence)}: {found}, wanted {least}; most places that look alike lie elsewhere "
            "under this result, look at it before use"
        )
    return None


_OTHER_PLACES = "the clouds may show different places, or too little of the same"


def best_neg_log10_p(evidence: Evidence) -> float:
    """Return the significance that the held-out tie points would reach if all of them agreed."""
    return neg_log10_p_of(replace(evidence, held_out_agreeing=evidence.held_out))


def _for_more_tie_points(evidence: Evidence) -> str:
    """Say what would give more tie points."""
    if evidence.missing is not None:
        return evidence.missing
    if max(evidence.overlap_source, evidence.overlap_target) < LITTLE_SHARED:
        return (
            f"the clouds share {evidence.overlap_m2:.0f} m2 under this result: give parts of them that share "
            "more"
        )
    return "little in them stands out alike: give larger or denser clouds, or try another cell (option cell)"


def margin_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge the strength of the pose against that of the next distinct one, and name the rivals."""
    margin = evidence.margin
    if margin is None or margin >= limits.margin:
        return None
    near = [rival for rival in evidence.rivals if rival.margin < limits.margin]
    others = "; ".join(_rival_text(rival, evidence.mapped) for rival in near[:MOST_NAMED])
    others += "; ..." if len(near) > MOST_NAMED else ""
    what = f"another pose, {others}," if len(near) == 1 else "another pose"
    value, wanted = beside(margin, limits.margin, 2)
    if margin < 1.0:
        text = f"{what} fits better (margin {beside(margin, 1.0, 2)[0]}, wanted {wanted})"
    elif len(near) > 1:
        text = f"{len(near)} other poses fit nearly as well (margin {value}, wanted {wanted}): {others}"
    else:
        text = f"{what} fits nearly as well (margin {value}, wanted {wanted})"
    return CheckFinding(f"{text}; {_AGAINST_RIVALS}", refuses=margin < 1.0)


_AGAINST_RIVALS = (
    "the site repeats itself, or too little of it is shared: give larger parts of the clouds, or a prior if "
    "the place is known (option prior)"
)


def _rival_text(rival: Rival, mapped: bool) -> str:
    """Say where a rival lies from the pose found."""
    ways = (
        (("east", "west"), ("north", "south"))
        if mapped
        else (("along +x", "along -x"), ("along +y", "along -y"))
    )
    parts = [
        f"{abs(value):.{0 if abs(value) >= 10 else 1}f} m {way[0] if value > 0 else way[1]}"
        for value, way in zip((rival.east_m, rival.north_m), ways, strict=True)
        if abs(value) >= max(0.05, 0.1 * rival.apart_m)
    ]
    where = ", ".join(parts) or "at the same place"
    return f"{where}, {abs(rival.turn_deg):.0f} deg turned"


def refinement_findings(evidence: Evidence, limits: Limits) -> list[CheckFinding]:
    """Judge whether the refinement stayed with the tie points."""
    found = []
    most = limits.refined_away * evidence.tolerance_m
    if evidence.refined_away_m > most:
        value, limit = beside(evidence.refined_away_m, most, 1)
        found.append(
            CheckFinding(
                f"the refinement went {value} m away from where the tie points had led (at most {limit} m is "
                "expected); look whether surfaces meet in the report"
            )
        )
    if evidence.refinement_lost:
        found.append(
            CheckFinding(
                "the refinement lost the tie points and was not followed; the result is as exact as they "
                f"are, about {evidence.tolerance_m:g} m"
            )
        )
    final, agreed = evidence.final_agreeing, evidence.held_out_agreeing
    if final is not None and final < KEPT_SHARE * agreed:
        found.append(
            CheckFinding(
                f"the final transform agrees with {only(final, 'tie point')}, {agreed} agreed before "
                f"(at least {KEPT_SHARE:.0%} of them are wanted): the refinement left them",
                refuses=True,
            )
        )
    return found


def ground_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge whether the ground that both see agrees in height, where enough of it is seen."""
    share = evidence.ground_agreeing / max(evidence.ground_cells, 1)
    if not ground_checked(evidence) or share >= limits.ground_agreeing:
        return None
    value, wanted = percent(share, limits.ground_agreeing)
    return CheckFinding(
        f"only {value} of the ground that both clouds see agrees in height (wanted {wanted}, "
        f"{evidence.ground_cells} cells compared): the place is wrong, one cloud leans, or the ground has "
        "changed"
    )


def ground_shape_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge whether the shape of the ground is the same in both clouds, where it has one.

    Where it has little relief, heights of any two places agree within what counts as agreement.
    """
    spread, relief = evidence.ground_spread_m, evidence.ground_relief_m
    if spread is None or relief is None or spread < FLAT_GROUND_M or spread <= limits.ground_shape * relief:
        return None
    return CheckFinding(
        f"the ground of the two clouds differs in shape by {spread:.2f} m, where it rises and falls by "
        f"{relief:.2f} m in each (wanted at most {limits.ground_shape * relief:.2f} m): the place is wrong, "
        "or the ground has changed"
    )


def null_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge the strength of the pose against what a mirrored source reaches."""
    if evidence.null_ratio is None or evidence.null_ratio >= limits.null_ratio:
        return None
    value, wanted = beside(evidence.null_ratio, limits.null_ratio, 2)
    mirrored = "the mirrored source, which has no right pose"
    text = f"it fits only {value} times as well as {mirrored} (wanted {wanted})"
    if evidence.null_ratio < 1.0:
        text = f"it fits less well than {mirrored} ({value} times, wanted {wanted})"
    return CheckFinding(f"{text}; the pose is no surer than chance makes one: look at it before use")


def overlap_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge how much ground the clouds share under the result."""
    least = evidence.least_overlap_m2 if limits.overlap_m2 is None else limits.overlap_m2
    if evidence.overlap_m2 >= least:
        return None
    value, wanted = beside(evidence.overlap_m2, least)
    return CheckFinding(
        f"the clouds share only {value} m2 under this result, wanted {wanted}: {evidence.overlap_source:.0%} "
        f"of the source, {evidence.overlap_target:.0%} of the target; give parts of them that share more",
        refuses=evidence.overlap_m2 < least / 4,
    )


def neg_log10_p_of(evidence: Evidence) -> float:
    """How improbable the agreement of the held-out tie points is by chance, in digits."""
    chance = UNBOUNDED_CHANCE if evidence.chance is None else evidence.chance
    return neg_log10_p(evidence.held_out_agreeing, evidence.held_out, chance)
