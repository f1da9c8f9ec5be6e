"""The table of checks: what was checked, what was found, what is wanted, and whether it is met."""

from __future__ import annotations

from collections.abc import Callable, Collection

from mtpcr_geo.core.types import Check
from mtpcr_geo.core.wording import beside, percent
from mtpcr_geo.match.base import LARGEST_MARGIN
from mtpcr_geo.verdict.findings import (
    FEWEST_GROUND_CELLS,
    FEWEST_HELD_OUT,
    FLAT_GROUND_M,
    ground_checked,
    neg_log10_p_of,
    noise_of_rows,
    probability_text,
)
from mtpcr_geo.verdict.limits import Evidence, Limits
from mtpcr_geo.verdict.probability import LEAST_GROUND_NOISE_M, may_repeat
from mtpcr_geo.verdict.sliding import weakness_text

MOST_CONFLICTS = 0.25
"""Share of conflicts in free space from which they are a warning: true poses of two epochs have some."""


def checks_of(
    evidence: Evidence, limits: Limits, probability: float | None, failed: Collection[str]
) -> tuple[Check, ...]:
    """Return the checks of a verdict, those that decide first.

    Args:
        evidence: what is known.
        limits: where the verdicts part.
        probability: of being right, where known.
        failed: names of the checks that are not met.

    """
    makers: tuple[Callable[[Evidence, Limits], Check], ...] = (
        _margin, _mirrored, _tie_points, _refinement, _ground_heights, _ground_shape, _objects,
        _heights, _shared,
    )  # fmt: skip
    checks = [_probability(evidence, limits, probability), *(make(evidence, limits) for make in makers)]
    decided = [
        Check(one.name, one.value, one.wanted, one.name not in failed, one.meaning)
        if one.passed is not None or one.name in failed
        else one
        for one in checks
    ]
    known = tuple(
        Check("known beforehand", "contradicted", "agrees", False, text) for text in evidence.contradictions
    )
    return (*decided, *known, *_warnings(evidence))


def warnings_of(evidence: Evidence) -> list[str]:
    """Return a sentence for each check that warns."""
    return [
        f"warning: {one.name}: {one.value} (wanted {one.wanted})"
        for one in _warnings(evidence)
        if one.passed is False
    ]


def _probability(evidence: Evidence, limits: Limits, probability: float | None) -> Check:
    if probability is None:
        value, wanted = beside(neg_log10_p_of(evidence), limits.neg_log10_p, 1)
        return Check(
            "probability",
            f"significance {value}",
            f"at least {wanted}",
            True,
            "-log10 of the probability that chance makes as many held-out tie points agree; this matcher has "
            "no model that makes a probability of it.",
        )
    value, wanted = percent(min(probability, 0.999), limits.probability)
    value = probability_text(probability) if probability > 0.99 else value
    return Check(
        "probability",
        value,
        f"at least {wanted}",
        True,
        "of being within 5 degrees and 2 m of the truth, from a model of the evidence below fitted to runs "
        "whose answer is known.",
    )


def _margin(evidence: Evidence, limits: Limits) -> Check:
    meaning = (
        "strength of the pose over that of the next distinct one; strength is the score of the search times "
        "the share of patches that agree times how well the ground agrees."
    )
    if evidence.margin is None:
        return Check("next distinct pose", "not known", f"{limits.margin:g} times", None, meaning)
    value, wanted = beside(evidence.margin, limits.margin, 2)
    if evidence.narrow_prior:
        meaning += (
            " The place was known beforehand, and hardly any other pose searched: the probability counts "
        )
        meaning += "it for no more than the mirrored source's."
    value = "no other" if evidence.margin >= LARGEST_MARGIN else f"{value} times"
    return Check("next distinct pose", value, f"at least {wanted} times", True, meaning)


def _mirrored(evidence: Evidence, limits: Limits) -> Check:
    meaning = (
        "score times support of the pose over the best that the mirrored source reaches, which looks alike "
        "and has no right pose: what chance gives on this pair."
    )
    if evidence.null_ratio is None:
        return Check("mirrored source", "not searched", f"{limits.null_ratio:g} times", None, meaning)
    value, wanted = beside(evidence.null_ratio, limits.null_ratio, 2)
    chance = ""
    if evidence.null_p is not None:
        chance = ", p less than 0.001" if evidence.null_p < 0.001 else f", p {evidence.null_p:.2g}"
        meaning += " p is the probability that the best of a scene without a right pose is as strong."
    return Check("mirrored source", f"{value} times{chance}", f"at least {wanted} times", True, meaning)


def _tie_points(evidence: Evidence, limits: Limits) -> Check:
    return Check(
        "tie points",
        f"{evidence.held_out}, of which {evidence.held_out_agreeing} agree when held out",
        f"at least {FEWEST_HELD_OUT}",
        True,
        f"places matched in both rasters, each judged in plan, within {evidence.tolerance_m:g} m, by a "
        "transform solved without it; most places that look alike lie elsewhere, so that a minority that "
        "agrees is no bad sign: the probability weighs how improbable that is by chance.",
    )


def _refinement(evidence: Evidence, limits: Limits) -> Check:
    value, wanted = beside(evidence.refined_away_m, limits.refined_away * evidence.tolerance_m, 2)
    final = evidence.final_agreeing
    kept = "" if final is None else f"; {final} tie points agree with the final transform"
    lost = "; surfaces fit better where they do not agree" if evidence.refinement_lost else ""
    return Check(
        "refinement",
        f"{value} m away{kept}{lost}",
        f"at most {wanted} m, tie points kept",
        True,
        "how far the refinement ended from where the tie points had led, in plan, at the middle of these.",
    )


def _ground_heights(evidence: Evidence, limits: Limits) -> Check:
    meaning = (
        "share of the cells in which both clouds see the ground, canopy and roofs apart, whose heights agree "
        "within 0.5 m."
    )
    if not ground_checked(evidence):
        value = f"{evidence.ground_cells} cells, fewer than {FEWEST_GROUND_CELLS}"
        return Check("ground heights", value, f"at least {limits.ground_agreeing:.0%}", None, meaning)
    share = evidence.ground_agreeing / max(evidence.ground_cells, 1)
    value, wanted = percent(share, limits.ground_agreeing)
    return Check(
        "ground heights", f"{value} of {evidence.ground_cells:,} cells", f"at least {wanted}", True, meaning
    )


def _ground_shape(evidence: Evidence, limits: Limits) -> Check:
    meaning = (
        "spread of the height differences between both grounds, in blocks; where the ground has relief, two "
        "different places differ by 1.4 times that."
    )
    spread, relief = evidence.ground_spread_m, evidence.ground_relief_m
    if spread is None or relief is None:
        return Check("ground shape", "too little ground", "its relief followed", None, meaning)
    most = max(limits.ground_shape * relief, FLAT_GROUND_M)
    if may_repeat(evidence.repeats, evidence.self_likeness) and evidence.ground_noise_m is not None:
        meaning += (
            " Where the scene repeats itself, or may, it must agree to a multiple of its noise: a smaller "
            "one where few tie points agree."
        )
        most = min(most, noise_of_rows(evidence, limits) * max(evidence.ground_noise_m, LEAST_GROUND_NOISE_M))
    value, wanted = beside(spread, most, 2)
    return Check("ground shape", f"{value} m, relief {relief:.2f} m", f"at most {wanted} m", True, meaning)


def _shared(evidence: Evidence, limits: Limits) -> Check:
    least = evidence.least_overlap_m2 if limits.overlap_m2 is None else limits.overlap_m2
    value, wanted = beside(evidence.overlap_m2, least)
    return Check(
        "shared ground",
        f"{value} m², {evidence.overlap_source:.0%} of the source, {evidence.overlap_target:.0%} of the "
        "target",
        f"at least {wanted} m²",
        True,
        "area of the cells that both clouds fill under the transform.",
    )


def _objects(evidence: Evidence, limits: Limits) -> Check:
    meaning = (
        "share of what stands higher than 2.5 m in one cloud at whose place the other sees bare ground only, "
        "in the direction in which it is less."
    )
    share = evidence.objects_missing
    if share is None:
        return Check("objects", "too few", f"at most {limits.objects_missing:.0%} missing", None, meaning)
    value, wanted = percent(share, limits.objects_missing)
    return Check("objects", f"{value} missing", f"at most {wanted}", True, meaning)


def _heights(evidence: Evidence, limits: Limits) -> Check:
    meaning = (
        "heights at which both clouds have points in the same columns, were the source raised or lowered, "
        "over those at which they have as it lies: walls, crowns and roofs of one place meet at one height "
        "only. Asked where the lowest points of a cloud are so uneven that they are no ground."
    )
    wanted = f"at most {limits.heights_elsewhere:g} times as many elsewhere"
    if evidence.heights_elsewhere is None:
        value = "not asked: the lowest points are ground, or too few columns are shared"
        return Check("common heights", value, wanted, None, meaning)
    times, rise = evidence.heights_elsewhere
    value, _ = beside(times, limits.heights_elsewhere, 2)
    return Check("common heights", f"{value} times as many {rise:+.1f} m from here", wanted, True, meaning)


def _warnings(evidence: Evidence) -> tuple[Check, ...]:
    checks = []
    if evidence.quarters_m is not None:
        value, wanted = beside(*evidence.quarters_m, 2)
        checks.append(
            Check(
                "quarters of the overlap",
                f"{value} m apart in plan",
                f"at most {wanted} m",
                evidence.quarters_m[0] <= evidence.quarters_m[1],
                "standard deviation of where the quarters, each solved by itself, put their middles.",
                decides=False,
            )
        )
    checks += [*_free_space(evidence), *_sliding(evidence), *_drift(evidence)]
    return tuple(checks)


def _free_space(evidence: Evidence) -> list[Check]:
    meaning = (
        "share of the cells inside roofs of one cloud in which the other sees the ground: no roof can stand "
        "there, unless it came or went between the surveys."
    )
    share = evidence.free_space
    if share is None:
        return [Check("free space", "too few roofs", f"at most {MOST_CONFLICTS:.0%}", None, meaning, False)]
    value, wanted = percent(share, MOST_CONFLICTS)
    return [
        Check(
            "free space", f"{value} in conflict", f"at most {wanted}", share <= MOST_CONFLICTS, meaning, False
        )
    ]


def _sliding(evidence: Evidence) -> list[Check]:
    found = evidence.sliding
    if found is None:
        return []
    value, wanted = beside(found.sigma_m, evidence.tolerance_m, 2)
    return [
        Check(
            "sliding",
            f"{value} m {weakness_text(found, evidence.mapped)}",
            f"at most {wanted} m",
            found.sigma_m <= evidence.tolerance_m,
            "standard deviation of the motion in plan that the fit tells least.",
            decides=False,
        )
    ]


def _drift(evidence: Evidence) -> list[Check]:
    found = evidence.drift
    if found is None:
        return []
    pose = evidence.uncertainty.metrics["within_95_plan_m"] if evidence.uncertainty is not None else 0.0
    bends = found.told and max(found.plan_m, found.height_m) > pose
    return [
        Check(
            "drift",
            f"{found.plan_m:.2f} m in plan and {found.height_m:.2f} m in height over {found.length_m:.0f} m",
            f"no clear bend beyond {pose:.2f} m",
            not bends,
            "by how much what is left after the fit bends along the overlap: a rigid transform cannot mend "
            "it, a map from SLAM that is not rigid has it.",
            decides=False,
        )
    ]
