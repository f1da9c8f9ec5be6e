from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Matches, TiePoints
from mtpcr_geo.method.inverse_mapping import folds_of, tie_points_of
from mtpcr_geo.method.solve import fit_rigid, fit_upright, iterative_svd, ransac_upright, solve_tie_points


@given(st.floats(-np.pi, np.pi), st.floats(-0.3, 0.3), st.integers(0, 100))
@settings(max_examples=40)
def test_a_rigid_transform_is_recovered_exactly(yaw: float, tilt: float, seed: int) -> None:
    source = np.random.default_rng(seed).uniform(-100, 100, (8, 3))
    T = transforms.compose(
        transforms.yaw_matrix(yaw) @ transforms.tilt_matrix(0.5, tilt), np.array([5.0, 6.0, 7.0])
    )
    found = fit_rigid(source, transforms.apply(T, source))
    assert np.allclose(found, T, atol=1e-9)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_hand_worked_quarter_turn() -> None:
    source = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    target = np.array([[10.0, 6.0], [9.0, 5.0], [10.0, 4.0]])
    T = fit_upright(source, target)
    assert np.allclose(T[:2, :2], [[0, -1], [1, 0]], atol=1e-12)
    assert np.allclose(T[:2, 3], [10.0, 5.0])


def test_a_mirrored_scene_never_gives_a_reflection() -> None:
    source = np.random.default_rng(1).normal(size=(20, 3))
    T = fit_rigid(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_weights_silence_an_outlier() -> None:
    source = np.random.default_rng(2).uniform(-50, 50, (10, 3))
    target = source + [1.0, 2.0, 3.0]
    target[0] += 100.0
    weight = np.ones(10)
    weight[0] = 0.0
    assert np.allclose(fit_rigid(source, target, weight), transforms.translation((1.0, 2.0, 3.0)), atol=1e-9)


def outlier_heavy(seed: int, good: int, bad: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    source = rng.uniform(-150, 150, (good + bad, 3)) * [1, 1, 0.05]
    T = transforms.compose(transforms.yaw_matrix(2.1), np.array([40.0, -30.0, 5.0]))
    target = transforms.apply(T, source)
    target[:good] += rng.normal(0, 0.2, (good, 3))
    target[good:] = rng.uniform(-150, 150, (bad, 3))
    return source, target, T


def test_ransac_survives_outliers_that_one_svd_does_not() -> None:
    source, target, T = outlier_heavy(3, 20, 80)
    robust, inlier = ransac_upright(source, target, 1.0, seed=0)
    assert inlier[:20].sum() >= 18
    assert np.degrees(transforms.rotation_angle(robust[:3, :3] @ T[:3, :3].T)) < 0.3
    plain = iterative_svd(source, target)
    assert np.degrees(transforms.rotation_angle(plain.T[:3, :3] @ T[:3, :3].T)) > 5.0


def tied(source: np.ndarray, target: np.ndarray, held_out: np.ndarray | None = None) -> TiePoints:
    """Tie points of equal score, none held out unless said."""
    n = len(source)
    out = np.zeros(n, bool) if held_out is None else held_out
    return TiePoints(source, target, np.ones(n), np.where(out, 0, 1), out, np.ones(n, bool))


def test_solve_keeps_withheld_ties_out_and_finds_the_transform() -> None:
    source, target, T = outlier_heavy(4, 60, 40)
    held_out = np.arange(100) % 4 == 0
    lies = target.copy()
    lies[held_out] += 500.0
    a, _ = solve_tie_points(tied(source, target, held_out), 1.0)
    b, inlier = solve_tie_points(tied(source, lies, held_out), 1.0)
    assert np.array_equal(a.T, b.T)
    assert not inlier[held_out].any()
    assert np.linalg.norm(a.T[:3, 3] - T[:3, 3]) < 0.5


@pytest.mark.parametrize("seed", range(3))
def test_few_agreeing_ties_do_not_take_in_the_rest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.uniform(-150, 150, (200, 3)) * [1, 1, 0.02]
    # no rigid transform fits a shrunk scene but near one place; a threshold that grows with what it lets in
    # ends at 40 m and calls all of it agreement
    target = source * [0.9, 0.9, 1.0] + rng.normal(0, 3, (200, 3))
    solution, agreeing = solve_tie_points(tied(source, target), 3.0)
    assert solution.threshold <= 6.0
    assert agreeing.sum() < 50


def test_ties_that_do_not_agree_are_refused() -> None:
    rng = np.random.default_rng(5)
    with pytest.raises(RegistrationError, match="at least 3"):
        solve_tie_points(tied(np.zeros((2, 3)), np.zeros((2, 3))), 1.0)
    source, target = rng.uniform(-1e3, 1e3, (5, 3)), rng.uniform(-1e3, 1e3, (5, 3))
    with pytest.raises(RegistrationError, match="agree"):
        solve_tie_points(tied(source, target), 0.5)


def test_folds_are_whole_blocks_and_move_with_the_scene() -> None:
    xy = np.random.default_rng(6).uniform(0, 400, (500, 2))
    fold = folds_of(xy, 4, 40.0, seed=1)
    assert set(fold) == {0, 1, 2, 3}
    block = np.floor((xy - np.floor(xy.min(axis=0))) / 40.0)
    for key in np.unique(block, axis=0):
        assert len(set(fold[(block == key).all(axis=1)])) == 1
    assert np.array_equal(fold, folds_of(xy + 5_000_000.0, 4, 40.0, seed=1))


def test_lifting_takes_pixel_centres_and_float_heights() -> None:
    top = np.array([[1.25, 2.5], [np.nan, 4.125]], np.float32)
    bev = Bev(Grid(100.0, 200.0, 2.0, 2, 2), top, top - 1, (~np.isnan(top)).astype(np.uint32))
    px = np.array([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    tie_points = tie_points_of(Matches(px, px, np.ones(3)), bev, bev, surface="top")
    assert tie_points.source.tolist() == [[101.0, 199.0, 1.25], [103.0, 197.0, 4.125]]
    ground = tie_points_of(Matches(px, px, np.ones(3)), bev, bev, surface="ground")
    assert ground.source[:, 2].tolist() == [0.25, 0.25, 0.25]
