"""What an earlier run left under the same names never stands beside a new run's verdict."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers_scene import ORIGIN
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.io.write import write_cloud

WITHHELD = {"registered.laz", "transform.json", "transform.cloudcompare.txt", "transform.pdal.json"}


@pytest.fixture(scope="session")
def unrelated(tmp_path_factory) -> Path:
    """A cloud that fits nowhere."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0, 60, (4_000, 3)) * [1, 1, 0.2] + ORIGIN
    path = tmp_path_factory.mktemp("unrelated") / "unrelated.laz"
    write_cloud(path, ArrayCloud(xyz, CRS.from_epsg(25833), "unrelated"), None, CRS.from_epsg(25833))
    return path


def invoke(*arguments) -> int:
    result = CliRunner().invoke(app, [*map(str, arguments), "-q"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.output
    return result.exit_code


@pytest.mark.parametrize("verb", ["register", pytest.param("pipeline", marks=pytest.mark.slow)])
def test_a_refused_run_removes_what_an_accepted_one_left(verb, town_files, unrelated, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    target = town_files[1]
    Path("out/bev").mkdir(parents=True)
    for name in (*WITHHELD, "audit.rrd", "bev/registered.tif", "notes.txt"):
        Path("out", name).write_text("of an accepted run")
    command = ["register", unrelated, target, "-o", "out", "--no-recording"]
    if verb == "pipeline":
        dumped = CliRunner().invoke(app, [*map(str, command), "--dump-pipeline"])
        Path("p.json").write_text(dumped.stdout)
        command = ["pipeline", "p.json"]
    assert invoke(*command) == 7
    assert {path.name for path in Path("out").iterdir()} >= WITHHELD
    assert invoke(*command, "--overwrite") == 4
    left = {path.name for path in Path("out").iterdir()}
    assert left.isdisjoint(WITHHELD)
    assert not Path("out/bev/registered.tif").exists()
    assert Path("out/notes.txt").exists()
    assert json.loads(Path("out/run.json").read_text())["verdict"] == "refused"
    if verb == "register":
        assert "audit.rrd" not in left
