"""The uncertainty of a pose against the scatter of poses, and the evidence that no fit used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.equations import BlockEquations
from mtpcr_geo.core.uncertainty import NORMAL_95, PLANE_95, Uncertainty, circle_95
from mtpcr_geo.method.jackknife import (
    block_count,
    blocks_of,
    correction_of,
    equations_of,
    information_bound,
    jackknife,
    moved_by,
    not_below,
    solved,
)
from mtpcr_geo.method.overlap import overlap_of
from mtpcr_geo.verdict.drift import drift_of
from mtpcr_geo.verdict.free_space import free_space_of
from mtpcr_geo.verdict.further import effective_number
from mtpcr_geo.verdict.null import null_probability
from mtpcr_geo.verdict.sliding import direction_text, sliding_of
from mtpcr_geo.verdict.uncertainty import giving_way

NOISE = 0.1


def scene(rng: np.random.Generator, count: int = 4000, size: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    """Places, and the information of planes of all directions, as walls, roofs and ground have."""
    places = (rng.random((count, 3)) - 0.5) * [size, size / 2, 6.0]
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return places, normal[:, :, None] * normal[:, None, :] / NOISE**2


def fitted(gap: np.ndarray, places: np.ndarray, weight: np.ndarray) -> BlockEquations:
    return equations_of(np.eye(4), np.zeros(3), places, gap, weight, "surfaces")


def uncertainty(covariance: np.ndarray, far: tuple[float, float, float] = (50.0, 0.0, 0.0)) -> Uncertainty:
    return Uncertainty(covariance, np.zeros(3), np.eye(3), np.array(far), 16, 1000, "surfaces")


@pytest.mark.parametrize("common", [0.0, 0.05])
def test_the_jackknife_gives_the_scatter_of_the_solutions(common: float) -> None:
    """Errors common to a patch of 10 m, as those of a wall or a crown, count as what they are."""
    rng = np.random.default_rng(1)
    places, weight = scene(rng)
    patch = np.unique(np.floor(places[:, :2] / 10.0), axis=0, return_inverse=True)[1].ravel()
    found, told, bound = [], [], []
    for _ in range(60):
        gap = rng.normal(0.0, NOISE, places.shape) + rng.normal(0.0, common, (patch.max() + 1, 3))[patch]
        equations = fitted(gap, places, weight)
        found.append(solved(equations.H.sum(axis=0), equations.b.sum(axis=0)))
        told.append(np.diag(jackknife(equations)))
        bound.append(np.diag(information_bound(equations)))
    ratio = np.sqrt(np.mean(told, axis=0)) / np.std(found, axis=0)
    assert (ratio > 0.7).all()
    assert (ratio < 1.6).all()
    if common:
        assert (np.sqrt(np.mean(bound, axis=0))[3:] < 0.6 * np.std(found, axis=0)[3:]).all()


def test_a_bound_raises_only_what_lies_below_it() -> None:
    raised = not_below(np.diag([4.0, 0.1]), np.diag([1.0, 1.0]))
    assert np.allclose(raised, np.diag([4.0, 1.0]))
    turned = transforms.yaw_matrix(0.5)[:2, :2]
    again = not_below(turned @ np.diag([4.0, 0.1]) @ turned.T, np.eye(2))
    assert np.allclose(again, turned @ np.diag([4.0, 1.0]) @ turned.T)


def test_the_inverse_fit_has_the_same_uncertainty_where_it_lies() -> None:
    rng = np.random.default_rng(2)
    places, weight = scene(rng)
    T = transforms.translation((5.0, -3.0, 1.0)) @ transforms.about(
        np.array([1.0, 2.0, 0.0]), transforms.axis_angle_matrix(np.array([0.36, 0.48, 0.8]), 2.0)
    )
    equations = replace(fitted(rng.normal(0.0, NOISE, places.shape), places, weight), T=T)
    back = equations.inverse()
    assert np.allclose(back.T @ T, np.eye(4))
    x = solved(equations.H.sum(axis=0), equations.b.sum(axis=0))
    y = solved(back.H.sum(axis=0), back.b.sum(axis=0))
    # both corrected transforms are inverse to each other
    there, home = moved_by(x, equations.pivot) @ T, moved_by(y, back.pivot) @ back.T
    assert np.allclose(there @ home, np.eye(4), atol=1e-5)
    assert np.allclose(np.linalg.eigvalsh(jackknife(back)), np.linalg.eigvalsh(jackknife(equations)))
    assert back.inverse() == back.inverse()


def test_corrections_come_back() -> None:
    x, pivot = np.array([0.01, -0.02, 0.03, 0.4, 0.5, -0.6]), np.array([100.0, 50.0, 3.0])
    assert np.allclose(correction_of(moved_by(x, pivot), pivot), x, atol=1e-12)
    assert np.array_equal(correction_of(moved_by(np.zeros(6), pivot), pivot), np.zeros(6))


def test_blocks_follow_the_overlap_and_its_correspondences() -> None:
    rng = np.random.default_rng(0)
    xy = rng.random((1000, 2)) * [100.0, 10.0]
    number = blocks_of(xy, 8)
    assert np.bincount(number).tolist() == [125] * 8
    assert all(np.ptp(xy[number == one, 0]) < 16.0 for one in range(8))
    assert (block_count(10), block_count(700), block_count(100_000)) == (8, 16, 16)


def test_error_grows_with_the_distance_from_the_pivot() -> None:
    told = uncertainty(np.diag([0.0, 0.0, np.radians(0.1) ** 2, 0.03**2, 0.01**2, 0.02**2]))
    plan, height = told.sigmas(np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]]))
    assert plan[0] == pytest.approx(0.03)
    assert plan[1] == pytest.approx(np.hypot(0.01, np.radians(0.1) * 200.0))
    assert height == pytest.approx([0.02, 0.02])
    assert told.weakest_deg == pytest.approx(90.0)
    assert told.metrics["sigma_yaw_deg"] == pytest.approx(0.1)


def test_the_circle_of_95_percent() -> None:
    rng = np.random.default_rng(0)
    for sigmas in ([1.0, 1.0], [1.0, 0.4], [1.0, 0.0]):
        C = np.diag(np.square(sigmas))
        drawn = rng.normal(size=(200_000, 2)) * sigmas
        radius = circle_95(C[None])[0]
        assert (np.linalg.norm(drawn, axis=1) < radius).mean() == pytest.approx(0.95, abs=0.003)
    assert circle_95(np.eye(2)[None])[0] == pytest.approx(PLANE_95, rel=0.01)
    assert circle_95(np.diag([1.0, 0.0])[None])[0] == pytest.approx(NORMAL_95, rel=0.01)


def test_a_street_lets_the_fit_slide_along_it() -> None:
    rng = np.random.default_rng(3)
    places, _ = scene(rng)
    normal = np.where(rng.random(len(places))[:, None] < 0.5, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    normal = normal + rng.normal(0.0, 0.02, normal.shape)
    gap = rng.normal(0.0, NOISE, places.shape)
    equations = fitted(gap, places, normal[:, :, None] * normal[:, None, :] / NOISE**2)
    told = uncertainty(not_below(jackknife(equations), information_bound(equations)))
    sliding = sliding_of(told, equations)
    assert sliding.ratio > 10.0
    assert sliding.turning < 0.2
    assert min(sliding.direction_deg, 180.0 - sliding.direction_deg) < 10.0
    assert direction_text(40.2, True) == "N 40° E"
    assert direction_text(140.0, True) == "N 40° W"
    assert direction_text(179.9, True) == "north to south"
    assert direction_text(40.0, False) == "50° from x"


def test_a_bent_map_is_told_from_a_rigid_one() -> None:
    rng = np.random.default_rng(4)
    places, weight = scene(rng, 8000, 200.0)
    noise = rng.normal(0.0, NOISE, places.shape)
    bend = np.zeros_like(noise)
    bend[:, 1] = 0.3 * (places[:, 0] / 100.0) ** 2
    tilted = 0.002 * places[:, :1] * [0.0, 0.0, 1.0]
    bent = drift_of(fitted(noise + bend, places, weight), np.eye(3))
    straight = drift_of(fitted(noise + tilted, places, weight), np.eye(3))
    assert bent is not None
    assert straight is not None
    assert bent.told
    assert not straight.told
    # between the middles of the outermost blocks
    assert bent.plan_m == pytest.approx(0.3 * (bent.length_m / 200.0) ** 2, rel=0.1)
    assert bent.length_m == pytest.approx(200.0, rel=0.2)


def test_quarters_that_move_more_with_new_correspondences_widen_it() -> None:
    rng = np.random.default_rng(5)
    places, weight = scene(rng)
    equations = fitted(rng.normal(0.0, NOISE, places.shape), places, weight)
    assert giving_way(equations) == pytest.approx(1.0)
    assert giving_way(replace(equations, quarters=2.0 * equations.quarters)) == pytest.approx(2.0, rel=0.01)


def test_overlapping_patches_count_once() -> None:
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    assert effective_number(grid, np.ones(100, bool)) == (25, 25)
    assert effective_number(grid, grid[:, 0] < 5.0)[1] == 15
    assert effective_number(grid[:1], np.ones(1, bool)) == (1, 1)


def test_a_roof_over_bare_ground_is_a_conflict() -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 80.0, 0.5), np.arange(0.0, 80.0, 0.5)))
    house = (np.abs(x - 40.0) < 12.0) & (np.abs(y - 40.0) < 12.0)
    town = np.column_stack([x, y, np.where(house, 6.0, 0.0)])
    same = free_space_of(overlap_of(town, town))
    assert same.share == 0.0
    apart = free_space_of(overlap_of(town + [30.0, 0.0, 0.0], town))
    assert apart.share is not None
    assert apart.share > 0.8
    flat = free_space_of(overlap_of(town * [1.0, 1.0, 0.0], town * [1.0, 1.0, 0.0]))
    assert flat.share is None


def test_the_null_is_uniform_where_the_tails_are_alike() -> None:
    rng = np.random.default_rng(6)
    found = np.array([null_probability(*_searched(rng)) for _ in range(2000)], np.float64)
    for p in (0.5, 0.1, 0.05, 0.02):
        assert (found < p).mean() <= 1.5 * p
    assert np.mean(found) == pytest.approx(0.5, abs=0.03)
    clear = null_probability(100.0, [1.0, 0.9, 0.8, 0.7, 0.68, 0.66, 0.65, 0.64, 0.63, 0.62, 0.61])
    assert clear is not None
    assert clear < 1e-3
    assert null_probability(1.0, [1.0, 0.9]) is None
    assert null_probability(None, [1.0] * 9) is None
    assert null_probability(0.0, [1.0] * 9) == 1.0


def _searched(rng: np.random.Generator) -> tuple[float, list[float]]:
    """The best of 90 wrong poses, and the strongest of 90 others."""
    return float(np.exp(0.4 * rng.exponential(size=90)).max()), list(np.exp(0.4 * rng.exponential(size=90)))


def test_trees_of_another_place_are_missing_and_those_of_one_are_not() -> None:
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(0, 120, (60_000, 2)), np.zeros(60_000)])

    def wood(places: np.ndarray) -> np.ndarray:
        crowns = (places[:, None, :] + rng.uniform(-3, 3, (len(places), 150, 2))).reshape(-1, 2)
        return np.vstack([ground, np.column_stack([crowns, rng.uniform(4, 8, len(crowns))])])

    places = rng.uniform(5, 115, (30, 2))
    here, there = wood(places), wood(rng.uniform(5, 115, (30, 2)))
    same = free_space_of(overlap_of(wood(places), here)).missing
    other = free_space_of(overlap_of(there, here)).missing
    assert same is not None
    assert other is not None
    assert same < 0.02
    assert other > 0.3
    # a scanner on the ground that sees no crowns contradicts nothing that the other sees above it
    below = free_space_of(overlap_of(np.vstack([ground, here[60_000:62_000]]), here)).missing
    assert below is not None
    assert below < 0.02
    assert free_space_of(overlap_of(ground, ground)).missing is None
