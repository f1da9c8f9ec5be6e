"""Verticals as hypotheses: which are tried, and that the strongest is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_scene import houses, make_pair

import mtpcr_geo as mg
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.transforms import angle_deg
from mtpcr_geo.core.types import Matches, Pair
from mtpcr_geo.pipeline.stages.hypotheses import MOST_TRIED, best_vertical, convinces, others

UP = np.array([0.0, 0.0, 1.0])
T30 = transforms.tilt_matrix(0.3, np.radians(30.0))
Y_UP = transforms.axis_angle_matrix(np.array([1.0, 0.0, 0.0]), -np.pi / 2)


def found(strength: float | None, margin: float | None, null_ratio: float | None = None) -> Matches:
    none = np.empty((0, 2))
    return Matches(none, none, np.empty(0), margin=margin, strength=strength, null_ratio=null_ratio)


def turned(R: np.ndarray, trusted: bool = False) -> Pair:
    """A pair whose source is turned by R and kept as it is; the target's vertical is known where wanted."""
    pair = make_pair(state="levelled", crs=None)
    source = replace(pair.source, sample=pair.source.sample @ R.T)
    target = replace(pair.target, levelling=replace(pair.target.levelling, trusted=trusted))
    return pair.with_(source=source, target=target)


def lean_deg(pair: Pair, R: np.ndarray) -> float:
    return angle_deg(pair.source.T_level_work[:3, :3] @ R @ UP, UP)


@pytest.mark.parametrize("R", [T30, Y_UP, np.diag([1.0, -1.0, -1.0])])
@pytest.mark.parametrize("trusted", [False, True])
def test_the_vertical_under_which_matching_is_strongest_is_taken(R: np.ndarray, trusted: bool) -> None:
    pair = turned(R, trusted)

    def attempt(one: Pair) -> Pair:
        return one.with_(matches=found(100.0 - lean_deg(one, R), 1.2))

    best, tried = best_vertical(pair, 0, attempt, attempt)
    assert lean_deg(best, R) < 3.0
    assert 2 <= len(tried) <= MOST_TRIED
    assert [one["taken"] for one in tried].count(True) == 1


def test_no_other_vertical_is_tried_where_the_first_convinces_or_all_are_known() -> None:
    pair = turned(np.eye(3), trusted=True)
    known = pair.with_(source=replace(pair.source, levelling=replace(pair.source.levelling, trusted=True)))

    def refuse(one: Pair) -> Pair:
        raise AssertionError("another vertical was tried")

    for one, margin in ((pair, 3.0), (known, 1.0)):
        best, tried = best_vertical(one, 0, lambda p, m=margin: p.with_(matches=found(9.0, m)), refuse)  # type: ignore[misc]
        assert tried == []
        assert best.source.levelling is one.source.levelling


def test_evidence_of_two_kinds_is_tried_against_that_of_one_even_where_it_convinces() -> None:
    """A floor that leans on a slope, against a cloud kept as given: matches some degrees off convince too."""
    pair = turned(T30)
    pair = pair.with_(source=replace(pair.source, levelling=replace(pair.source.levelling, method="floor")))
    assert pair.target.levelling.method != "floor"

    def attempt(one: Pair) -> Pair:
        kinds = {one.source.levelling.method, one.target.levelling.method}
        return one.with_(matches=found(20.0 if len(kinds) == 1 else 9.0, 3.0, 3.0))

    best, tried = best_vertical(pair, 0, attempt, attempt)
    assert best.source.levelling.method == best.target.levelling.method
    assert all(one["source"] == one["target"] for one in tried[1:])
    # the first is kept where no other is stronger
    best, _ = best_vertical(pair, 0, attempt, lambda one: one.with_(matches=found(1.0, 3.0, 3.0)))
    assert best.source.levelling is pair.source.levelling


def test_nothing_found_under_one_vertical_is_no_end_and_under_all_is() -> None:
    pair = turned(Y_UP)

    def nothing(one: Pair) -> Pair:
        raise RegistrationError("nothing to match")

    best, tried = best_vertical(pair, 0, nothing, lambda one: one.with_(matches=found(5.0, 2.0)))
    assert best.matches is not None
    assert tried[0]["strength"] is None
    with pytest.raises(RegistrationError, match="nothing to match"):
        best_vertical(pair, 0, nothing, nothing)


def test_a_known_vertical_is_left_alone_but_for_a_floor() -> None:
    pair = turned(Y_UP, trusted=True)
    for _, target in others(pair, 0):
        assert target is pair.target.levelling or target.method == "floor"


def test_what_convinces() -> None:
    assert convinces(found(None, None))
    assert convinces(found(100.0, 2.0, 3.0))
    assert not convinces(found(100.0, 1.1, 3.0))
    assert not convinces(found(100.0, 2.0, 1.2))


def test_a_source_with_y_up_is_registered() -> None:
    rng = np.random.default_rng(3)
    target, source = houses(rng, 60_000), houses(rng, 60_000)
    T = transforms.compose(Y_UP @ transforms.yaw_matrix(0.8), np.array([20.0, -30.0, 5.0]))
    result = mg.register(transforms.apply(T, source), target, local=True)
    assert result.verdict.name == "accepted"
    assert result.T_target_source is not None
    E = result.T_target_source @ T
    assert np.degrees(transforms.rotation_angle(E[:3, :3])) < 0.5
    assert np.linalg.norm(E[:3, 3]) < 0.3
