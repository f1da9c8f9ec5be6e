from __future__ import annotations

import numpy as np
import pytest
from helpers_plots import plot
from scipy.spatial import cKDTree

from mtpcr_geo.core import transforms
from mtpcr_geo.method import downsample
from mtpcr_geo.method.downsample import Thinned, near, own_axes, thinned

TURNED = transforms.compose(
    transforms.tilt_matrix(2.0, 0.4) @ transforms.yaw_matrix(1.9), np.array([300.0, -80.0, 12.0])
)


def everything(xyz: np.ndarray) -> np.ndarray:
    return np.ones(len(xyz), bool)


def test_the_axes_of_a_cloud_go_along_with_it() -> None:
    xyz = plot(np.random.default_rng(22), density=20.0)
    here, there = own_axes(xyz), own_axes(transforms.apply(TURNED, xyz))
    np.testing.assert_allclose(there @ TURNED, here, atol=1e-6)
    placed = transforms.apply(here, xyz)
    np.testing.assert_allclose(placed.mean(axis=0), 0.0, atol=1e-9)
    assert list(np.argsort(-placed.std(axis=0))) == [0, 1, 2]


@pytest.mark.parametrize(
    "xyz",
    [
        np.array([[4.0, 5.0, 6.0]]),
        np.repeat([[4.0, 5.0, 6.0]], 50, axis=0),
        np.linspace(0, 9, 40)[:, None] * [1.0, 2.0, -1.0],
        np.array([[x, y, 0.0] for x in range(9) for y in range(9)], float),
    ],
    ids=["one point", "one place", "a line", "a grid"],
)
def test_axes_are_a_rotation_whatever_the_points(xyz: np.ndarray) -> None:
    R = own_axes(xyz)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert len(thinned(xyz, everything(xyz), 0.5).points) >= 1


@pytest.mark.parametrize("density", [3.0, 300.0])
def test_thinning_takes_the_same_points_however_the_cloud_is_turned(density: float) -> None:
    xyz = plot(np.random.default_rng(23), density=density)
    here = thinned(xyz, everything(xyz), 0.5).reduced(2000, 4000)
    there = thinned(transforms.apply(TURNED, xyz), everything(xyz), 0.5).reduced(2000, 4000)
    distance, _ = cKDTree(transforms.apply(TURNED, here.points)).query(there.points)
    assert abs(len(here.points) - len(there.points)) <= 2
    assert np.percentile(distance, 99.5) < 1e-6


def test_what_lies_apart_changes_nothing_where_it_does_not() -> None:
    xyz = plot(np.random.default_rng(24), density=300.0)
    west, mid = xyz[:, 0] < -4.0, xyz[:, 0] < -3.0
    few, more = thinned(xyz, west, 0.25), thinned(xyz, mid, 0.25)
    distance, nearest = cKDTree(more.points).query(few.points[few.points[:, 0] < -4.0])
    assert distance.max() < 1e-9
    np.testing.assert_array_equal(few.lots[few.points[:, 0] < -4.0], more.lots[nearest])


@pytest.mark.parametrize("across", [89, 144, 233, 610, 987])
def test_a_share_of_points_in_rows_leaves_no_row_out(across: int) -> None:
    number = np.arange(200 * across)[:, None]
    lots = downsample._hash(number).astype(float) * 2.0**-64
    for share in (0.1, 0.25, 0.5):
        kept = (lots < share).reshape(200, across)
        for rows in (kept, kept.T):
            wanted, sigma = share * rows.shape[1], np.sqrt(share * (1 - share) * rows.shape[1])
            assert abs(rows.sum(axis=1) - wanted).max() < 5 * sigma


def places(cloud: Thinned) -> set[tuple[float, ...]]:
    return set(map(tuple, np.round(cloud.points, 6).tolist()))


@pytest.mark.parametrize("density", [3.0, 300.0])
def test_the_order_of_the_points_does_not_matter(density: float) -> None:
    rng = np.random.default_rng(26)
    xyz = plot(rng, density=density)
    here = thinned(xyz, everything(xyz), 0.5)
    there = thinned(rng.permutation(xyz), everything(xyz), 0.5)
    wanted = len(here.points) // 4, len(here.points)
    kept = places(here.reduced(*wanted))
    assert 0.15 * len(here.points) < len(kept) < 0.3 * len(here.points)
    # a coordinate on the edge of a cell of the lattice may round to either side
    assert len(kept ^ places(there.reduced(*wanted))) <= 2


def test_one_point_less_changes_few_of_those_kept() -> None:
    # as many points as are thinned in earnest; of square plots the axes themselves hang on single points
    rng = np.random.default_rng(27)
    xyz = rng.uniform(0.0, 1.0, (60_000, 3)) * [200.0, 80.0, 0.3]
    xyz[:, 2] += np.sin(xyz[:, 0] / 9.0) + 2.0 * np.cos(xyz[:, 1] / 7.0)
    kept = places(thinned(xyz, everything(xyz), 0.5).reduced(2000, 8000))
    assert len(kept) > 10_000
    outermost = int(np.argmax(xyz[:, 0] + xyz[:, 1]))
    for lost in (0, len(xyz) // 2, outermost):
        less = np.delete(xyz, lost, axis=0)
        again = places(thinned(less, everything(less), 0.5).reduced(2000, 8000))
        assert len(kept & again) >= 0.9 * len(kept)


@pytest.mark.parametrize("spacing", [0.25, 0.4, 0.5])
def test_a_gridded_cloud_is_thinned_evenly(spacing: float) -> None:
    rows, columns = 200, 144
    j, i = np.mgrid[0:rows, 0:columns]
    xyz = np.column_stack([spacing * i.ravel(), spacing * j.ravel(), 0.02 * (i + j).ravel()])
    voxel = 1.2 * spacing
    cloud = thinned(xyz, everything(xyz), voxel)
    assert len(cloud.points) == len(xyz)
    kept = (cloud.lots < 0.25).reshape(rows, columns)
    for lines in (kept, kept.T):
        sigma = np.sqrt(0.25 * 0.75 * lines.shape[1])
        assert abs(lines.sum(axis=1) - 0.25 * lines.shape[1]).max() < 5 * sigma


def test_reducing_keeps_about_what_is_wanted_and_moves_by_steps() -> None:
    lots = np.random.default_rng(25).random(40_000)
    cloud = Thinned(np.column_stack([lots, lots, lots]), lots)
    assert cloud.reduced(40_000, 40_000) is cloud
    kept = cloud.reduced(10_000, 40_000)
    assert abs(len(kept.points) - 10_000) < 500
    assert kept.lots.max() < 1.0
    for of in (40_100, 41_000, 43_000):
        np.testing.assert_array_equal(cloud.reduced(10_000, of).points, cloud.reduced(10_000, 40_001).points)


@pytest.mark.parametrize("seed", range(3))
def test_near_misses_no_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, others = rng.uniform(0, 60, (4000, 3)) * [1, 1, 0.1], rng.uniform(30, 90, (3000, 3)) * [1, 1, 0.1]
    distance, _ = cKDTree(others).query(points)
    found = near(points, others, 2.0)
    assert found[distance <= 2.0].all()
    assert not found[distance > 2.0 * 2.0 * np.sqrt(3.0)].any()
    assert not near(points, others + 500.0, 2.0).any()


def test_near_is_bounded_however_far_a_point_lies() -> None:
    rng = np.random.default_rng(9)
    points, others = rng.uniform(0, 40, (2000, 3)), rng.uniform(0, 40, (2000, 3))
    far = np.vstack([others, [[1e7, -1e7, 3e6]]])
    np.testing.assert_array_equal(near(points, far, 3.0), near(points, others, 3.0))
    wide = np.vstack([points, points + [140_000.0, 0.0, 0.0]])
    assert near(wide, far, 3.0)[:2000].sum() == near(points, others, 3.0).sum()
    assert not near(wide, far, 3.0)[2000:].any()
    both = np.vstack([others, others + [140_000.0, 90_000.0, 0.0]])
    assert near(np.vstack([points, points + [140_000.0, 90_000.0, 0.0]]), both, 3.0).all()
