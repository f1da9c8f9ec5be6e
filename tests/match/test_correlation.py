from __future__ import annotations

import numpy as np
import pytest
from helpers_scene import town

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.correlation import CorrelationSettings, match
from mtpcr_geo.match.nearby import score_nearby
from mtpcr_geo.match.patches import match_patches
from mtpcr_geo.match.pose import Pose, centre_of, pose_of, warp_to
from mtpcr_geo.match.pyramid import search_factors
from mtpcr_geo.match.search import (
    GlobalSearch,
    Layer,
    all_yaws,
    angle_between,
    pairs_of_opposite,
)
from mtpcr_geo.method.bev import grid_around, rasterise
from mtpcr_geo.method.images import channels


def bev_of(xyz: np.ndarray, cell: float = 1.0) -> Bev:
    low, high = transforms.bounds(xyz)
    return rasterise([xyz], grid_around(low, high, cell))


def layer_of(bev: Bev) -> Layer:
    return Layer(bev.grid, channels(bev))


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray]:
    """Two independent samples of one town of which the second shows only a part."""
    rng = np.random.default_rng(0)
    target = town(rng, 90_000, 200.0)
    source = town(rng, 90_000, 200.0)
    return source[(source[:, 0] > -20) & (source[:, 1] < 40)], target


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, 121.5, 200.0, 299.0])
def test_any_yaw_and_shift_is_found(scene: tuple[np.ndarray, np.ndarray], yaw_deg: float) -> None:
    source, target = scene
    T_moved = transforms.compose(transforms.yaw_matrix(np.radians(yaw_deg)), np.array([60.0, -25.0, 4.0]))
    bev_s, bev_t = bev_of(transforms.apply(T_moved, source)), bev_of(target)
    found = match(bev_s, bev_t, CorrelationSettings())
    best = found.hypotheses[0]
    assert np.degrees(angle_between(best.yaw, -np.radians(yaw_deg))) < 1.0
    s = bev_s.grid.to_metres(found.source_px)
    back = transforms.apply(transforms.inverse(T_moved), np.column_stack([s, np.full(len(s), 4.0)]))[:, :2]
    gap = np.hypot(*(back - bev_t.grid.to_metres(found.target_px)).T)
    assert len(gap) >= 10
    assert np.median(gap) < 0.5
    assert found.margin is not None
    assert found.margin > 1.5


def test_a_shift_by_whole_cells_shifts_the_hypothesis_by_as_much(
    scene: tuple[np.ndarray, np.ndarray],
) -> None:
    source, target = scene
    a = match(bev_of(source), bev_of(target), CorrelationSettings())
    b = match(bev_of(source + [32.0, -64.0, 5.0]), bev_of(target), CorrelationSettings())
    moved = np.subtract(b.hypotheses[0].shift, a.hypotheses[0].shift)
    assert np.allclose(moved, [-32.0, 64.0], atol=0.3)


def test_same_input_same_matches(scene: tuple[np.ndarray, np.ndarray]) -> None:
    source, target = (bev_of(xyz) for xyz in scene)
    a, b = (match(source, target, CorrelationSettings()) for _ in range(2))
    assert np.array_equal(a.source_px, b.source_px)
    assert np.array_equal(a.target_px, b.target_px)
    assert a.hypotheses == b.hypotheses


def test_no_correlation_exceeds_one_even_at_small_overlap(scene: tuple[np.ndarray, np.ndarray]) -> None:
    source, target = (layer_of(bev_of(xyz, 4.0)) for xyz in scene)
    score, overlap = GlobalSearch(source, target, 4.0).scores(0.3)
    seen = np.isfinite(score)
    assert (score[seen] <= 2.0 * np.sqrt(np.maximum(overlap[seen], 1.0)) + 1e-3).all()


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.9])
def test_half_a_turn_is_scored_as_if_turned(scene: tuple[np.ndarray, np.ndarray], yaw: float) -> None:
    source, target = (layer_of(bev_of(xyz, 4.0)) for xyz in scene)
    search = GlobalSearch(source, target, 20.5)  # not at a whole number, which rounding may miss
    spectra = search._spectra(search._turned(yaw)[0])
    score, overlap = search._scores(yaw + np.pi, spectra, opposite=True)
    wanted, wanted_overlap = search.scores(yaw + np.pi)
    assert np.array_equal(np.isfinite(score), np.isfinite(wanted))
    seen = np.isfinite(score)
    assert np.allclose(score[seen], wanted[seen], atol=0.01)
    assert np.allclose(overlap, wanted_overlap, atol=1e-2)


def test_yaws_are_searched_once_each_beside_their_opposite() -> None:
    yaws = all_yaws(np.radians(7.0))
    paired = pairs_of_opposite(yaws)
    assert len(yaws) == 2 * len(paired) == 52
    assert sorted(yaw for pair in paired for yaw in pair) == sorted(yaws)
    assert pairs_of_opposite([0.1, 0.2, 0.1 - np.pi, 3.0]) == [(0.1, 0.1 - np.pi), (0.2,), (3.0,)]


def test_poses_and_hypotheses_say_the_same() -> None:
    pivot = np.array([40.0, -12.0])
    hypothesis = Hypothesis(0.8, (13.0, -4.0), 2.0, 7)
    again = pose_of(hypothesis, pivot).hypothesis(pivot)
    assert again.yaw == hypothesis.yaw
    assert np.allclose(again.shift, hypothesis.shift)


def test_warping_puts_a_cell_where_the_pose_says() -> None:
    grid = grid_around(np.zeros(2), np.array([29.0, 19.0]), 1.0)
    image = np.zeros((1, *grid.shape), np.float32)
    image[0, 4, 7] = 1.0
    place = grid.to_metres(np.array([[7.0, 4.0]]))[0] - centre_of(grid)
    target = grid_around(np.full(2, -40.0), np.full(2, 40.0), 1.0)
    pose = Pose(np.pi / 2, 3.5, -8.5)
    row, column = np.unravel_index(np.argmax(warp_to(image, grid, target, pose)[0]), target.shape)
    landed = target.to_metres(np.array([[float(column), float(row)]]))[0]
    assert np.abs(landed - ([-place[1], place[0]] + np.array([3.5, -8.5]))).max() <= 0.5


def test_a_pose_a_little_off_is_drawn_to_the_truth(scene: tuple[np.ndarray, np.ndarray]) -> None:
    source, target = (layer_of(bev_of(xyz)) for xyz in scene)
    centre = centre_of(source.grid)
    best, _ = score_nearby(source, target, Pose(0.0, centre[0] + 2.0, centre[1] - 3.0), 4)
    assert abs(best.east - centre[0]) < 0.6
    assert abs(best.north - centre[1]) < 0.6


def test_patches_measure_a_shift_to_a_fraction_of_a_cell(scene: tuple[np.ndarray, np.ndarray]) -> None:
    source, target = scene
    a, b = layer_of(bev_of(source + [0.4, -0.3, 0.0])), layer_of(bev_of(target))
    found = match_patches(a, b, Pose(0.0, *centre_of(a.grid)), window=4, stride=12)
    assert np.allclose(np.median(found.moved, axis=0), [-0.4, 0.3], atol=0.15)


def test_search_levels_suit_the_size() -> None:
    small = bev_of(np.random.default_rng(1).uniform(0, 60, (20_000, 3)))
    large = bev_of(np.random.default_rng(1).uniform(0, 1500, (400_000, 3)), 2.0)
    assert search_factors(small, small)[0] <= 4
    assert search_factors(large, large)[0] == 4


def test_rasters_too_small_to_compare_are_refused() -> None:
    tiny = bev_of(np.random.default_rng(2).uniform(0, 4, (500, 3)))
    with pytest.raises(RegistrationError, match="overlap enough"):
        match(tiny, tiny, CorrelationSettings())


def test_rasters_too_small_for_a_patch_are_worth_nothing() -> None:
    small = bev_of(np.random.default_rng(2).uniform(0, 6, (500, 3)))
    found = match(small, small, CorrelationSettings())
    assert found.support == 0.0
    assert found.margin == 1.0
    assert found.null_ratio == 1.0
