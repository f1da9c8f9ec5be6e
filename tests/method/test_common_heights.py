"""The height that all points of both clouds tell, whatever their lowest ones say."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_scene import houses
from scipy.spatial import cKDTree

import mtpcr_geo as mg
from mtpcr_geo.benchmark.robustness.degrade import multipath
from mtpcr_geo.core import transforms
from mtpcr_geo.method.common_heights import common_heights
from mtpcr_geo.pipeline.stages.refining import CLEARLY

RNG = np.random.default_rng


def grove(seed: int, n: int = 60_000, size: float = 30.0) -> np.ndarray:
    """Sampled trees of 6 to 14 m on gently rolling ground, dense enough to hide it below mirror images."""
    trees = RNG(5).uniform(0.0, size, (25, 2))
    tall = RNG(6).uniform(6.0, 14.0, 25)
    rng = RNG(seed)
    xy = rng.uniform(0.0, size, (n // 2, 2))
    which = rng.integers(0, 25, n // 2)
    crown = trees[which] + rng.normal(0.0, 0.9, (n // 2, 2))
    up = tall[which] * rng.uniform(0.35, 1.0, n // 2)
    ground = [0.4 * np.sin(p[:, 0] / 5.0) + 0.3 * np.cos(p[:, 1] / 7.0) for p in (xy, crown)]
    points = np.vstack([np.column_stack([xy, ground[0]]), np.column_stack([crown, ground[1] + up])])
    return points + rng.normal(0.0, 0.02, points.shape)


@pytest.mark.parametrize("off", [0.0, 4.0, -7.5])
def test_the_height_at_which_the_clouds_meet_is_told(off: float) -> None:
    found = common_heights(grove(1) + [0, 0, off], grove(2), 0.5, 0.5)
    assert found is not None
    times, rise = found.elsewhere
    if off == 0.0:
        assert times < 0.8
    else:
        assert times > 1.4
        assert rise == pytest.approx(-off, abs=0.5)


def test_exchanged_clouds_are_raised_the_other_way() -> None:
    source, target = grove(1) + [0, 0, 3], grove(2)
    forth, back = common_heights(source, target, 0.5, 0.5), common_heights(target, source, 0.5, 0.5)
    assert forth is not None
    assert back is not None
    assert back.columns == forth.columns
    assert back.elsewhere == pytest.approx((forth.elsewhere[0], -forth.elsewhere[1]), rel=1e-5)


def test_points_below_the_ground_do_not_change_the_height() -> None:
    source = multipath(grove(1), RNG(3))
    assert len(source) > 60_000
    found = common_heights(source, grove(2), 0.5, 0.5)
    assert found is not None
    assert found.asked
    assert found.elsewhere[0] < 0.8


def test_a_wide_area_is_looked_at_in_wider_columns() -> None:
    apart = np.array([[0.0, 0.0, 0.0], [40_000.0, 40_000.0, 0.0]])
    source, target = (np.vstack([grove(seed) + end for end in apart]) for seed in (1, 2))
    found = common_heights(source + [0, 0, 4], target, 0.5, 0.5)
    # columns of 128 m: too few of them are filled
    assert found is None
    near = common_heights(source[:60_000] + [0, 0, 4], target, 0.5, 0.5)
    assert near is not None
    assert near.elsewhere[1] == pytest.approx(-4.0, abs=0.5)


def test_floors_and_ceilings_are_not_taken_for_another_height() -> None:
    """A hall seen from inside, with a strip outside, against its flat roof two storeys higher."""
    rng = RNG(4)

    def flat(n: int, low: tuple[float, float], high: tuple[float, float], z: float) -> np.ndarray:
        xy = rng.uniform(low, high, (n, 2))
        return np.column_stack([xy, np.full(n, z)]) + rng.normal(0.0, 0.01, (n, 3))

    inside = [flat(20_000, (0, 0), (40, 30), z) for z in (0.0, 4.0)]
    source = np.vstack([*inside, flat(6_000, (0, 30), (40, 40), -0.2)])
    target = np.vstack([flat(8_000, (0, 0), (40, 30), 9.0), flat(12_000, (0, 30), (40, 60), -0.2)])
    found = common_heights(source, target, 1.0, 0.5)
    assert found is not None
    assert found.elsewhere[0] > 1.0
    assert not found.asked


def test_a_stray_point_kilometres_above_costs_no_memory() -> None:
    source = np.vstack([grove(1), [[15.0, 15.0, 9_000.0]]])
    found = common_heights(source, grove(2), 0.5, 0.5)
    assert found is not None
    assert found.elsewhere[0] < 0.8


@pytest.mark.parametrize("away", [[500.0, 0.0, 0.0], [29.9, 0.0, 0.0]])
def test_clouds_that_share_too_little_tell_nothing(away: list[float]) -> None:
    assert common_heights(houses(RNG(1), 500) + away, houses(RNG(2), 500) - away, 1.0, 0.5) is None


def test_a_plot_whose_ground_lies_below_mirror_images_is_registered() -> None:
    T = transforms.translation((30.0, -12.0, 5.0)) @ transforms.about(
        np.zeros(3), transforms.yaw_matrix(np.radians(100.0))
    )
    source = transforms.apply(transforms.inverse(T), multipath(grove(1), RNG(3)))
    found = mg.register(source, grove(2), level="none", recording=False)
    assert found.T_target_source is not None
    left = found.T_target_source @ transforms.inverse(T)
    middle = np.array([[15.0, 15.0, 4.0]])
    assert np.linalg.norm(transforms.apply(left, middle) - middle) < 0.1
    assert np.degrees(transforms.rotation_angle(left[:3, :3])) < 0.3
    metrics = found.verdict.metrics
    assert metrics["heights_elsewhere"] < 0.9
    refined = next(stage for stage in found.report if stage.type == "mtpcr.refine")
    assert refined.metadata["raised"] is True


def forest(seed: int, *, from_below: bool) -> np.ndarray:
    """A closed forest with clearings: crowns alone from the air, undergrowth and stems from below."""
    size, clearings = 90.0, np.array([[20.0, 25, 9], [65, 60, 11], [30, 70, 7], [70, 20, 8]])
    trees = RNG(5).uniform(0.0, size, (450, 2))
    apart = np.hypot(*(trees[:, None] - clearings[:, :2]).transpose(2, 0, 1))
    trees = trees[(apart > clearings[:, 2]).all(axis=1)]
    tall, wide = RNG(6).uniform(13.0, 19.0, len(trees)), RNG(7).uniform(1.8, 3.2, len(trees))
    rng = RNG(seed)
    if from_below:
        bare = np.column_stack([rng.uniform(15.0, 75.0, (60_000, 2)), np.zeros(60_000)])
        which, turn = rng.integers(0, len(trees), 180_000), rng.uniform(0.0, 2.0 * np.pi, 180_000)
        stem = np.arange(180_000) % 3 == 0
        away = np.where(stem, 0.2, wide[which] * np.sqrt(rng.random(180_000)))
        up = np.where(stem, rng.uniform(0.0, 8.0, 180_000), rng.uniform(2.0, 8.0, 180_000))
        grown = np.column_stack(
            [trees[which] + away[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]), up]
        )
        points = np.vstack([bare, grown])
        points = points[((points[:, :2] > 15.0) & (points[:, :2] < 75.0)).all(axis=1)]
    else:
        xy = rng.uniform(0.0, size, (400_000, 2))
        off, which = cKDTree(trees).query(xy)
        share = off / wide[which]
        crown = tall[which] - 5.0 * (1.0 - np.sqrt(np.clip(1.0 - share**2, 0.0, 1.0)))
        seen = (share < 1.0) & (rng.random(len(xy)) > 0.003)
        points = np.column_stack([xy, np.where(seen, crown - rng.exponential(0.7, len(xy)), 0.0)])
    points[:, 2] += 0.8 * np.sin(points[:, 0] / 9.0) + 0.6 * np.cos(points[:, 1] / 11.0)
    return points + rng.normal(0.0, 0.02, points.shape)


def test_undergrowth_is_not_raised_into_the_crowns() -> None:
    T = transforms.translation((30.0, -12.0, 5.0)) @ transforms.about(
        np.zeros(3), transforms.yaw_matrix(np.radians(25.0))
    )
    source, target = forest(1, from_below=True), forest(2, from_below=False)
    found = common_heights(source, target, 0.5, 0.5)
    assert found is not None
    assert found.asked
    assert found.elsewhere[0] > CLEARLY
    result = mg.register(
        transforms.apply(transforms.inverse(T), source), target, level="none", recording=False
    )
    assert result.T_target_source is not None
    left = result.T_target_source @ transforms.inverse(T)
    middle = np.array([[45.0, 45.0, 4.0]])
    assert np.linalg.norm(transforms.apply(left, middle) - middle) < 0.3
