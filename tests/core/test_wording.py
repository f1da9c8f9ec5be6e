from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mtpcr_geo.core.wording import MOST_DECIMALS, beside, counted, only, percent, visible


@pytest.mark.parametrize(
    ("value", "limit", "decimals", "texts"),
    [
        (1.298, 1.3, 2, ("1.298", "1.3")),
        (1.2999, 1.3, 2, ("1.2999", "1.3")),
        (1.12, 1.3, 2, ("1.12", "1.3")),
        (5.96, 6.0, 1, ("5.96", "6")),
        (399.9, 400.0, 0, ("399.9", "400")),
        (57.4, 57.6123, 0, ("57", "58")),
        (57.4, 57.4123, 0, ("57.40", "57.41")),
        (float("inf"), 2.0, 1, ("inf", "2")),
    ],
)
def test_a_value_beside_its_limit_shows_on_which_side_it_is(value, limit, decimals, texts):
    assert beside(value, limit, decimals) == texts


@given(st.floats(0, 1e4, allow_nan=False), st.floats(0.01, 1e4, allow_nan=False), st.integers(0, 3))
def test_what_is_printed_compares_as_the_numbers_do(value, limit, decimals):
    found, wanted = (float(text) for text in beside(value, limit, decimals))
    if abs(value - limit) > 10.0**-MOST_DECIMALS:
        assert (found < wanted) == (value < limit)
        assert found != wanted
    else:
        assert found == pytest.approx(wanted, abs=2e-6)


def test_shares_are_percent_and_few_are_only():
    assert percent(0.6995, 0.7) == ("69.95 %", "70 %")
    assert [only(n, "tie point") for n in (0, 1, 2)] == [
        "no tie points",
        "only 1 tie point",
        "only 2 tie points",
    ]


def test_a_number_has_its_noun():
    assert [counted(n, "tile") for n in (0, 1, 2_000)] == ["0 tiles", "1 tile", "2,000 tiles"]
    assert counted(2, "company", "companies") == "2 companies"


def test_lines_are_escaped_one_by_one():
    text = "plain\nwith \x1b[31m\n\u202e\n\nend\r"
    assert visible(text) == "plain\nwith \\x1b[31m\n\\u202e\n\nend\\r"
