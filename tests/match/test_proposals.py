"""Poses proposed to the search by others: asked for last, judged like all others, never taken on trust."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from helpers_plots import plot
from helpers_scene import town

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.correlation import CorrelationSettings, match
from mtpcr_geo.match.learned.proposals import COARSEST_CELL_M, LONGEST_PX, PROPOSED
from mtpcr_geo.match.registry import Network
from mtpcr_geo.method.bev import grid_around, rasterise


class Given:
    """Proposes given poses, and counts how often it is asked."""

    def __init__(self, *poses: Hypothesis) -> None:
        self.given, self.asked = list(poses), 0

    def poses(self, source: Bev, target: Bev) -> list[Hypothesis]:
        self.asked += 1
        return self.given


def bev_of(xyz: np.ndarray, cell: float) -> Bev:
    return rasterise([xyz], grid_around(*transforms.bounds(xyz), cell))


def halves(overlap_m: float) -> tuple[Bev, Bev, Hypothesis]:
    """Two views of a town that share a strip of it, the source moved, and the pose that moves it back."""
    rng = np.random.default_rng(4)
    source, target = town(rng, 150_000), town(rng, 150_000)
    source = source[(source[:, 0] < overlap_m / 2) & (source[:, 0] > -40.0)]
    target = target[target[:, 0] > -overlap_m / 2]
    T = transforms.compose(transforms.yaw_matrix(np.radians(70.0)), np.array([35.0, -20.0, 0.0]))
    back = transforms.inverse(T)
    pose = Hypothesis(transforms.yaw_of(back[:3, :3]), (float(back[0, 3]), float(back[1, 3])), 1.0)
    return bev_of(transforms.apply(T, source), 0.5), bev_of(target, 0.5), pose


def near(one: Hypothesis, other: Hypothesis, at: np.ndarray) -> bool:
    places = []
    for pose in (one, other):
        c, s = np.cos(pose.yaw), np.sin(pose.yaw)
        places.append(np.array([[c, -s], [s, c]]) @ at + pose.shift)
    return bool(np.hypot(*(places[0] - places[1])) < 1.0)


def test_nobody_is_asked_where_the_search_settles_by_itself() -> None:
    rng = np.random.default_rng(1)
    given = Given()
    found = match(bev_of(plot(rng), 0.25), bev_of(plot(rng), 0.25), CorrelationSettings(proposals=given))
    assert given.asked == 0
    assert not found.report["by_proposals"]


@pytest.fixture(scope="module")
def strip() -> tuple[Bev, Bev, Hypothesis]:
    return halves(16.0)


SHARE = 0.7
"""Larger than what is shared, so that the search itself does not come upon the pose."""


def test_a_right_pose_that_is_proposed_is_found(strip: tuple[Bev, Bev, Hypothesis]) -> None:
    source, target, true = strip
    middle = np.array(source.grid.to_metres(np.array([[source.grid.width / 2, source.grid.height / 2]]))[0])
    alone = match(source, target, CorrelationSettings(min_overlap_share=SHARE))
    assert not near(alone.hypotheses[0], true, middle)
    # somewhat off, as proposals are
    c, s = np.cos(true.yaw + 0.01), np.sin(true.yaw + 0.01)
    about = np.array([[c, -s], [s, c]]) @ middle
    at = np.array([[np.cos(true.yaw), -np.sin(true.yaw)], [np.sin(true.yaw), np.cos(true.yaw)]]) @ middle
    shift = at + true.shift - about + [0.8, -0.6]
    given = Given(Hypothesis(true.yaw + 0.01, (float(shift[0]), float(shift[1])), 1.0))
    found = match(source, target, CorrelationSettings(min_overlap_share=SHARE, proposals=given))
    assert near(found.hypotheses[0], true, middle)
    assert found.report["by_proposals"]
    # the mirrored source is given what was proposed for it
    assert given.asked == 2


def test_a_search_that_is_left_off_and_carried_on_is_the_whole_search(
    strip: tuple[Bev, Bev, Hypothesis],
) -> None:
    # the larger one is given as the source, so that both are exchanged on the way
    target, source, _ = strip
    if (source.count > 0).sum() < (target.count > 0).sum():
        source, target = target, source
    wrong = Hypothesis(1.0, (30.0, -40.0), 9.0)
    given = Given(wrong), Given(wrong)
    whole = match(source, target, CorrelationSettings(min_overlap_share=SHARE, proposals=given[0]))
    yaws: list[int] = []
    left_off = match(
        source, target, CorrelationSettings(min_overlap_share=SHARE, proposals=given[1]), provisional=True
    )
    assert left_off.search_further is not None
    assert given[1].asked == 0
    # nothing is said of chance where the best does not stand out, and the mirrored source was not searched
    assert left_off.margin is not None
    assert (left_off.null_ratio is None) == (left_off.margin < 1.5)
    done = left_off.search_further(yaws.append)
    assert bool(yaws) == (left_off.null_ratio is None)
    assert given[0].asked == given[1].asked
    assert done.search_further is None
    assert done.hypotheses == whole.hypotheses
    assert (done.margin, done.null_ratio, done.report) == (whole.margin, whole.null_ratio, whole.report)
    assert np.array_equal(done.source_px, whole.source_px)
    assert np.array_equal(done.target_px, whole.target_px)


def test_a_search_that_settles_is_not_left_off() -> None:
    rng = np.random.default_rng(1)
    source, target = bev_of(plot(rng), 0.25), bev_of(plot(rng), 0.25)
    found, whole = (match(source, target, provisional=one) for one in (True, False))
    assert found.search_further is None
    assert found.null_ratio == whole.null_ratio is not None


def test_wrong_poses_that_are_proposed_change_nothing(strip: tuple[Bev, Bev, Hypothesis]) -> None:
    source, target, _ = strip
    settings = CorrelationSettings()
    alone = match(source, target, settings)
    rng = np.random.default_rng(3)
    wrong = [
        Hypothesis(float(rng.uniform(0.0, 6.0)), (float(x), float(y)), 9.0)
        for x, y in rng.uniform(-60.0, 60.0, (6, 2))
    ]
    found = match(source, target, CorrelationSettings(proposals=Given(*wrong)))
    assert found.hypotheses[0] == alone.hypotheses[0]
    assert found.margin is not None
    assert alone.margin is not None
    assert found.margin <= alone.margin


def test_the_network_proposes_the_same_on_any_number_of_threads(
    strip: tuple[Bev, Bev, Hypothesis],
) -> None:
    source, target, _ = strip
    one, two = (Network(threads).proposals().poses(source, target) for threads in (1, 2))
    assert one == two
    assert 0 < len(one) <= PROPOSED
    assert [pose.score for pose in one] == sorted((pose.score for pose in one), reverse=True)
    assert threading.active_count() < 8


def test_the_network_proposes_nothing_where_its_cells_would_be_too_coarse() -> None:
    rng = np.random.default_rng(2)
    cell = 1.6
    far = np.array([[0.0, 0.0, 0.0], [1.3 * LONGEST_PX * cell, 10.0, 0.0]])
    sparse = bev_of(np.vstack([far, rng.uniform(0.0, 50.0, (200, 3))]), cell)
    assert 2 * cell > COARSEST_CELL_M
    assert Network(1).proposals().poses(sparse, sparse) == []
