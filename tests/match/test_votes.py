"""Poses by vote: found where partners are among the likely ones only, and not made of chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.base import Features, margin_of
from mtpcr_geo.match.votes import (
    LEAST_STRENGTH,
    Candidates,
    agreeing_keypoints,
    candidates_of,
    poses_by_votes,
    strengths_of,
)

CELL = 1.0
TOLERANCE = 1.5
DIM = 48
SHIFT = np.array([12.0, -7.0])


def grid(edge: int = 150) -> Grid:
    return Grid(-edge * CELL / 2, edge * CELL / 2, CELL, edge, edge)


def unit(vectors: np.ndarray) -> np.ndarray:
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def features(px: np.ndarray, descriptors: np.ndarray) -> Features:
    return Features(px, np.ones(len(px), np.float32), unit(descriptors))


def scene(seed: int, yaw: float, shared: int = 60, others: int = 400, noise: float = 1.1):
    """Make two sets of keypoints that share some, whose descriptors are more noise than likeness."""
    rng = np.random.default_rng(seed)
    R = transforms.yaw_matrix(yaw)[:2, :2]
    source = rng.uniform(-60.0, 60.0, (shared + others, 2))
    target = np.concatenate([source[:shared] @ R.T + SHIFT, rng.uniform(-70.0, 70.0, (others, 2))])
    target += rng.normal(0.0, 0.1, target.shape)
    own = rng.normal(size=(shared + others, DIM))
    other = rng.normal(size=(len(target), DIM))
    other[:shared] = own[:shared] + noise * rng.normal(size=(shared, DIM))
    return features(grid().to_pixel(source), own), features(grid().to_pixel(target), other)


def orientations(source: Features, target: Features, yaw: float, candidates: int) -> list[Candidates]:
    """Vote in eight orientations, of which the two nearest to the yaw know the descriptors."""
    rng = np.random.default_rng(9)
    made = []
    for turn in 2 * np.pi * np.arange(8) / 8:
        near = abs((turn - yaw + np.pi) % (2 * np.pi) - np.pi) < np.radians(26.0)
        seen = source if near else replace(source, descriptors=unit(rng.normal(size=(len(source), DIM))))
        made.append(candidates_of(float(turn), seen, source.px, target, grid(), candidates))
    return made


@pytest.mark.parametrize("yaw_deg", [0.0, 131.0, 339.5])
def test_candidates_carry_a_pose_that_nearest_neighbours_lose(yaw_deg):
    yaw = np.radians(yaw_deg)
    source, target = scene(3, yaw, noise=2.2)
    best, *others = poses_by_votes(orientations(source, target, yaw, 10), target.px, grid(), TOLERANCE)
    assert transforms.yaw_of(best.T[:3, :3]) == pytest.approx((yaw + np.pi) % (2 * np.pi) - np.pi, abs=0.01)
    assert np.allclose(best.T[:2, 3], SHIFT, atol=0.4)
    assert len(best.found) > 1.5 * len(others[0].found)
    # those agreeing are the shared keypoints
    moved = grid().to_metres(best.found.source_px) @ best.T[:2, :2].T + best.T[:2, 3]
    assert (np.hypot(*(moved - grid().to_metres(best.found.target_px)).T) < TOLERANCE).all()


def test_pairs_are_counted_one_to_one():
    yaw = np.radians(22.5)
    source, target = scene(5, yaw, noise=0.3)
    # two orientations see all of it, and every keypoint has several candidates
    made = orientations(source, target, yaw, 5)
    best = poses_by_votes(made, target.px, grid(), TOLERANCE)[0]
    assert 50 <= len(best.found) <= 70
    for px in (best.found.source_px, best.found.target_px):
        assert len(np.unique(px, axis=0)) == len(px)
    agreeing = [agreeing_keypoints(one, best.T, grid().to_metres(target.px), TOLERANCE) for one in made]
    assert sorted(agreeing)[-2] >= 50
    assert max(np.delete(agreeing, [0, 1])) < 20


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_out_where_nothing_is_shared(seed):
    source, target = scene(seed, 1.0, shared=0, others=460)
    found = poses_by_votes(orientations(source, target, 1.0, 5), target.px, grid(), TOLERANCE)
    assert margin_of(strengths_of(found), floor=LEAST_STRENGTH) < 1.3


def test_poses_are_distinct_and_fall():
    source, target = scene(7, 2.0)
    found = poses_by_votes(orientations(source, target, 2.0, 5), target.px, grid(), TOLERANCE)
    counts = [len(one.found) for one in found]
    assert counts == sorted(counts, reverse=True)
    middle = grid().to_metres(source.px).mean(axis=0)
    placed = [one.T[:2, :2] @ middle + one.T[:2, 3] for one in found]
    yaws = [transforms.yaw_of(one.T[:3, :3]) for one in found]
    for i in range(len(found)):
        for j in range(i):
            turned = abs((yaws[i] - yaws[j] + np.pi) % (2 * np.pi) - np.pi)
            assert turned > np.radians(4.0) or np.linalg.norm(placed[i] - placed[j]) > 5 * TOLERANCE


def test_the_same_each_time():
    source, target = scene(8, 0.7)
    one, other = (
        poses_by_votes(orientations(source, target, 0.7, 5), target.px, grid(), TOLERANCE) for _ in range(2)
    )
    assert all(np.array_equal(a.T, b.T) for a, b in zip(one, other, strict=True))


def test_without_keypoints_there_is_no_pose():
    source, target = scene(1, 0.0)
    none = features(np.empty((0, 2)), np.empty((0, DIM)))
    assert (
        poses_by_votes([candidates_of(0.0, none, none.px, target, grid(), 5)], target.px, grid(), TOLERANCE)
        == []
    )
    assert (
        poses_by_votes([candidates_of(0.0, source, source.px, none, grid(), 5)], none.px, grid(), TOLERANCE)
        == []
    )


def test_fewer_keypoints_than_candidates():
    source, target = scene(2, 0.0, shared=3, others=0, noise=0.0)
    best = poses_by_votes(
        [candidates_of(0.0, source, source.px, target, grid(), 50)], target.px, grid(), TOLERANCE
    )[0]
    assert len(best.found) == 3
    assert np.allclose(best.T[:2, 3], SHIFT, atol=0.5)


def test_large_sites_take_coarser_bins():
    rng = np.random.default_rng(4)
    wide = Grid(-1500.0, 1500.0, CELL, 3000, 3000)
    places = rng.uniform(-1000.0, 1000.0, (2, 500, 2))
    places[1, :80] = places[0, :80] + SHIFT
    own, other = rng.normal(size=(2, 500, DIM))
    other[:80] = own[:80] + rng.normal(size=(80, DIM))
    s, t = features(wide.to_pixel(places[0]), own), features(wide.to_pixel(places[1]), other)
    best = poses_by_votes([candidates_of(0.0, s, s.px, t, wide, 5)], t.px, wide, TOLERANCE)[0]
    assert np.allclose(best.T[:2, 3], SHIFT, atol=0.5)
    assert len(best.found) > 60
