from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtpcr_geo.core.statistics import chance_within, neg_log10_p
from mtpcr_geo.core.types import Rival
from mtpcr_geo.verdict.decision import Evidence, Limits, assess

GOOD = Evidence(
    held_out=40, held_out_agreeing=34, chance=0.06, tolerance_m=1.0, held_out_median_m=0.3, margin=4.0,
    support=0.8, overlap_m2=9000.0, overlap_source=0.2, overlap_target=0.15, ground_cells=900,
    ground_agreeing=870, refined_away_m=0.2,
)  # fmt: skip


def test_surprise_is_the_binomial_tail() -> None:
    # 2 of 2 at a chance of 0.1: 0.01; at least 1 of 2: 0.19
    assert neg_log10_p(2, 2, 0.1) == pytest.approx(2.0)
    assert neg_log10_p(1, 2, 0.1) == pytest.approx(-np.log10(0.19))
    assert neg_log10_p(0, 50, 0.1) == 0.0
    assert neg_log10_p(2000, 2000, 0.01) == 300.0
    assert chance_within(1.0, 3.5) == pytest.approx(np.pi / 49)


def test_good_evidence_is_accepted_with_its_grounds() -> None:
    verdict = assess(GOOD, Limits())
    assert verdict.name == "accepted"
    assert "34 held-out tie points agree" in verdict.reasons[0]
    assert "chance would make 2 of 40" in verdict.reasons[0]


def test_crops_on_the_ground_of_a_pose_that_is_sure_are_borne() -> None:
    sure = replace(GOOD, null_ratio=6.0, margin=12.0, ground_relief_m=0.4)
    assert [assess(replace(sure, ground_spread_m=spread), Limits()).name for spread in (0.2, 0.36)] == [
        "accepted", "doubtful",
    ]  # fmt: skip
    # where the rest is less sure it is a doubt
    less = replace(sure, margin=1.6, held_out_agreeing=10, ground_spread_m=0.2)
    assert assess(less, Limits()).name != "accepted"
    assert assess(replace(less, ground_spread_m=0.05), Limits()).name == "accepted"


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"held_out_agreeing": 3}, "refused"),
        ({"held_out": 13, "held_out_agreeing": 6}, "doubtful"),
        ({"margin": 1.1}, "doubtful"),
        ({"margin": 0.9}, "refused"),
        ({"overlap_m2": 200.0}, "doubtful"),
        ({"overlap_m2": 50.0}, "refused"),
        ({"refined_away_m": 5.0}, "doubtful"),
        ({"ground_agreeing": 300}, "doubtful"),
        ({"held_out": 2, "held_out_agreeing": 2}, "doubtful"),
        ({"held_out": 13, "held_out_agreeing": 6, "margin": 1.1}, "refused"),
        ({"margin": None, "support": None}, "accepted"),
        ({"final_agreeing": 10}, "refused"),
        ({"refinement_lost": True}, "doubtful"),
        ({"objects_missing": 0.14}, "doubtful"),
        ({"objects_missing": 0.07}, "accepted"),
        ({"heights_elsewhere": (1.2, -7.5)}, "doubtful"),
        ({"heights_elsewhere": (0.7, 2.0)}, "accepted"),
        ({"null_ratio": 1.65}, "doubtful"),
        ({"ground_agreeing": 590}, "doubtful"),
    ],
)
def test_each_weakness_is_named(change: dict, name: str) -> None:
    verdict = assess(replace(GOOD, **change), Limits())
    assert verdict.name == name
    assert verdict.reasons


def test_a_perfect_fit_residual_alone_convinces_nobody() -> None:
    few = replace(GOOD, held_out=3, held_out_agreeing=3, held_out_median_m=0.001, margin=1.05)
    assert assess(few, Limits()).name == "refused"


def reasons_of(change: dict) -> str:
    return "\n".join(assess(replace(GOOD, **change), Limits()).reasons)


@pytest.mark.parametrize(
    ("change", "texts"),
    [
        ({"margin": 1.2996}, ["margin 1.2996, wanted 1.3"]),
        ({"null_ratio": 1.799}, ["1.799 times", "wanted 1.8"]),
        ({"null_ratio": 0.8}, ["less well than the mirrored", "0.80 times, wanted 1.8"]),
        ({"ground_agreeing": 629}, ["69.9 % of the ground", "wanted 70 %", "900 cells"]),
        ({"overlap_m2": 399.9}, ["only 399.9 m2", "wanted 400", "20% of the source"]),
        ({"refined_away_m": 2.01}, ["went 2.01 m away", "at most 2 m"]),
        (
            {"held_out": 300, "held_out_agreeing": 44, "chance": 0.02},
            ["44 of 300 held-out tie points agree", "14.7 %, wanted 15 %"],
        ),
    ],
)
def test_a_value_and_what_was_wanted_do_not_contradict_each_other(change: dict, texts: list[str]) -> None:
    reasons = reasons_of(change)
    for text in texts:
        assert text in reasons


def test_too_few_tie_points_are_told_from_too_few_that_agree() -> None:
    few = reasons_of({"held_out": 4, "held_out_agreeing": 4, "missing": "the cells are coarse: give finer"})
    assert "so few tie points cannot rule out chance" in few
    assert "the cells are coarse: give finer" in few
    assert "hardly more than chance" not in few
    wrong = reasons_of({"held_out": 30, "held_out_agreeing": 8})
    assert "hardly more than chance" in wrong
    assert "so few" not in wrong


def test_checks_that_fail_together_are_listed_one_by_one() -> None:
    verdict = assess(replace(GOOD, held_out=13, held_out_agreeing=6, margin=1.1), Limits())
    assert verdict.name == "refused"
    assert verdict.reasons[0].startswith("2 checks are not met")
    assert len(verdict.reasons) == 3
    assert "fits nearly as well" in verdict.reasons[2]


def test_what_could_not_be_checked_is_said_whatever_the_verdict() -> None:
    bare = assess(replace(GOOD, ground_cells=11, ground_agreeing=0, not_levelled=("it leans",)), Limits())
    assert bare.name == "accepted"
    assert "not checked" in bare.reasons[-1]
    assert "11 cells (wanted 30)" in bare.reasons[-1]
    assert bare.metrics["ground_checked"] is False
    assert assess(GOOD, Limits()).metrics["ground_checked"] is True
    doubted = assess(replace(GOOD, margin=1.1, not_levelled=("the source was not levelled: why",)), Limits())
    assert "the source was not levelled: why" in doubted.reasons[-1]


NEAR, FAR = Rival(1.2, -0.4, 0.5, 1.15, False), Rival(41.0, 0.4, 0.2, 1.2, True)
TURNED = Rival(0.1, 0.0, -180.0, 1.25, True)


@pytest.mark.parametrize(
    ("rivals", "mapped", "text", "withheld"),
    [
        ((FAR,), True, "another pose, 41 m east, not turned, fits nearly as well (margin 1.15", True),
        ((NEAR,), False, "another pose, 1.2 m along +x, 0.4 m along -y, not turned", False),
        ((TURNED,), True, "0.1 m east, turned by 180°", True),
        ((NEAR, FAR), True, "2 other poses fit nearly as well", True),
        ((), True, "another pose fits nearly as well", False),
        ((replace(FAR, margin=2.0),), True, "another pose fits nearly as well", False),
    ],
)
def test_rivals_are_named_and_a_far_one_withholds_the_cloud(rivals, mapped, text, withheld) -> None:
    verdict = assess(replace(GOOD, margin=1.15, rivals=rivals, mapped=mapped), Limits())
    assert verdict.name == "doubtful"
    assert text in verdict.reasons[0]
    assert (verdict.withholds_cloud is not None) == withheld
    assert verdict.withholds_transform is None
    accepted = assess(replace(GOOD, rivals=rivals), Limits())
    assert (accepted.rivals, accepted.withholds_cloud) == ((), None)


def test_a_refused_result_withholds_everything() -> None:
    verdict = assess(replace(GOOD, overlap_m2=50.0), Limits())
    assert verdict.withholds_cloud == verdict.withholds_transform == "the verdict is refused"
