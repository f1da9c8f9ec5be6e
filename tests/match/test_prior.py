from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from mtpcr_geo.benchmark.metrics import centroid_errors, rotation_error_deg
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.correlation import match
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.method.bev import make_bev
from mtpcr_geo.method.refine import constrain
from mtpcr_geo.method.scales import tolerance_for
from mtpcr_geo.registration import register


def shifted(source: Path, T: np.ndarray, out: Path) -> np.ndarray:
    las = laspy.read(source)
    xyz = transforms.apply(T, np.column_stack([las.x, las.y, las.z]))
    las.change_scaling(offsets=np.floor(xyz.min(axis=0)))
    las.x, las.y, las.z = xyz.T
    las.write(out)
    return xyz.mean(axis=0)


def test_a_prior_finds_what_lies_near_it(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "coast_town_sparse_ign382"
    with laspy.open(folder / "source.laz") as file:
        middle = (file.header.mins + file.header.maxs) / 2
    T = transforms.translation((6.0, -4.0, 1.5)) @ transforms.about(
        middle, transforms.yaw_matrix(np.radians(2.5))
    )
    centroid = shifted(folder / "source.laz", T, tmp_path / "source.laz")
    found = register(
        tmp_path / "source.laz", folder / "target.laz", tmp_path / "out", prior="georef", recording=False
    )
    assert found.verdict.name == "accepted"
    assert found.T_target_source is not None
    truth = transforms.inverse(T)
    assert rotation_error_deg(found.T_target_source, truth) < 0.1
    assert centroid_errors(found.T_target_source, truth, centroid)[0] < 0.3


def test_a_prior_needs_both_crs(town_files: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="needs a CRS on both"):
        register(*town_files, tmp_path / "out", prior="georef", source_crs="local", recording=False)


def test_translation_only_keeps_the_directions(town_files: tuple[Path, Path], tmp_path: Path) -> None:
    # the town's source is turned by 61 degrees, so a pure shift cannot bring it home, and must not claim to
    found = register(*town_files, tmp_path / "out", motion="translation", recording=False)
    assert found.T_target_source is not None
    assert np.allclose(found.T_target_source[:3, :3], np.eye(3), atol=1e-12)
    assert found.verdict.name != "accepted"


def test_constraining_keeps_the_pivot_where_it_goes() -> None:
    R = transforms.yaw_matrix(0.4) @ transforms.tilt_matrix(1.0, 0.05)
    T = transforms.compose(R, np.array([3.0, 4.0, 5.0]))
    pivot = np.array([[20.0, -10.0, 2.0]])
    yaw = constrain(T, "yaw", pivot[0], np.eye(3))
    assert np.allclose(transforms.apply(yaw, pivot), transforms.apply(T, pivot))
    assert yaw[2, 2] == 1.0
    shift = constrain(T, "translation", pivot[0], np.eye(3))
    assert np.allclose(transforms.apply(shift, pivot), transforms.apply(T, pivot))
    assert np.array_equal(shift[:3, :3], np.eye(3))
    assert np.array_equal(constrain(T, "rigid", pivot[0], np.eye(3)), T)


def orchard(seed: int, low: float, high: float) -> np.ndarray:
    """Trees on a lattice of 4 m over a square, 12 points a square metre, on gently rolling ground."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(low, high, (int((high - low) ** 2 * 12), 2))
    off = np.hypot(*((xy + 2.0) % 4.0 - 2.0).T)
    crown = np.where(off < 1.3, 3.0 * np.sqrt(np.maximum(1.0 - (off / 1.3) ** 2, 0.0)), 0.0)
    ground = 0.15 * np.sin(xy[:, 0] / 13.0) + 0.1 * np.cos(xy[:, 1] / 11.0)
    return np.column_stack([xy, crown + ground + rng.normal(0.0, 0.03, len(xy))])


def test_among_rows_nothing_is_found_beyond_what_is_known_of_the_place() -> None:
    source, target = orchard(1, 10.0, 34.0), orchard(2, 0.0, 50.0)
    middle = source[:, :2].mean(axis=0)
    at = (float(middle[0]), float(middle[1]))
    prior = Prior(at, at, 1.0, 0.0, np.radians(3.0))
    found = match(make_bev(source, 0.5), make_bev(target, 0.5), prior=prior)
    for one in found.hypotheses:
        c, s = np.cos(one.yaw), np.sin(one.yaw)
        away = np.array([[c, -s], [s, c]]) @ middle + one.shift - middle
        assert np.hypot(*away) < 1.0 + tolerance_for(0.5)
        # at the rim of 17 m
        assert abs(np.degrees(one.yaw)) < 3.0 + np.degrees(tolerance_for(0.5) / 16.0)
    c, s = np.cos(found.hypotheses[0].yaw), np.sin(found.hypotheses[0].yaw)
    assert np.hypot(*(np.array([[c, -s], [s, c]]) @ middle + found.hypotheses[0].shift - middle)) < 0.3


def test_a_prior_allows_what_lies_within_it() -> None:
    grid = Grid(0.0, 20.0, 1.0, 30, 20)
    prior = Prior((15.0, 10.0), (100.0, 50.0), 2.0, 0.5, 0.1)
    assert prior.allows(Pose(0.55, 101.0, 51.0), grid, 0.0)
    assert not prior.allows(Pose(0.55, 103.0, 50.0), grid, 0.5)
    assert prior.allows(Pose(0.55, 103.0, 50.0), grid, 1.5)
    assert not prior.allows(Pose(0.7, 100.0, 50.0), grid, 1.0)
    # the opposite way round the circle
    assert Prior((15.0, 10.0), yaw=np.pi - 0.05, yaw_range=0.2).allows(
        Pose(0.05 - np.pi, 0.0, 0.0), grid, 0.0
    )
    assert Prior((15.0, 10.0)).allows(Pose(3.0, 1e6, 0.0), grid, 0.0)
