"""Poses by likelihood of dense descriptors: known poses are found at any overlap, and nothing is invented."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.match.likelihood import (
    LEAST_LOG_RATIO,
    Places,
    TurnedPlaces,
    poses_by_likelihood,
)

STEP_M = 2.0
TURNS = 8


def lattice(size_m: float, corner: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    axis = np.arange(0.0, size_m, STEP_M)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + corner


def unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32)


class Scene:
    """A field of descriptors that changes from place to place, seen with noise."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.wave = rng.normal(0.0, 0.35, (64, 2))
        self.phase = rng.uniform(0.0, 2 * np.pi, 64)

    def seen(self, at: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
        true = unit(np.cos(at @ self.wave.T + self.phase))
        return unit(true + noise / 8.0 * rng.normal(size=true.shape))


def views(seed: int, yaw: float, shift: tuple[float, float], *, corner: float, noise: float = 1.5):
    """Return the source in all orientations, the target, and the pose; the source lies off by `corner`."""
    scene, rng = Scene(seed), np.random.default_rng([seed, 1])
    T = transforms.compose(transforms.yaw_matrix(yaw), np.array([*shift, 0.0]))
    target_at = lattice(80.0)
    in_target = lattice(80.0, (corner + 0.6, 0.9))
    back = transforms.inverse(T)
    source_at = in_target @ back[:2, :2].T + back[:2, 3]
    described = scene.seen(in_target, noise, rng)
    orientations = []
    for k in range(TURNS):
        turn = 2 * np.pi * k / TURNS
        off = abs((turn - yaw + np.pi) % (2 * np.pi) - np.pi)
        # a network knows nothing of what is turned by more than it was trained on
        other = unit(rng.normal(size=described.shape))
        orientations.append(
            TurnedPlaces(turn, Places(source_at, described if off < np.radians(30.0) else other, STEP_M))
        )
    return orientations, Places(target_at, scene.seen(target_at, noise, rng), STEP_M), T


def off_by(found: np.ndarray, true: np.ndarray, at: np.ndarray) -> tuple[float, float]:
    turned = transforms.yaw_of(found[:3, :3]) - transforms.yaw_of(true[:3, :3])
    moved = [at @ T[:2, :2].T + T[:2, 3] for T in (found, true)]
    return abs((turned + np.pi) % (2 * np.pi) - np.pi), float(np.linalg.norm(moved[0] - moved[1]))


@pytest.mark.parametrize("yaw_deg", [0.0, 21.0, -97.0, 178.0])
@pytest.mark.parametrize("corner", [0.0, 40.0, 64.0])
def test_a_known_pose_is_found_at_any_yaw_and_overlap(yaw_deg, corner):
    orientations, target, T = views(3, np.radians(yaw_deg), (35.0, -120.0), corner=corner)
    best = poses_by_likelihood(orientations, target)[0]
    middle = orientations[0].places.at.mean(axis=0)
    turned, off = off_by(best.T, T, middle)
    assert turned < np.radians(2.0)
    assert off < STEP_M


def test_a_fifth_of_the_overlap_is_told_from_chance():
    orientations, target, _ = views(5, 0.4, (3.0, 8.0), corner=64.0)
    right = poses_by_likelihood(orientations, target)
    rng = np.random.default_rng(0)
    strange = [
        TurnedPlaces(
            one.turn, Places(one.places.at, unit(rng.normal(size=one.places.descriptors.shape)), STEP_M)
        )
        for one in orientations
    ]
    wrong = poses_by_likelihood(strange, target)
    assert right[0].strength > 1.5 * max(right[1].strength, *(one.strength for one in wrong))


def test_poses_are_distinct_and_ordered():
    orientations, target, _ = views(7, 1.0, (0.0, 0.0), corner=30.0)
    found = poses_by_likelihood(orientations, target, most=5)
    strengths = [one.strength for one in found]
    assert 1 < len(found) <= 5
    assert strengths == sorted(strengths, reverse=True)


def test_moving_a_cloud_moves_the_pose():
    orientations, target, _ = views(9, -0.7, (4.0, 2.0), corner=20.0)
    far = np.array([4000.0, -900.0])
    moved = Places(target.at + far, target.descriptors, STEP_M)
    here, there = (poses_by_likelihood(orientations, one)[0].T for one in (target, moved))
    assert np.allclose(there[:2, 3] - here[:2, 3], far, atol=1e-6)
    assert np.allclose(there[:2, :2], here[:2, :2], atol=1e-9)


def test_a_known_yaw_needs_one_orientation():
    yaw = np.radians(50.0)
    orientations, target, T = views(11, yaw, (5.0, 5.0), corner=30.0)
    one = TurnedPlaces(yaw, min(orientations, key=lambda o: abs(o.turn - yaw)).places)
    best = poses_by_likelihood([one], target, yaw=yaw)[0]
    assert off_by(best.T, T, one.places.at.mean(axis=0))[1] < STEP_M


def test_many_places_are_thinned():
    orientations, _, _ = views(13, 0.0, (0.0, 0.0), corner=0.0)
    places = orientations[0].places
    some = places.thinned(100)
    assert 0 < len(some) <= 100
    assert places.thinned(len(places)) is places


def test_nothing_comes_of_nothing():
    empty = Places(np.empty((0, 2)), np.empty((0, 64), np.float32), STEP_M)
    orientations, target, _ = views(15, 0.0, (0.0, 0.0), corner=0.0)
    assert poses_by_likelihood([TurnedPlaces(0.0, empty)], target) == []
    assert poses_by_likelihood(orientations, empty) == []
    alike = Places(target.at, np.broadcast_to(target.descriptors[:1], target.descriptors.shape), STEP_M)
    assert LEAST_LOG_RATIO > 0.0
    assert poses_by_likelihood([TurnedPlaces(0.0, alike)], alike) == []
