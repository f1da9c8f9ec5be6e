from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtpcr_geo.match.base import LARGEST_MARGIN
from mtpcr_geo.verdict.decision import Limits, assess, metrics_of
from mtpcr_geo.verdict.findings import noise_of_rows
from mtpcr_geo.verdict.limits import Evidence
from mtpcr_geo.verdict.probability import (
    FIT,
    PRECISE,
    UNIQUE,
    features_of,
    probability_of,
    probability_of_precise,
    shipped,
)

CLEAR = Evidence(
    held_out=40, held_out_agreeing=34, chance=0.06, tolerance_m=1.0, held_out_median_m=0.3, margin=6.0,
    support=0.8, overlap_m2=9000.0, overlap_source=0.2, overlap_target=0.15, ground_cells=900,
    ground_agreeing=890, refined_away_m=0.2, null_ratio=5.0, ground_spread_m=0.03, ground_relief_m=0.6,
)  # fmt: skip


def probability(**changes: object) -> float:
    found = probability_of(metrics_of(replace(CLEAR, **changes)))  # type: ignore[arg-type]
    assert found is not None
    return found


def test_clear_evidence_is_nearly_sure_and_accepted() -> None:
    assert probability() > 0.99
    verdict = assess(CLEAR, Limits())
    assert verdict.name == "accepted"
    assert "more than 99 %" in verdict.reasons[0]
    assert verdict.metrics["probability"] == probability()


@pytest.mark.parametrize(
    "changes",
    [
        {"margin": 1.5}, {"null_ratio": 1.2}, {"held_out_agreeing": 5}, {"ground_spread_m": 0.5},
        {"ground_agreeing": 500}, {"refinement_lost": True}, {"objects_missing": 0.2},
    ],
)  # fmt: skip
def test_weaker_evidence_never_raises_the_probability(changes: dict) -> None:
    assert probability(**changes) <= probability()


def test_no_piece_of_evidence_counts_against_a_pose() -> None:
    model = shipped()
    for part, names in ((model.fit, FIT), (model.unique, UNIQUE), (model.precise, PRECISE)):
        assert len(part.weights) == len(names)
        assert min(part.weights) >= 0.0


@pytest.mark.parametrize("changes", [{"null_ratio": 1.2}, {"objects_missing": 0.2}])
def test_a_pose_that_may_merely_look_alike_is_not_called_probable(changes: dict) -> None:
    # a site turned by half a turn: everything fits, but its mirror image does too, or its objects are missing
    assert probability(**changes) < 0.5


def test_what_unrelated_places_reach_is_refused_with_what_was_found() -> None:
    weak = replace(
        CLEAR, margin=1.4, null_ratio=1.4, held_out=12, held_out_agreeing=3, ground_spread_m=None,
        ground_relief_m=None, ground_cells=10, ground_agreeing=5,
    )  # fmt: skip
    verdict = assess(weak, Limits())
    assert verdict.name == "refused"
    assert "3 of 12 held-out tie points" in verdict.reasons[0]
    assert "wanted 90 %" in verdict.reasons[0]


def test_without_a_mirrored_source_there_is_no_probability() -> None:
    assert features_of(metrics_of(replace(CLEAR, null_ratio=None))) is None
    verdict = assess(replace(CLEAR, null_ratio=None), Limits())
    assert verdict.metrics["probability"] is None
    assert verdict.name == "accepted"


def test_another_place_with_the_same_rows_is_caught_by_the_shape_of_its_ground() -> None:
    # an orchard elsewhere: everything fits but the terrain
    rows = replace(
        CLEAR, margin=14.9, null_ratio=13.6, held_out=324, held_out_agreeing=222, ground_cells=16089,
        ground_agreeing=8190, ground_spread_m=0.78, ground_relief_m=0.57,
    )  # fmt: skip
    verdict = assess(rows, Limits())
    assert verdict.name != "accepted"
    assert any("differs in shape" in reason for reason in verdict.reasons)


def test_about_a_prior_a_next_pose_that_is_weak_or_missing_proves_nothing() -> None:
    # unrelated plots about a prior of 1.5 m and 3 degrees, of which 6 of 17 tie points agreed
    unrelated = {
        "margin": 11.0, "null_ratio": 2.99, "held_out": 17, "held_out_agreeing": 6, "ground_cells": 60,
        "ground_agreeing": 60, "ground_spread_m": None, "ground_relief_m": None,
    }  # fmt: skip
    assert probability(**unrelated, narrow_prior=True) < probability(**unrelated)
    assert probability(**{**unrelated, "margin": LARGEST_MARGIN}, narrow_prior=True) == pytest.approx(
        probability(**{**unrelated, "margin": 2.99}, narrow_prior=True)
    )
    # a rival counts as ever
    assert probability(margin=1.2, narrow_prior=True) == probability(margin=1.2)
    alone = assess(replace(CLEAR, margin=LARGEST_MARGIN, narrow_prior=True), Limits())
    assert alone.name == "accepted"
    assert any(reason.startswith("no other distinct pose was found") for reason in alone.reasons)
    (check,) = (one for one in alone.checks if one.name == "next distinct pose")
    assert (check.value, check.passed) == ("no other", True)
    rivalled = assess(replace(CLEAR, margin=1.1, narrow_prior=True), Limits())
    assert any("say more exactly where the source lies" in reason for reason in rivalled.reasons)


def test_among_rows_the_ground_must_agree_to_its_noise() -> None:
    rows = replace(CLEAR, repeats=True, ground_spread_m=0.02, ground_noise_m=0.0028)
    assert assess(rows, Limits()).name == "accepted"
    by_chance = replace(rows, ground_spread_m=0.08)
    verdict = assess(by_chance, Limits())
    assert verdict.name != "accepted"
    assert any("repeats itself" in reason for reason in verdict.reasons)
    (shape,) = (check for check in verdict.checks if check.name == "ground shape")
    assert (shape.passed, shape.wanted) == (False, "at most 0.03 m")
    assert probability(repeats=True, ground_spread_m=0.08, ground_noise_m=0.0028) < probability(
        repeats=False, ground_spread_m=0.08, ground_noise_m=0.0028
    )
    # of a scene that does not repeat itself it is not asked, nor where the noise is not known
    assert assess(replace(by_chance, repeats=False), Limits()).name == "accepted"
    assert assess(replace(by_chance, ground_noise_m=None), Limits()).name == "accepted"


def test_a_scene_that_may_be_rows_is_held_to_the_noise_of_its_ground_too() -> None:
    # an orchard with young and missing trees, of which another place was accepted
    orchard = replace(CLEAR, self_likeness=0.36, ground_spread_m=0.147, ground_relief_m=0.25)
    verdict = assess(replace(orchard, ground_noise_m=0.0062), Limits())
    assert verdict.name != "accepted"
    assert any("may repeat itself" in reason for reason in verdict.reasons)
    assert verdict.metrics["self_likeness"] == 0.36
    assert verdict.metrics["probability"] < 0.5
    # the right place of any site agrees to a few times its noise
    right = replace(orchard, ground_spread_m=0.02, ground_noise_m=0.0062)
    assert assess(right, Limits()).name == "accepted"
    assert probability(self_likeness=0.36, ground_spread_m=0.147, ground_noise_m=0.0062) < probability(
        self_likeness=0.28, ground_spread_m=0.147, ground_noise_m=0.0062
    )


def test_among_rows_the_ground_must_agree_the_better_the_fewer_tie_points_do() -> None:
    # a vineyard without its right place, which was accepted: the ground fits nearly as well as right ones
    vineyard = replace(
        CLEAR, repeats=True, self_likeness=0.47, margin=2.33, null_ratio=2.92, held_out=85,
        held_out_agreeing=30, ground_spread_m=0.0372, ground_relief_m=0.17, ground_noise_m=0.00316,
    )  # fmt: skip
    verdict = assess(vineyard, Limits())
    assert verdict.name != "accepted"
    assert any("30 of 85" in reason and "repeats itself" in reason for reason in verdict.reasons)
    (shape,) = (check for check in verdict.checks if check.name == "ground shape")
    assert (shape.passed, shape.wanted) == (False, "at most 0.02 m")
    for agreeing, spread, name in ((60, 0.0372, "accepted"), (44, 0.028, "accepted"), (30, 0.02, "accepted")):
        assert (
            assess(replace(vineyard, held_out_agreeing=agreeing, ground_spread_m=spread), Limits()).name
            == name
        )


def test_few_agreeing_tie_points_are_no_sign_against_rows_with_other_matchers() -> None:
    rows = replace(CLEAR, held_out=85, held_out_agreeing=30)
    limits = Limits()
    assert noise_of_rows(rows, limits) == pytest.approx(12.0 * 30 / 85 / 0.6)
    assert noise_of_rows(replace(rows, null_ratio=None), limits) == 12.0
    assert noise_of_rows(replace(rows, held_out_agreeing=0), limits) == pytest.approx(5.0)
    assert noise_of_rows(replace(rows, held_out=0, held_out_agreeing=0), limits) == 12.0
    assert noise_of_rows(replace(rows, held_out_agreeing=60), limits) == 12.0


def test_too_few_tie_points_are_never_accepted_however_clear_the_rest() -> None:
    verdict = assess(replace(CLEAR, margin=20.0, null_ratio=20.0, held_out=3, held_out_agreeing=3), Limits())
    assert verdict.name == "doubtful"
    assert any("too few to check the result by" in reason for reason in verdict.reasons)


def test_features_are_bounded() -> None:
    found = features_of(metrics_of(replace(CLEAR, margin=1e9, null_ratio=1e-9, ground_spread_m=0.0)))
    assert found is not None
    assert np.isfinite(found).all()


def test_a_site_that_is_its_own_mirror_image_is_told_from_one_where_nothing_stands_out() -> None:
    symmetrical = assess(replace(CLEAR, null_ratio=1.1), Limits())
    assert symmetrical.name == "refused"
    assert any("half a turn" in reason for reason in symmetrical.reasons)
    bare = assess(replace(CLEAR, null_ratio=1.1, held_out_agreeing=4), Limits())
    assert any("no surer than chance" in reason for reason in bare.reasons)


def test_what_is_stated_exactly_is_probably_precise_and_never_more_so_than_right() -> None:
    metrics = metrics_of(CLEAR)
    assert probability_of_precise(metrics) is None  # nothing is known of its accuracy
    found = []
    for plan, turn in ((0.05, 0.01), (0.5, 0.01), (0.5, 0.2), (3.0, 0.5)):
        stated = {"within_95_plan_m": plan, "sigma_yaw_deg": turn, "sigma_tilt_deg": turn}
        one = probability_of_precise(metrics | stated)
        assert one is not None
        found.append(one)
    assert found == sorted(found, reverse=True)
    assert found[0] > 0.95
    assert found[-1] < 0.1
    assert all(one <= probability() for one in found)
