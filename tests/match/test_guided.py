"""Places sought about a pose: found where they are if it is right, left to chance if not."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.match.guided import (
    LEAST_SURE,
    REACH_STEPS,
    agreeing_share,
    places_about,
    reach_m,
    within_reach,
)
from mtpcr_geo.match.likelihood import Places

STEP_M = 2.0


def lattice(size_m: float) -> np.ndarray:
    axis = np.arange(0.0, size_m, STEP_M)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def described(at: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Describe places by a field that changes from place to place, seen with noise."""
    field = np.random.default_rng(21)
    wave, phase = field.normal(0.0, 0.35, (64, 2)), field.uniform(0.0, 2 * np.pi, 64)
    true = np.cos(at @ wave.T + phase) / np.sqrt(32.0)
    seen = true + noise / 8.0 * rng.normal(size=true.shape)
    return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True), np.float32)


def both(shift: tuple[float, float], noise: float = 0.4) -> tuple[Places, Places, np.ndarray]:
    """Return source, target and pose; places of the source lie off the target's lattice by a shift."""
    rng = np.random.default_rng(2)
    T = transforms.compose(transforms.yaw_matrix(0.3), np.array([40.0, -7.0, 0.0]))
    at, seen = lattice(80.0), lattice(80.0) + shift
    back = transforms.inverse(T)
    source = Places(seen @ back[:2, :2].T + back[:2, 3], described(seen, noise, rng), STEP_M)
    return source, Places(at, described(at, noise, rng), STEP_M), T


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.6, 0.9), (-0.9, 0.3)])
def test_places_are_found_between_others(shift):
    source, target, T = both(shift)
    found = places_about(source, target, T)
    assert len(found) > 0.5 * len(source)
    assert (np.diff(found.index) > 0).all()
    # at the rim there are no places on one side
    inner = (np.abs(found.at - 39.0) < 36.0).all(axis=1)
    # a place taken for the nearest of the lattice would be off by the shift
    assert np.median(found.off_m[inner]) < 0.25 * STEP_M
    assert (found.sure >= LEAST_SURE).all()
    share = agreeing_share(found, STEP_M)
    assert share is not None
    assert share > 0.9


def test_a_pose_that_is_a_little_off_is_not_followed():
    """Places are found where they are, not where the pose puts them."""
    source, target, T = both((0.0, 0.0))
    off = transforms.compose(np.eye(3), np.array([3.0, -2.0, 0.0])) @ T
    found = places_about(source, target, off)
    inner = (np.abs(found.at - 39.0) < 28.0).all(axis=1)
    true = source.at @ T[:2, :2].T + T[:2, 3]
    assert np.median(np.hypot(*(found.at - true[found.index])[inner].T)) < 0.25 * STEP_M
    assert np.median(found.off_m[inner]) == pytest.approx(np.hypot(3.0, 2.0), abs=0.5)


def test_under_a_wrong_pose_chance_decides():
    source, target, T = both((0.0, 0.0))
    away = transforms.compose(transforms.yaw_matrix(1.2), np.array([30.0, 12.0, 0.0])) @ T
    found = places_about(source, target, away)
    share = agreeing_share(found, STEP_M)
    assert share is None or share < 0.2


def test_rotating_both_clouds_changes_nothing():
    source, target, T = both((0.6, 0.9))
    W = transforms.compose(transforms.yaw_matrix(-2.0), np.array([1000.0, 500.0, 0.0]))
    there = Places(target.at @ W[:2, :2].T + W[:2, 3], target.descriptors, STEP_M)
    here, found = places_about(source, target, T), places_about(source, there, W @ T)
    assert np.array_equal(here.index, found.index)
    assert np.allclose(here.at @ W[:2, :2].T + W[:2, 3], found.at, atol=1e-6)


def test_many_places_in_blocks_are_those_of_few(monkeypatch):
    source, target, T = both((0.6, 0.9))
    whole = places_about(source, target, T)
    monkeypatch.setattr("mtpcr_geo.match.guided.BLOCK_PAIRS", 500)
    parts = places_about(source, target, T)
    assert np.array_equal(whole.index, parts.index)
    assert np.allclose(whole.at, parts.at)


def test_nothing_is_found_where_nothing_lies():
    source, target, T = both((0.0, 0.0))
    empty = Places(np.empty((0, 2)), np.empty((0, 64), np.float32), STEP_M)
    far = transforms.compose(np.eye(3), np.array([500.0, 0.0, 0.0])) @ T
    for pairs in (
        places_about(empty, target, T), places_about(source, empty, T), places_about(source, target, far)
    ):  # fmt: skip
        assert len(pairs) == 0
        assert agreeing_share(pairs, 1.0) is None


def test_pairs_are_within_reach_up_to_that():
    source, target, T = both((0.0, 0.0))
    moved = source.at @ T[:2, :2].T + T[:2, 3]
    reach = reach_m(target)
    assert reach == REACH_STEPS * STEP_M
    near, far = moved + [0.99 * reach, 0.0], moved + [0.0, 1.01 * reach]
    assert within_reach(source.at, near, T, reach).all()
    assert not within_reach(source.at, far, T, reach).any()
