"""Bad input to `register`: one line that says what to do, the right exit code, no output."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app

UTM = CRS.from_epsg(25833)


def write(path: Path, xyz: np.ndarray, crs: CRS | None = UTM) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [0.001] * 3
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else [0.0] * 3
    if crs is not None:
        header.add_crs(crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (np.round(xyz[:, axis], 3) for axis in range(3))
    cloud.write(path)
    return path


@pytest.fixture(scope="module")
def clouds(town_files, tmp_path_factory) -> dict[str, Path]:
    source, target = town_files
    folder = tmp_path_factory.mktemp("bad")
    town = np.asarray(laspy.read(source).xyz)
    made = {"source": source, "target": target, "missing": folder / "missing.laz"}
    made["folder"] = folder / "without"
    made["folder"].mkdir()
    made["empty"] = write(folder / "empty.laz", np.empty((0, 3)))
    made["one"] = write(folder / "one.laz", town[:1])
    made["equal"] = write(folder / "equal.laz", np.repeat(town[:1], 500, axis=0))
    made["flat"] = write(folder / "flat.laz", np.column_stack([town[:, :2], np.full(len(town), 3.0)]))
    made["line"] = write(folder / "line.laz", town[:2000] * [1.0, 0.0, 0.0] + [0.0, 5.8e6, 30.0])
    made["no_crs"] = write(folder / "no_crs.laz", town, None)
    made["feet"] = write(folder / "feet.laz", town, CRS.from_epsg(2994))
    made["far"] = write(folder / "far.laz", town + np.array([0.0, 1.5e6, 0.0]))
    made["cut"] = folder / "cut.laz"
    made["cut"].write_bytes(source.read_bytes()[: source.stat().st_size // 2])
    made["text"] = folder / "text.laz"
    made["text"].write_text("X Y Z\n1 2 3\n")
    made["nothing"] = folder / "nothing.laz"
    made["nothing"].touch()
    made["copy"] = folder / "copy.laz"
    made["copy"].write_bytes(target.read_bytes())
    return made


CASES = {
    "missing": ("missing", "target", 5, "missing.laz"),
    "a folder without clouds": ("folder", "target", 5, "names no cloud"),
    "empty cloud": ("empty", "target", 5, "empty.laz"),
    "one point": ("one", "target", 5, "one.laz"),
    "points all equal": ("equal", "target", 5, "equal.laz"),
    "truncated": ("cut", "target", 5, "truncated or damaged"),
    "not a cloud": ("text", "target", 5, "not a LAS, LAZ or COPC file"),
    "an empty file": ("nothing", "target", 5, "nothing.laz"),
    "no CRS": ("no_crs", "target", 6, "--source-crs"),
    "the same file": ("target", "target", 5, "same file"),
    "the same bytes": ("copy", "target", 5, "same bytes"),
    "far apart": ("far", "target", 6, "km"),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input(name, clouds, tmp_path):
    source, target, code, words = CASES[name]
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["register", str(clouds[source]), str(clouds[target]), "-o", str(out)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    (line,) = result.stderr.splitlines()
    assert line.startswith("mtpcr-geo: error: ")
    assert words in line
    assert result.exit_code == code
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["flat", "line"])
def test_a_cloud_without_features_is_not_accepted(name, clouds, tmp_path):
    out = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["register", str(clouds[name]), str(clouds["target"]), "-o", str(out), "--no-recording"]
    )
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code in (4, 5)
    assert not (out / "registered.laz").exists()


def test_coordinates_that_are_not_finite(clouds, tmp_path):
    bad = tmp_path / "bad.las"
    cloud = laspy.read(clouds["source"])
    cloud.write(bad)
    data = bytearray(bad.read_bytes())
    data[131:139] = np.float64(np.nan).tobytes()  # the scale of x
    bad.write_bytes(data)
    result = CliRunner().invoke(
        app, ["register", str(bad), str(clouds["target"]), "-o", str(tmp_path / "out")]
    )
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 5, line
    assert "bad.las" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc")
def test_folder_that_cannot_be_made(clouds):
    result = CliRunner().invoke(
        app, ["register", str(clouds["source"]), str(clouds["target"]), "-o", "/proc/mtpcr/out"]
    )
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 7
    assert "/proc" in line


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() == 0, reason="root may write everywhere")
def test_folder_without_rights(clouds, tmp_path):
    place = tmp_path / "mine"
    place.mkdir(mode=0o500)
    result = CliRunner().invoke(
        app, ["register", str(clouds["source"]), str(clouds["target"]), "-o", str(place / "out")]
    )
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 7
    assert "cannot write" in line
