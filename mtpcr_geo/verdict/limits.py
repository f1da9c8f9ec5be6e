"""What a verdict rests on, and the limits between the verdicts."""

from __future__ import annotations

from dataclasses import dataclass

from mtpcr_geo.core.types import Rival
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.verdict.drift import Drift
from mtpcr_geo.verdict.sliding import Sliding


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
        ground_spread_m, ground_relief_m, ground_noise_m: spread of the height differences between both
            grounds, relief that they have, and spread that their noise explains, metres, see
            `method.overlap.GroundShape`; None where it was not to be told.
        repeats: whether the scene under the pose fits itself after a shift, as rows do.
        self_likeness: correlation of that scene with itself, moved; None where that is not known.
        refined_away_m: how far the refinement ended from where the tie points had led, in plan, metres.
        final_agreeing: of all tie points, those that agree with the final transform; None if not counted.
        refinement_lost: whether surfaces fit better where the tie points do not agree, and the tie points
            were followed.
        null_p: probability that the best of a scene without a true pose is as strong; None likewise.
        uncertainty: of the pose; None where too little agrees to tell.
        quarters_m: how far apart the quarters of the overlap, each solved by itself, put their middles in
            plan, and what is wanted at most, metres; None where that is not known.
        free_space: share of the cells of solids of one cloud in which the other sees the ground; None where
            there are too few.
        objects_missing: share of one cloud's objects at whose place the other sees bare ground only, see
            `free_space.missing_share`; None where there are too few.
        heights_elsewhere: how many times as many heights both clouds would fill in the same columns, were the
            source raised, and raised by how many metres, see `method.common_heights`; None where the lowest
            points of both are ground, or they share too few columns.
        sliding: the motion in plan that the fit tells least; None where that is not known.
        drift: how what is left bends along the overlap; None where that is not known.
        contradictions: what was known beforehand and is not so, a sentence each.
        narrow_prior: whether the place was known so well beforehand that hardly any other pose was searched.

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
    ground_noise_m: float | None = None
    repeats: bool = False
    self_likeness: float | None = None
    missing: str | None = None
    rivals: tuple[Rival, ...] = ()
    mapped: bool = True
    not_levelled: tuple[str, ...] = ()
    null_p: float | None = None
    uncertainty: Uncertainty | None = None
    quarters_m: tuple[float, float] | None = None
    free_space: float | None = None
    objects_missing: float | None = None
    heights_elsewhere: tuple[float, float] | None = None
    sliding: Sliding | None = None
    drift: Drift | None = None
    narrow_prior: bool = False


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
        null_ratio: least strength over the best of the mirrored source to accept. Sites that look alike when
            turned and nearly so when reflected reach 1.3 to 1.65 at wrong poses; of some 230 accepted right
            poses one lies below 2.
        overlap_m2: least overlap to accept, square metres; that of the evidence if None.
        refined_away: most tolerances by which the refinement may move the overlap away from the tie points.
        ground_agreeing: share of the common ground that must agree in height to accept, where any is seen.
            Of flat ground 60 to 66 % agrees under poses a whole block off, and 74 % and more under true ones.
        ground_shape: most spread of the height differences between both grounds, as a share of the relief
            that they have, to accept. Of two places that have nothing to do with each other it is 1.4; under
            true poses of repeating sites it is 0.2 at most, under wrong ones 1.0 to 1.7.
        sure_probability, ground_shape_if_sure: probability from which that share may be larger, and how
            large: crops and brush of one of two dates spread the ground of the right place by 0.4 to 0.8.
        ground_noise_of_rows: where the scene repeats itself, most spread of the height differences between
            both grounds, as a multiple of their noise, to accept: under 46 right poses of simulated rows it
            is 3 to 11, under 50 wrong ones 14 and more but for three. Less, in proportion, where fewer than
            `mtpcr_geo.verdict.findings.AGREE_AMONG_ROWS` of the tie points agree.
        objects_missing: greatest share of objects missing in the other cloud to accept.
        heights_elsewhere: times as many common heights that another height may have at most to accept: under
            true poses of nine real and thirty simulated pairs it has 0.7 at most.

    """

    probability: float = 0.9
    doubtful_probability: float = 0.5
    neg_log10_p: float = 6.0
    doubtful_neg_log10_p: float = 3.0
    agreeing: float = 0.15
    margin: float = 1.3
    null_ratio: float = 1.8
    overlap_m2: float | None = None
    refined_away: float = 2.0
    ground_agreeing: float = 0.7
    ground_shape: float = 0.35
    sure_probability: float = 0.97
    ground_shape_if_sure: float = 0.7
    ground_noise_of_rows: float = 12.0
    objects_missing: float = 0.10
    heights_elsewhere: float = 1.0
