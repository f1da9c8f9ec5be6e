"""Hypotheses on their way from coarse to fine cells, on a made-up town."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_scene import houses

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Hypothesis
from mtpcr_geo.match.descent import FEWEST_FOLLOWED, GROWTH_MARGIN, comb, follow
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.pyramid import Pyramid
from mtpcr_geo.method.bev import grid_around, rasterise

FACTOR = 4


@pytest.fixture(scope="module")
def pyramid() -> Pyramid:
    rng = np.random.default_rng(31)
    source, target = (
        rasterise([xyz], grid_around(*transforms.bounds(xyz), 1.0))
        for xyz in (houses(rng, 60_000), houses(rng, 60_000))
    )
    return Pyramid(source, target)


def about(pyramid: Pyramid, factor: int, yaw: float, east: float, north: float, score: float = 1.0) -> Pose:
    pose = pose_of(Hypothesis(yaw, (east, north), score), centre_of(pyramid.at(factor)[0].grid))
    return Pose(pose.yaw, pose.east, pose.north, score)


@pytest.mark.parametrize(
    ("turn_deg", "east", "north"), [(0.0, 0.0, 0.0), (2.0, 5.0, -4.0), (-1.7, -3.0, 6.0)]
)
def test_a_pose_a_coarse_cell_off_comes_down_to_the_truth(pyramid, turn_deg, east, north) -> None:
    found = follow(pyramid, FACTOR, [about(pyramid, FACTOR, np.radians(turn_deg), east, north)])
    (pose,) = found.poses
    true = about(pyramid, 1, 0.0, 0.0, 0.0)
    assert np.hypot(pose.east - true.east, pose.north - true.north) < 1.0
    assert abs(np.degrees(pose.yaw)) < 0.5
    assert found.bound == 0.0


def test_what_cannot_matter_is_left_above_with_a_bound_that_holds(pyramid) -> None:
    rng = np.random.default_rng(1)
    poses = [about(pyramid, FACTOR, 0.0, 0.0, 0.0, 30.0)]
    poses += [
        about(pyramid, FACTOR, rng.uniform(0, 6), rng.uniform(-60, 60), rng.uniform(-60, 60), score)
        for score in (*np.linspace(25.0, 20.0, 7), 1.0, 0.9, 0.8)
    ]
    everything = follow(pyramid, FACTOR, poses)
    assert len(everything.poses) == len(poses)
    worth = 0.5 * max(pose.score for pose in everything.poses)
    some = follow(pyramid, FACTOR, poses, worth)
    assert some.poses == everything.poses[: len(some.poses)]
    assert FEWEST_FOLLOWED <= len(some.poses) < len(poses)
    assert 0.0 < some.bound < worth
    assert GROWTH_MARGIN > 1.0


def test_nothing_to_follow_is_nothing(pyramid) -> None:
    found = follow(pyramid, FACTOR, [])
    assert (found.poses, found.bound) == ((), 0.0)


@pytest.mark.parametrize(
    ("turn_deg", "east", "north"), [(0.0, 0.0, 0.0), (0.8, 6.0, -5.0), (-0.5, -7.0, 2.0)]
)
def test_combing_finds_the_truth_some_metres_away(pyramid, turn_deg, east, north) -> None:
    found = comb(pyramid, about(pyramid, 1, np.radians(turn_deg), east, north), 8.0)
    true = about(pyramid, 1, 0.0, 0.0, 0.0)
    assert np.hypot(found.east - true.east, found.north - true.north) < 1.0
    assert abs(np.degrees(found.yaw)) < 0.3
