from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.transforms import rotation_to_up
from mtpcr_geo.method.levelling import level


def street(rng: np.random.Generator, slope: float = 0.0) -> np.ndarray:
    """Ground on a slope and walls that are plumb, as a scanner in the street sees them."""
    xy = rng.uniform(-60, 60, (40_000, 2))
    ground = np.column_stack([xy, slope * xy[:, 0] + rng.normal(0, 0.02, len(xy))])
    walls = []
    for x, y, along_x in ((-20, 0, True), (25, 10, False), (0, -30, True), (-40, 20, False)):
        s, h = rng.uniform(-12, 12, 6000), rng.uniform(0, 8, 6000)
        wall = np.column_stack([x + s * along_x, y + s * (not along_x), h])
        wall[:, 2] += slope * wall[:, 0]
        wall[:, 1 if along_x else 0] += rng.normal(0, 0.02, 6000)
        walls.append(wall)
    return np.vstack([ground, *walls])


def lean_deg(T: np.ndarray, R: np.ndarray) -> float:
    """Angle between true up, turned by R, and what levelling takes to +z."""
    up = T[:3, :3] @ R @ np.array([0.0, 0.0, 1.0])
    return float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))


@pytest.mark.parametrize("tilt", [0.0, 4.0, 10.0, 15.0])
@pytest.mark.parametrize("mode", ["auto", "ransac"])
def test_tilts_up_to_fifteen_degrees_are_recovered(tilt: float, mode: str) -> None:
    rng = np.random.default_rng(5)
    R = transforms.tilt_matrix(1.1, np.radians(tilt)) @ transforms.yaw_matrix(0.7)
    found = level(street(rng) @ R.T, mode, georeferenced=False)  # type: ignore[arg-type]
    assert lean_deg(found.T_level_work, R) < 0.2


def test_on_a_slope_walls_overrule_the_ground_plane() -> None:
    xyz = street(np.random.default_rng(6), slope=0.2)
    R = transforms.tilt_matrix(2.0, np.radians(5.0))
    auto = level(xyz @ R.T, "auto", georeferenced=False)
    plane = level(xyz @ R.T, "ransac", georeferenced=False)
    assert auto.method == "verticals"
    assert lean_deg(auto.T_level_work, R) < 0.3
    assert lean_deg(plane.T_level_work, R) > 8.0


def test_a_georeferenced_cloud_keeps_its_vertical() -> None:
    xyz = street(np.random.default_rng(7), slope=0.2)
    assert np.array_equal(level(xyz, "auto", georeferenced=True).T_level_work, np.eye(4))
    assert np.array_equal(level(xyz, "none", georeferenced=False).T_level_work, np.eye(4))


def test_open_ground_without_walls_is_levelled_by_its_plane() -> None:
    rng = np.random.default_rng(8)
    xy = rng.uniform(-50, 50, (30_000, 2))
    R = transforms.tilt_matrix(0.3, np.radians(7.0))
    xyz = np.column_stack([xy, rng.normal(0, 0.05, len(xy))]) @ R.T
    found = level(xyz, "auto", georeferenced=False)
    assert found.method == "plane"
    assert lean_deg(found.T_level_work, R) < 0.2


def test_rolling_ground_without_walls_is_kept_as_it_is() -> None:
    rng = np.random.default_rng(8)
    xy = rng.uniform(-200, 200, (60_000, 2))
    hills = 8.0 * np.sin(xy[:, 0] / 45.0) * np.cos(xy[:, 1] / 60.0) + 0.01 * xy[:, 0]
    found = level(np.column_stack([xy, hills]), "auto", georeferenced=False)
    assert found.method == "none"
    assert np.array_equal(found.T_level_work, np.eye(4))
    assert found.plane_inlier_share is not None
    assert found.plane_inlier_share < 0.2


def test_levelling_is_the_same_at_each_run() -> None:
    xyz = street(np.random.default_rng(9))
    a, b = (level(xyz, "auto", georeferenced=False, seed=3).T_level_work for _ in range(2))
    assert np.array_equal(a, b)


def test_rotation_to_up_takes_up_to_z() -> None:
    up = np.array([0.1, -0.2, 0.97])
    up /= np.linalg.norm(up)
    assert np.allclose(rotation_to_up(up) @ up, [0, 0, 1])
    assert np.array_equal(rotation_to_up(np.array([0.0, 0.0, 1.0])), np.eye(3))
