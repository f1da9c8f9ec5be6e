from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtpcr_geo.core.statistics import chance_within, neg_log10_p
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
    assert "34 of 40" in verdict.reasons[0]


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
