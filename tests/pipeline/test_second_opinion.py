"""The network's own matches: asked where the search by heights cannot be accepted, never taken on trust."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from helpers_scene import rasterise, town

from mtpcr_geo import register
from mtpcr_geo.benchmark.metrics import rotation_error_deg
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Grey
from mtpcr_geo.core.types import Hypothesis, Matches, Pair
from mtpcr_geo.export.descriptions import transform_rows
from mtpcr_geo.match.base import Features
from mtpcr_geo.match.descriptors import REMEMBERED, Remembering
from mtpcr_geo.match.registry import Network
from mtpcr_geo.pipeline.stages import second_opinion
from mtpcr_geo.pipeline.stages.second_opinion import _significance, is_doubted, is_weak, matched_by_network

NONE = np.empty((0, 2))


def matches(significance: float = 20.0, **figures: float | bool | None) -> Matches:
    return Matches(NONE, NONE, np.empty(0), report={"neg_log10_p": significance}, **figures)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("found", "doubted", "weak"),
    [
        (matches(margin=2.0, null_ratio=2.5), False, False),
        (matches(margin=1.2, null_ratio=2.5), True, False),
        (matches(margin=2.0, null_ratio=1.7), True, False),
        (matches(margin=None), True, False),
        (matches(3.0, margin=2.0, null_ratio=2.5, support=0.1), False, True),
        (matches(3.0, margin=2.0, null_ratio=2.5, support=0.8), False, False),
        (matches(3.0, margin=1.0, null_ratio=1.0, support=0.1, repeats=True), False, False),
    ],
)
def test_the_network_is_asked_where_the_verdict_could_not_accept(
    found: Matches, doubted: bool, weak: bool
) -> None:
    assert is_doubted(found) is doubted
    assert is_weak(found) is weak


class Counting:
    """Describes nothing, and counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0

    def extract(self, image: Grey, empty: int = 0) -> Features:
        self.asked += 1
        return Features(NONE, np.empty(0, np.float32), np.empty((0, 4), np.float32))


def test_an_image_is_described_once_and_the_last_ones_are_remembered() -> None:
    counting = Counting()
    extractor = Remembering(counting)
    images = [np.full((4, 6), k, np.uint8) for k in range(REMEMBERED + 1)]
    first = extractor.extract(images[0])
    assert extractor.extract(images[0].copy()) is first
    assert counting.asked == 1
    extractor.extract(images[0], 127)
    extractor.extract(images[0].reshape(6, 4))
    assert counting.asked == 3, "the same bytes in another shape, or padded otherwise, are another image"
    for image in images[1:]:
        extractor.extract(image)
    extractor.extract(images[0])
    assert counting.asked == 3 + REMEMBERED + 1, "the oldest was let go of"
    extractor.forget()
    extractor.extract(images[0])
    assert counting.asked == 3 + REMEMBERED + 2


@pytest.fixture(scope="module")
def pair() -> Pair:
    """Two views of a town in cells of 0.25 m, registered, as if the search had not stood out."""
    rng = np.random.default_rng(5)
    T = transforms.compose(transforms.yaw_matrix(np.radians(100.0)), np.array([12.0, -7.0, 0.0]))
    source = transforms.apply(transforms.inverse(T), town(rng, 60_000, 60.0))
    found = register(source, town(rng, 90_000, 60.0), cell=0.25, local=True, level="none")
    assert found.pair is not None
    assert found.T_target_source is not None
    np.testing.assert_allclose(found.T_target_source, T, atol=0.1)
    weak = replace(found.pair.matches, margin=1.0)  # type: ignore[type-var]
    return found.pair.with_(matches=weak)


def pose_of(pair: Pair) -> np.ndarray:
    """The best hypothesis as a 4x4 between the levelled clouds."""
    assert pair.matches is not None
    best = pair.matches.hypotheses[0]
    return transforms.compose(transforms.yaw_matrix(best.yaw), np.array([*best.shift, 0.0]))


def test_the_network_finds_the_pose_on_cells_that_it_knows_and_exchanged_the_inverse(pair: Pair) -> None:
    there, margin = matched_by_network(pair, 0, Network(1), lambda n: None)
    assert there is not None
    assert margin is not None
    assert margin >= 1.3
    assert there.cell == 0.5
    assert pair.T_target_source is not None
    assert pair.source.bev is not None
    corners = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
    true = transforms.apply(pair.levelled(pair.T_target_source), corners)
    assert np.abs(transforms.apply(pose_of(there), corners) - true)[:, :2].max() < 1.5
    turned = pair.with_(source=pair.target, target=pair.source)
    back, other = matched_by_network(turned, 0, Network(2), lambda n: None)
    assert back is not None
    assert other == margin, "nor does it hang on the number of threads"
    assert back.matches is not None
    assert there.matches is not None
    # near rows the verdict asks the ground for more
    assert there.matches.self_likeness is not None
    assert there.matches.self_likeness < 0.4
    assert any(name == "matched by" for name, _ in transform_rows(there.with_(tie_points=None)))
    assert np.array_equal(back.matches.source_px, there.matches.target_px)
    np.testing.assert_array_equal(back.matches.source_keypoints, there.matches.target_keypoints)
    np.testing.assert_allclose(pose_of(back) @ pose_of(there), np.eye(4), atol=1e-9)


def test_significant_matches_replace_those_of_a_search_whose_margins_are_enough(pair: Pair) -> None:
    assert pair.matches is not None
    strong = pair.with_(matches=replace(pair.matches, margin=3.0, null_ratio=3.0))
    found, _ = matched_by_network(strong, 0, Network(1), lambda n: None)
    assert found is not None


def test_a_pose_under_which_the_scene_repeats_itself_is_not_taken(pair: Pair, monkeypatch) -> None:
    # as if this town, which fits itself little, were rows of one house
    monkeypatch.setattr(second_opinion, "REPEATS", -1.0)
    found, margin = matched_by_network(pair, 0, Network(1), lambda n: None)
    assert found is None
    assert margin is not None
    assert margin >= 1.3


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_chance_that_was_measured_on_few_matches_is_not_believed(share: float) -> None:
    bev = rasterise(np.array([[0.0, 0.0, 0.0], [10.0, 10.0, 0.0]]))
    px = np.array([[1.0, 1.0], [4.0, 2.0], [7.0, 7.0]])
    best = Hypothesis(0.0, (0.0, 0.0), 1.0)
    found = Matches(px, px + [[0, 0], [5, 5], [5, 5]], np.ones(3), (best,), by_chance=(share, 1.0))
    assert _significance(found, bev, bev) < 6.0


@pytest.mark.slow
def test_another_place_is_refused_with_the_network_as_without() -> None:
    rng = np.random.default_rng(8)
    source, target = town(rng, 40_000, 60.0), town(np.random.default_rng(9), 60_000, 60.0)
    source[:, :2] = source[:, :2] * [0.7, 1.4]
    for asked in (True, False):
        found = register(source, target, local=True, level="none", proposals=asked)
        assert found.verdict.name != "accepted"
        record = next(one for one in found.report if one.type == "mtpcr.match")
        assert ("second_opinion" in record.metadata) is asked


@pytest.mark.slow
def test_little_overlap_between_the_ground_and_the_air_is_found_by_the_network() -> None:
    if find_spec("embreex") is None:
        pytest.skip("embreex, of the extra benchmark, is not installed")
    from mtpcr_geo.benchmark.simulator.pairs import simulate_pair

    chance = np.random.default_rng([20617, 41])
    overlap = float(chance.uniform(0.10, 0.25))
    made = simulate_pair(
        "campus",
        20617,
        extent_m=170.0,
        overlap=overlap,
        tilt_deg=0.0,
        ground=("robot", "tripod")[int(chance.integers(2))],
        air=("airborne", "uav")[int(chance.integers(2))],
        air_density=float(chance.uniform(4.0, 14.0)),
    )
    source = made.source.xyz
    found = register(source, made.target.xyz, local=True, level="none")
    assert found.verdict.name == "accepted"
    assert found.T_target_source is not None
    middle = source.mean(axis=0)[None]
    gap = transforms.apply(found.T_target_source, middle) - transforms.apply(made.T_target_source, middle)
    assert float(np.linalg.norm(gap)) < 0.2
    assert rotation_error_deg(found.T_target_source, made.T_target_source) < 0.2
    record = next(one for one in found.report if one.type == "mtpcr.match")
    assert record.metadata["second_opinion"]["taken"]
