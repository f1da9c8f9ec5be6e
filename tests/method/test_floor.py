from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.transforms import angle_deg, rotation_to_up
from mtpcr_geo.method import floor
from mtpcr_geo.method.floor import _lowest, extent_of, floors_of
from mtpcr_geo.method.levelling import SAME_VERTICAL_DEG, evidence_of, level, verticals

UP = np.array([0.0, 0.0, 1.0])
TURNS = {
    "upright": np.eye(3),
    "35 degrees": transforms.tilt_matrix(0.4, np.radians(35.0)),
    "y up": transforms.axis_angle_matrix(np.array([1.0, 0.0, 0.0]), -np.pi / 2),
    "x up": transforms.axis_angle_matrix(np.array([0.0, 1.0, 0.0]), np.pi / 2),
    "upside down": np.diag([1.0, -1.0, -1.0]),
}


def garden(rng: np.random.Generator, half: float = 30.0, slope: float = 0.0) -> np.ndarray:
    """Rough ground with trees and a house: nothing beneath the ground, much above it."""
    xy = rng.uniform(-half, half, (20_000, 2))
    ground = np.column_stack([xy, slope * xy[:, 0] + rng.normal(0, 0.05, len(xy))])
    trees = rng.normal(0, 1, (12_000, 3)) * [1.5, 1.5, 2.0]
    trees += np.column_stack([rng.uniform(-half, half, (40, 2)), np.full(40, 7.0)])[
        rng.integers(0, 40, 12_000)
    ]
    house = rng.uniform([-8, -5, 0], [8, 5, 6], (6_000, 3))
    house[:, 2] = 6.0 + 0.3 * (5 - np.abs(house[:, 1]))
    trees[:, 2] += slope * trees[:, 0]
    house[:, 2] += slope * house[:, 0]
    return np.vstack([ground, trees, house])


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("half", [8.0, 30.0, 400.0])
def test_the_floor_is_found_however_the_cloud_is_turned(turn: str, half: float) -> None:
    rng = np.random.default_rng(1)
    R = TURNS[turn] @ transforms.yaw_matrix(0.7)
    xyz = garden(rng, half) @ R.T
    best = floors_of(xyz, extent_of(xyz), rng)[0]
    assert angle_deg(best.up, R @ UP) < 0.7
    assert best.share > 0.6


def tall_stand(rng: np.random.Generator) -> np.ndarray:
    """A plot scanned among trees higher than it is wide: one point in fifty lies on the ground."""
    crowns = rng.normal(0, 1, (200_000, 3))
    crowns *= np.cbrt(rng.random(len(crowns)) / (crowns**2).sum(axis=1) ** 1.5)[:, None]
    crowns *= [3.0, 3.0, 9.0]
    foot = np.random.default_rng(7).uniform(-12.0, 12.0, (16, 2))
    crowns += np.column_stack([foot, np.full(16, 20.0)])[rng.integers(0, 16, len(crowns))]
    ground = np.column_stack([rng.uniform(-13.0, 13.0, (4000, 2)), rng.normal(0.0, 0.03, 4000)])
    return np.vstack([crowns, ground])


@pytest.mark.parametrize("tilt", [0.0, 3.0, 12.0])
def test_the_floor_is_found_where_hardly_any_points_lie_on_it(
    tilt: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    R = transforms.tilt_matrix(0.7, np.radians(tilt)) @ transforms.yaw_matrix(0.4)
    xyz = tall_stand(np.random.default_rng(5)) @ R.T
    best = floors_of(xyz, extent_of(xyz), np.random.default_rng(0))[0]
    assert angle_deg(best.up, R @ UP) < 1.0
    assert best.even
    assert evidence_of(xyz).upright
    monkeypatch.setattr(floor, "MANY_POINTS", floor.POINTS)
    few = floors_of(xyz, extent_of(xyz), np.random.default_rng(0))[0]
    assert not few.even
    assert angle_deg(few.up, R @ UP) > 60.0


@pytest.mark.parametrize("turn", TURNS)
def test_the_likeliest_vertical_is_right_at_any_turn(turn: str) -> None:
    R = TURNS[turn] @ transforms.yaw_matrix(-0.3)
    xyz = garden(np.random.default_rng(2)) @ R.T
    found = level(xyz, "auto", georeferenced=False)
    assert angle_deg(found.T_level_work[:3, :3].T @ UP, R @ UP) < 0.7
    assert np.linalg.det(found.T_level_work[:3, :3]) == pytest.approx(1.0)
    assert evidence_of(xyz).upright == (turn in ("upright", "35 degrees"))


def test_an_upright_cloud_on_sloping_ground_is_kept_as_it_is() -> None:
    for slope in (0.0, 0.03, 0.06):
        found = level(garden(np.random.default_rng(3), slope=slope), "auto", georeferenced=False)
        assert np.array_equal(found.T_level_work, np.eye(4))


def test_on_steep_ground_the_vertical_as_given_is_one_of_the_hypotheses() -> None:
    found = verticals(garden(np.random.default_rng(4), slope=0.25))
    tilts = [one.tilt_deg for one in found]
    assert 0.0 in tilts
    assert any(abs(tilt - np.degrees(np.arctan(0.25))) < 1.0 for tilt in tilts)
    ups = [one.T_level_work[2, :3] for one in found]
    apart = [angle_deg(a, b) for i, a in enumerate(ups) for b in ups[:i]]
    assert min(apart) > SAME_VERTICAL_DEG


def test_a_facade_is_one_of_the_hypotheses_and_no_more() -> None:
    rng = np.random.default_rng(5)
    x = rng.uniform(-20, 20, 42_000)
    street = np.column_stack([x[:9000], rng.uniform(-10, 0, 9000), rng.normal(0, 0.03, 9000)])
    facade = np.column_stack([x[9000:39_000], rng.normal(0, 0.03, 30_000), rng.uniform(0, 18, 30_000)])
    balconies = np.column_stack([x[39_000:], rng.uniform(-1.5, 0, 3000), rng.integers(1, 6, 3000) * 3.0])
    for R in (np.eye(3), TURNS["y up"]):
        ups = [one.T_level_work[2, :3] for one in verticals(np.vstack([street, facade, balconies]) @ R.T)]
        assert min(angle_deg(up, R @ UP) for up in ups) < 1.5


def test_rotation_to_up_of_a_cloud_on_its_head_is_a_rotation() -> None:
    R = rotation_to_up(-UP)
    assert np.allclose(R @ -UP, UP)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("apart", [0.0, 5e3, 1e9, 1e17])
def test_lowest_points_need_no_room_for_what_lies_between_two_sites(apart: float) -> None:
    one = garden(np.random.default_rng(4))
    xyz = np.vstack([one, one + [apart, -apart, 3.0]])
    lowest = _lowest(xyz, 2.0)
    low, high = np.percentile(xyz[:, :2], [0.5, 99.5], axis=0)
    kept = xyz[((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)]
    expected: dict[tuple[float, ...], float] = {}
    for cell, z in zip(map(tuple, np.floor((kept[:, :2] - low) / 2.0)), kept[:, 2], strict=True):
        expected[cell] = min(z, expected.get(cell, np.inf))
    assert lowest[:, 2].tolist() == [expected[cell] for cell in sorted(expected)]
