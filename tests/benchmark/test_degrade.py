"""Clouds made worse: what is promised of every way, and of some by name."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_scene import houses

from mtpcr_geo.benchmark.robustness.cases import DegradedClouds
from mtpcr_geo.benchmark.robustness.degrade import WAYS, heights

RNG = np.random.default_rng


@pytest.fixture(scope="module")
def town() -> np.ndarray:
    return houses(RNG(1), 20_000)


@pytest.mark.parametrize("way", WAYS)
def test_what_is_left_is_a_cloud_of_the_same_place(way: str, town: np.ndarray) -> None:
    made = WAYS[way](town, RNG(2))
    assert made.ndim == 2
    assert made.shape[1] == 3
    assert np.isfinite(made).all()
    assert len(made) > 0.01 * len(town)
    assert np.array_equal(made, WAYS[way](town, RNG(2)))
    # strays apart, everything lies within a metre of where something was
    low, high = np.percentile(made, (5.0, 95.0), axis=0)
    assert (low[:2] >= town.min(axis=0)[:2] - 1.0).all()
    assert (high[:2] <= town.max(axis=0)[:2] + 1.0).all()


def test_mirror_images_lie_as_deep_as_the_points_are_high(town: np.ndarray) -> None:
    made = WAYS["multipath"](town, RNG(2))
    assert np.array_equal(made[: len(town)], town)
    above = heights(town)
    assert made[:, 2].min() == pytest.approx((town[:, 2] - 2.0 * above).min(), abs=3.0)


def test_one_station_sees_nothing_behind_what_it_sees() -> None:
    wall = np.column_stack([np.full(4_000, 5.0), RNG(1).uniform(-5, 5, 4_000), RNG(2).uniform(0, 6, 4_000)])
    behind = wall + [4.0, 0.0, 0.0]
    floor = np.column_stack([RNG(3).uniform(-12, 4, (20_000, 2)), RNG(4).normal(0.0, 0.01, 20_000)])
    left = WAYS["one_station"](np.vstack([wall, behind, floor]), RNG(5))
    seen = (np.abs(left[:, 0] - 5.0) < 1e-9).sum()
    hidden = ((np.abs(left[:, 0] - 9.0) < 1e-9) & (np.abs(left[:, 1]) < 4.0)).sum()
    assert seen > 10 * max(hidden, 1)


def test_a_way_is_drawn_by_pair_and_seed(tmp_path) -> None:
    one, other = DegradedClouds(tmp_path / "a", "low", 1), DegradedClouds(tmp_path / "a", "low", 2)
    assert one != other
    assert repr(one) != repr(other)
