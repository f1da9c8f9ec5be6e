"""The checks of a verdict: each says what was found, what was wanted, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mtpcr_geo.core.statistics import neg_log10_p
from mtpcr_geo.core.types import Rival
from mtpcr_geo.core.wording import beside, only, percent
from mtpcr_geo.match.base import LARGEST_MARGIN
from mtpcr_geo.verdict.limits import Evidence, Limits
from mtpcr_geo.verdict.probability import may_repeat, rows_over_noise

FEWEST_GROUND_CELLS = 30
FEWEST_HELD_OUT = 4
AGREE_AMONG_ROWS, LEAST_AGREE = 0.6, 0.25
"""Share of the held-out tie points below which the ground among rows must agree the better, and the share
below which it need not agree better still. Of 193 right poses among rows 0.52 and more agree, but for one
whose ground fits; a vineyard without its right place that was accepted had 0.35."""
FLAT_GROUND_M = 0.15
"""Spread of the height differences below which they are noise, and say nothing of the ground's shape."""
LITTLE_SHARED = 0.2
MOST_NAMED = 3
KEPT_SHARE = 0.5
"""Share of the agreeing tie points that refinement must not lose."""

UNBOUNDED_CHANCE = 0.02
"""Chance agreement of a held-out tie point whose matcher searches the whole raster: an upper bound."""


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
    found = [agreement(evidence), *against_others(evidence)]
    value, wanted = percent(probability, limits.probability)
    return CheckFinding(
        f"the pose is right with a probability of {value} only (wanted {wanted}): {'; '.join(found)}; "
        f"{_for_more_evidence(evidence)}",
        refuses=probability < limits.doubtful_probability,
    )


def against_others(evidence: Evidence) -> list[str]:
    """Say how far the pose stands above the next distinct one and the mirrored source."""
    found = []
    if evidence.margin is not None:
        where = " about what was known beforehand" if evidence.narrow_prior else ""
        found.append(
            f"no other distinct pose was found{where}"
            if evidence.margin >= LARGEST_MARGIN
            else f"the next distinct pose{where} is {_times(evidence.margin, 'weaker', 'stronger')}"
        )
    if evidence.null_ratio is not None:
        worse = _times(evidence.null_ratio, "worse", "better")
        found.append(f"the mirrored source, which has no right pose, fits {worse}")
    return found


def _times(ratio: float, below: str, above: str) -> str:
    """Say by how many times something lies below one, or above it."""
    return f"{ratio:.1f} times {below}" if ratio >= 1.0 else f"{1.0 / max(ratio, 0.01):.1f} times {above}"


def chance_text(probability: float) -> str:
    """Say a probability; what is nearly sure is said as such, since no run could show more digits."""
    return f"a probability of {probability_text(probability)}"


def probability_text(probability: float) -> str:
    """Say a probability without its name, see `chance_text`."""
    return "more than 99 %" if probability > 0.99 else f"{100.0 * probability:.0f} %"


def _for_more_evidence(evidence: Evidence) -> str:
    """Say what would tell more."""
    if evidence.missing is not None:
        return evidence.missing
    if max(evidence.overlap_source, evidence.overlap_target) < LITTLE_SHARED:
        return _for_more_tie_points(evidence)
    return _OTHER_PLACES


_LOOK = "look in the report whether outlines lie on each other"


def few_finding(evidence: Evidence) -> CheckFinding | None:
    """Judge whether there are tie points enough to check a result by at all."""
    if evidence.held_out >= FEWEST_HELD_OUT:
        return None
    return CheckFinding(
        f"{only(evidence.held_out, 'tie point')} found, too few to check the result by (wanted "
        f"{FEWEST_HELD_OUT}); {_for_more_tie_points(evidence)}"
    )


def held_out_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge whether as many held-out tie points agree as chance would not give."""
    if evidence.held_out < FEWEST_HELD_OUT:
        return None
    digits = neg_log10_p_of(evidence)
    share = evidence.held_out_agreeing / max(evidence.held_out, 1)
    reached, wanted = beside(digits, limits.neg_log10_p, 1)
    if digits < limits.neg_log10_p and best_neg_log10_p(evidence) < limits.neg_log10_p:
        return CheckFinding(
            f"{agreement(evidence)}: so few tie points cannot rule out chance, even if all agree "
            f"(significance {reached}, wanted {wanted}); {_for_more_tie_points(evidence)}",
            refuses=digits < limits.doubtful_neg_log10_p,
        )
    if digits < limits.doubtful_neg_log10_p:
        reached, wanted = beside(digits, limits.doubtful_neg_log10_p, 1)
        return CheckFinding(
            f"{agreement(evidence)}, no more than chance would give (significance {reached}, refused below "
            f"{wanted}); {evidence.missing or _OTHER_PLACES}",
            refuses=True,
        )
    if digits < limits.neg_log10_p:
        return CheckFinding(
            f"{agreement(evidence)}, hardly more than chance would give (significance {reached}, wanted "
            f"{wanted}); {_LOOK}"
        )
    if share < limits.agreeing:
        found, least = percent(share, limits.agreeing)
        return CheckFinding(
            f"{agreement(evidence)}: {found}, wanted {least}; most places that look alike lie elsewhere "
            f"under this result; {_LOOK}"
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
    others = "; ".join(rival_text(rival, evidence.mapped) for rival in near[:MOST_NAMED])
    others += "; ..." if len(near) > MOST_NAMED else ""
    what = f"another pose, {others}," if len(near) == 1 else "another pose"
    value, wanted = beside(margin, limits.margin, 2)
    if margin < 1.0:
        text = f"{what} fits better (margin {beside(margin, 1.0, 2)[0]}, wanted {wanted})"
    elif len(near) > 1:
        text = f"{len(near)} other poses fit nearly as well (margin {value}, wanted {wanted}): {others}"
    else:
        text = f"{what} fits nearly as well (margin {value}, wanted {wanted})"
    advice = "give larger parts of the clouds"
    advice += ", or say more exactly" if evidence.narrow_prior else ", or say roughly"
    return CheckFinding(f"{text}; {_REPEATS_ITSELF}: {advice} {_WHERE}", refuses=margin < 1.0)


_REPEATS_ITSELF = "the site repeats itself, or too little of it is shared"
_WHERE = "where the source lies (options near, yaw, prior)"


def rival_text(rival: Rival, mapped: bool) -> str:
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
    turn = f"{abs(rival.turn_deg):.0f}"
    return f"{where}, {'not turned' if turn == '0' else f'turned by {turn}°'}"


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
                "the refinement lost the tie points and was not followed: the transform is that of the tie "
                f"points, which agree within {evidence.tolerance_m:g} m"
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


def terrain_of_rows_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge, where the scene may repeat itself, whether the ground agrees as far as its noise lets one see.

    Among rows the terrain decides, and of many places with the same rows on gentle terrain one fits by
    chance, though not to the noise.
    """
    rows = may_repeat(evidence.repeats, evidence.self_likeness)
    ratio = rows_over_noise(rows, evidence.ground_spread_m, evidence.ground_noise_m)
    most = noise_of_rows(evidence, limits)
    if ratio is None or ratio <= most:
        return None
    does = "repeats" if evidence.repeats else "may repeat"
    value, wanted = beside(ratio, most)
    few = ""
    if most < limits.ground_noise_of_rows:
        few = f", since only {evidence.held_out_agreeing} of {evidence.held_out} tie points agree"
    return CheckFinding(
        f"the scene {does} itself, and the ground beneath it differs by {evidence.ground_spread_m:.2f} m, "
        f"{value} times what its noise explains (wanted at most {wanted}{few}): other "
        "rows on similar terrain look so; give more of what lies around it, or say where it is (--near)"
    )


def noise_of_rows(evidence: Evidence, limits: Limits) -> float:
    """Return the most spread of the ground among rows to accept, as a multiple of its noise.

    Where the default search finds less than `AGREE_AMONG_ROWS` of the tie points to agree, what differs from
    row to row, such as missing trees, does not bear the place out, and the terrain must do so the more. Other
    matchers' tie points agree by a minority in any scene.
    """
    if evidence.null_ratio is None or evidence.held_out < FEWEST_HELD_OUT:
        return limits.ground_noise_of_rows
    agree = evidence.held_out_agreeing / evidence.held_out
    if agree >= AGREE_AMONG_ROWS:
        return limits.ground_noise_of_rows
    return limits.ground_noise_of_rows * max(agree, LEAST_AGREE) / AGREE_AMONG_ROWS


def objects_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge whether what stands in one cloud stands in the other too."""
    share = evidence.objects_missing
    if share is None or share <= limits.objects_missing:
        return None
    value, wanted = percent(share, limits.objects_missing)
    return CheckFinding(
        f"at the place of {value} of what stands in one cloud the other sees bare ground (at most {wanted} "
        "is expected): the place is wrong, or much was built or felled in between"
    )


def heights_finding(evidence: Evidence, limits: Limits) -> CheckFinding | None:
    """Judge whether the clouds meet at this height, or at another one."""
    if evidence.heights_elsewhere is None or evidence.heights_elsewhere[0] <= limits.heights_elsewhere:
        return None
    times, rise = evidence.heights_elsewhere
    value, _ = beside(times, limits.heights_elsewhere, 1)
    way = "higher" if rise > 0 else "lower"
    return CheckFinding(
        f"{abs(rise):.1f} m {way}, {value} times as many heights of the source would meet the target's: the "
        "place is wrong, points below the ground (multipath) hide it, or one cloud shows crowns alone and "
        "the other what grows below them; look at a section through both, and leave out what is no surface"
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
    if neg_log10_p_of(evidence) < limits.neg_log10_p:
        return CheckFinding(f"{text}; the pose is no surer than chance makes one; {_LOOK}")
    return CheckFinding(
        f"{text}, though more tie points agree than by chance: a symmetrical site, or one with little in it, "
        "may fit as well turned by half a turn; give more of what lies around it"
    )


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


def agreement(evidence: Evidence) -> str:
    """Say how many held-out tie points agree."""
    return (
        f"{evidence.held_out_agreeing} of {evidence.held_out} held-out tie points agree "
        f"within {evidence.tolerance_m:g} m"
    )


def agreement_beyond_chance(evidence: Evidence) -> str:
    """Say how many held-out tie points agree, beside what chance would give: what an acceptance rests on."""
    agreed = (
        f"{evidence.held_out_agreeing} held-out tie points agree in plan within {evidence.tolerance_m:g} m"
    )
    if evidence.chance is None:
        return f"{agreed}, of {evidence.held_out}"
    return (
        f"{agreed}, where chance would make {evidence.chance * evidence.held_out:.0f} of {evidence.held_out}"
    )


def ground_checked(evidence: Evidence) -> bool:
    """Return whether both clouds see enough ground in common to compare its heights."""
    return evidence.ground_cells >= FEWEST_GROUND_CELLS
