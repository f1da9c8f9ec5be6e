"""Units and axes of local clouds, declared or recognised."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest
from helpers_scene import town
from pyproj import CRS

import mtpcr_geo as mg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.core.scanner import Scanner, rotation_of, unit_by_size
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.core.units import UNITS, Axes
from mtpcr_geo.crs import TransformChain, resolve_frames
from mtpcr_geo.export.transform import read_transform, write_transform_json
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud

AXES = get_args(Axes)
UP = {"z-up": [0, 0, 1], "y-up": [0, 1, 0], "x-up": [1, 0, 0], "z-down": [0, 0, -1], "y-down": [0, -1, 0],
      "x-down": [-1, 0, 0]}  # fmt: skip
T = transforms.compose(transforms.yaw_matrix(0.5), np.array([3.0, -2.0, 1.0]))


@pytest.mark.parametrize("axes", AXES)
def test_axes_are_rotations_that_take_up_to_z(axes):
    R = rotation_of(axes)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert (R @ np.array(UP[axes])).tolist() == [0, 0, 1]


def pair_of(source: Scanner, target: Scanner, target_crs: CRS | None = None) -> Pair:
    rng = np.random.default_rng(1)
    clouds = [ArrayCloud(rng.uniform(0, 90, (200, 3)) / one.metres, None, "a") for one in (target, source)]
    if target_crs is not None:
        clouds[0] = ArrayCloud(rng.uniform(0, 0.001, (200, 3)) + [11, 47, 100], target_crs, "a")
    frame, target_link, source_link = resolve_frames(
        clouds[0],
        clouds[1],
        source_crs="local",
        target_crs=target_crs or "local",
        source_scanner=source,
        target_scanner=target,
    )
    return Pair(
        Side("target", clouds[0], target_link, target_link.to_work(clouds[0].xyz)),
        Side("source", clouds[1], source_link, source_link.to_work(clouds[1].xyz)),
        frame,
        T_target_source=T,
    )


@pytest.mark.parametrize("unit", [None, "mm", "ft"])
@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("geographic", [False, True])
def test_chain_matrix_and_file_say_the_same(tmp_path, unit, axes, geographic):
    target = Scanner() if geographic else Scanner("cm", "x-down")
    pair = pair_of(Scanner(unit, axes), target, CRS.from_epsg(4326) if geographic else None)
    chain = TransformChain.of(pair)
    xyz = pair.source.cloud.to_array()
    moved = chain.forward(xyz)
    assert np.allclose(chain.inverse(moved), xyz, rtol=0, atol=1e-6 / UNITS[unit or "m"][0])
    work = pair.source.sample
    R = rotation_of(axes) * UNITS[unit or "m"][0]
    assert np.allclose(work + pair.source.link.origin, xyz @ R.T, rtol=0, atol=1e-9)
    write_transform_json(tmp_path / "t.json", pair)
    again = read_transform(tmp_path / "t.json")
    assert np.array_equal(again.forward(xyz), moved)
    assert again.source.scanner == Scanner(unit, axes)
    document = json.loads((tmp_path / "t.json").read_text())
    assert document["version"] == (1 if axes == "z-up" and geographic else 2)
    assert document["units"]["source"] == [UNITS[unit or "m"][1]] * 3
    if not geographic:
        matrix = np.array(document["T_target_source"])
        assert np.allclose(transforms.apply(matrix, xyz), moved, rtol=0, atol=1e-6)


@pytest.mark.parametrize("option", ["unit", "axes"])
def test_a_crs_states_its_own(option):
    scanner = Scanner("mm") if option == "unit" else Scanner(axes="y-up")
    cloud = ArrayCloud(np.random.default_rng(1).uniform(0, 9, (200, 3)), CRS.from_epsg(25832), "a")
    with pytest.raises(CrsError, match=f"--source-{option} is for local coordinates"):
        resolve_frames(cloud, cloud, source_scanner=scanner)


@pytest.mark.parametrize(
    ("size", "points", "unit"),
    [
        ((85_000, 40_000, 20_000), 1_000_000, "mm"),  # a street
        ((20_000, 85_000, 40_000), 1_000_000, "mm"),  # y up
        ((10_000, 8_000, 3_500), 5_000_000, "mm"),  # a room
        ((290_000, 420_000, 16_000), 41_000, "mm"),
        ((100_000, 100_000, 12_000), 1_000_000_000, "mm"),
        ((27, 27, 34), 300_000, None),  # a forest plot
        ((164, 64, 20), 100_000, None),
        ((1_000, 1_000, 60), 3_000_000, None),
        ((5_000, 5_000, 900), 60_000_000, None),  # mountains
        ((80, 80, 5), 10_000, None),
        ((0.085, 0.04, 0.02), 1_000_000, "km"),
        ((0.2, 0.2, 0.2), 1_000, "km"),
    ],
)
def test_units_are_told_by_size(size, points, unit):
    found = unit_by_size(np.array(size), points)
    assert found == unit if (size[0] > 0.1 or unit is None) else found in (unit, "km")


@pytest.fixture(scope="module")
def scans() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    target = town(rng, 40_000)
    source = town(rng, 30_000)
    turn = transforms.compose(transforms.yaw_matrix(np.deg2rad(40.0)), np.array([8.0, -5.0, 1.0]))
    return np.round(transforms.apply(turn, source[source[:, 0] > -30]), 3), np.round(target, 3)


def test_a_declared_unit_and_axes_change_nothing_but_the_matrix(scans):
    source, target = scans
    plain = mg.register(source, target)
    assert plain.verdict.name == "accepted"
    assert plain.T_target_source is not None
    y_up = (source @ rotation_of("y-up")) * 1000.0
    found = mg.register(y_up, target, source_unit="mm", source_axes="y-up")
    assert found.verdict.name == "accepted"
    assert np.allclose(found.apply(y_up[::50]), plain.apply(source[::50]), rtol=0, atol=1e-6)
    with pytest.raises(InputError, match='source_unit="mm"'):
        mg.register(source * 1000.0, target)


@pytest.mark.parametrize("scale", [0.01, 1.0])
def test_a_declared_metre_is_believed(tmp_path, scale):
    xyz = np.random.default_rng(1).uniform(0, 30_000 * scale, (5_000, 3)) * [1, 1, 0.001]
    write_cloud(tmp_path / "a.las", ArrayCloud(xyz), None, None)
    wide = scale == 1.0
    found = {finding.code for finding in check_clouds(tmp_path / "a.las", local=True).findings}
    assert ("unit" in found) == wide
    report = check_clouds(tmp_path / "a.las", local=True, source_unit="m")
    assert "unit" not in {finding.code for finding in report.findings}


def test_the_aerial_cloud_as_source_is_noticed(tmp_path):
    rng = np.random.default_rng(2)
    ground = town(rng, 60_000)
    ground = ground[(np.abs(ground[:, :2]) < 25).all(axis=1)]
    write_cloud(
        tmp_path / "ground.las",
        ArrayCloud(np.repeat(ground, 4, axis=0) + rng.normal(0, 0.01, (4 * len(ground), 3))),
        None,
        None,
    )
    write_cloud(tmp_path / "air.las", ArrayCloud(town(rng, 30_000)), None, None)
    files = tmp_path / "air.las", tmp_path / "ground.las"
    codes = [{f.code for f in check_clouds(*pair, local=True).findings} for pair in (files, files[::-1])]
    assert "exchanged" in codes[0]
    assert "exchanged" not in codes[1]


def test_the_result_is_written_in_the_units_of_the_target(tmp_path, scans):
    source, target = scans
    found = mg.register(source, target * 1000.0, tmp_path / "out", target_unit="mm", recording=False)
    written = open_cloud(tmp_path / "out" / "registered.laz").to_array()
    assert np.ptp(written[:, 0]) > 50_000
    assert np.allclose(written, found.apply(source), rtol=0, atol=0.001)
