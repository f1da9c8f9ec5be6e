"""Escape sequences and right-to-left marks in names reach no terminal, page or file that is looked at."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from pathlib import Path

import laspy
import pytest
from helpers_scene import ORIGIN, make_pair
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.types import Verdict
from mtpcr_geo.core.wording import visible
from mtpcr_geo.export.recording.budget import Budget
from mtpcr_geo.export.recording.recorder import RerunRecorder
from mtpcr_geo.io.write import write_cloud

ESCAPE, TURN, BELL = "\x1b[31m", "\u202egnp.", "\x07"
HOSTILE = f"x{ESCAPE}{TURN}{BELL}y"
SIGNS = ("\x1b", "\u202e", "\x07", "\u2066", "\udc80")


def clean(text: str) -> bool:
    return not any(sign in text for sign in SIGNS)


def run(*arguments) -> str:
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    assert clean(result.stdout)
    assert clean(result.stderr)
    return result.stdout + result.stderr


def named(name: str) -> CRS:
    """Return EPSG:25833 by another name."""
    wkt = CRS.from_epsg(25833).to_wkt().replace('"ETRS89 / UTM zone 33N"', f'"{name}"', 1)
    return CRS.from_wkt(wkt.replace('ID["EPSG",25833]', 'ID["MINE",1]'))


def test_what_is_visible_stays_and_the_rest_is_named():
    assert visible("Köln, 東京\nm²") == "Köln, 東京\nm²"
    assert visible("a\x1b[0m\u202eb\u200f\udc80\r\t") == r"a\x1b[0m\u202eb\u200f\udc80\r\t"
    assert str(InputError(f"no {HOSTILE}")) == r"no x\x1b[31m\u202egnp.\x07y"
    assert Verdict("refused", (HOSTILE,), {}).reasons == (visible(HOSTILE),)


@pytest.fixture(scope="module")
def hostile_files(town_files, tmp_path_factory) -> tuple[Path, Path]:
    """The town with hostile names: of the files, the CRS, a VLR, an extra dimension and the software."""
    folder = tmp_path_factory.mktemp("hostile")
    paths = []
    for path in town_files:
        las = laspy.read(path)
        las.header.add_crs(named(HOSTILE))
        las.header.generating_software = "s\x1b[31m"
        las.header.vlrs.append(laspy.VLR("u\x1b[31m", 7, "d\x1b[31m", b"\x1b[31m"))
        las.add_extra_dim(laspy.ExtraBytesParams("e\x1b[31m", "u1", "t\x1b[31m"))
        paths.append(folder / f"{path.stem}{HOSTILE}.laz")
        las.write(paths[-1])
    return paths[0], paths[1]


@pytest.mark.slow
def test_names_in_clouds_reach_nothing_that_is_looked_at(hostile_files, tmp_path):
    source, target = hostile_files
    out = tmp_path / f"o{HOSTILE}"
    shown = run("register", source, target, "-o", out, "--verbose")
    assert r"\x1b[31m" in shown
    run("register", source, target, "-o", out)
    run("register", source, target, "-o", out, "--dump-pipeline")
    assert json.loads(run("register", source, target, "-o", out, "--json", "--overwrite"))["verdict"]
    for name in (
        "report.html",
        "run.json",
        "transform.json",
        "transform.pdal.json",
        "transform.cloudcompare.txt",
    ):
        text = (out / name).read_text(encoding="utf-8")
        assert clean(text), name
    assert all(map(clean, json.loads((out / "run.json").read_text())["reasons"]))
    with sqlite3.connect(out / "ties.gpkg") as base:
        assert all(map(clean, base.iterdump()))
    base.close()
    run("check", source, target)
    assert json.loads(run("check", source, "--json"))
    run("apply", out / "transform.json", source, tmp_path / f"m{HOSTILE}.laz")


def test_names_reach_no_recording(tmp_path):
    from rerun.chunk import RrdReader

    pair = make_pair()
    recorder = RerunRecorder(tmp_path / "a.rrd", Budget(1.0))
    facts = {"pipeline": [{"type": HOSTILE, "tag": HOSTILE, "filename": HOSTILE}], "versions": {},
             "inputs": [{"path": HOSTILE, "bytes": 1, "sha256": HOSTILE}], "started": 1.0}  # fmt: skip
    recorder.begin(facts)
    recorder.after(HOSTILE, HOSTILE, {HOSTILE: HOSTILE}, ArrayCloud(ORIGIN + [[0, 0, 0]], None, HOSTILE), 0.1)
    recorder.after("mtpcr.assess", "assess", {"cell": HOSTILE}, pair, 0.1)
    recorder.close()
    seen = 0
    for chunk in RrdReader(tmp_path / "a.rrd").stream():
        text = chunk.format() + str(chunk.to_record_batch().to_pylist())
        seen += r"\x1b[31m" in text
        assert "\x1b" not in text
        assert clean(text), chunk.entity_path
    assert seen


@pytest.mark.skipif(os.name == "nt", reason="file names are texts there")
def test_a_file_name_that_is_no_text(town_files, tmp_path):
    path = tmp_path / os.fsdecode(b"a\x80\x1b[31m.laz")
    shutil.copy(town_files[0], path)
    assert r"\udc80" in run("check", path)
    print(run("register", path, town_files[1], "-o", tmp_path / "out"))
    assert clean((tmp_path / "out/report.html").read_text(encoding="utf-8"))
    assert r"\udc80" in run("apply", path, path, tmp_path / "b.laz")


@pytest.mark.parametrize(
    "stages",
    [
        [{"type": HOSTILE}],
        [{"type": f"mtpcr.{HOSTILE}"}],
        ["a.laz", {"type": "mtpcr.bev", HOSTILE: 1}],
        ["a.laz", {"type": "mtpcr.bev", "tag": HOSTILE}],
        [f"{HOSTILE}.laz", {"type": "mtpcr.bev"}],
        ["a.laz", {"type": "filters.range", HOSTILE: 1}],
        ["a.laz", {"type": "filters.range", "limits": HOSTILE}],
        ["a.laz", {"type": "mtpcr.level", "inputs": [HOSTILE]}],
        {HOSTILE: []},
    ],
)
def test_names_in_pipelines(stages, town_files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(town_files[0], "a.laz")
    for ascii_only in (True, False):
        Path("p.json").write_text(json.dumps(stages, ensure_ascii=ascii_only), encoding="utf-8")
        assert "error: " in run("pipeline", "p.json")
        assert "error: " in run("pipeline", "p.json", "--validate")


@pytest.mark.parametrize(
    "arguments",
    [["check", HOSTILE], [HOSTILE], ["check", f"--{HOSTILE}"], ["register", HOSTILE, "a", "-o", "b"]],
)
def test_names_on_the_command_line(arguments):
    run(*arguments)


def test_a_crs_of_that_name_refused(town_files, tmp_path):
    las = ArrayCloud(ORIGIN + [[0, 0, 0], [9, 9, 9.0]], named(HOSTILE), "x")
    write_cloud(tmp_path / "x.laz", las, None, named(HOSTILE))
    run("register", tmp_path / "x.laz", town_files[1], "-o", tmp_path / "out")
    run("check", tmp_path / "x.laz", town_files[1])
