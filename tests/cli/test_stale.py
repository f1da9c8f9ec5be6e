"""What an earlier run left under the same names never stands beside a new run's verdict."""

from __future__ import annotations

import json
import shutil
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
    """A cloud that fits nowhere; a small one, for which is soon searched everywhere."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0, 25, (1_500, 3)) * [1, 1, 0.2] + ORIGIN
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


# what makes a run of the town end so, by what the pipeline's options say, and its exit code
OUTCOMES: dict[str, tuple[list[str], int]] = {
    "accepted": ([], 0),
    "doubtful": (["--assess.null_ratio=1000"], 3),
    "refused": (["UNRELATED"], 4),
    "forced": (["UNRELATED", "--force"], 4),
}


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def command_for(verb: str, outcome: str, town_files, unrelated: Path) -> tuple[list[str], int]:
    """Return the command of a verb that ends so in the current folder, into "out"."""
    options, code = OUTCOMES[outcome]
    source = unrelated if "UNRELATED" in options else town_files[0]
    words = [option for option in options if option == "--force"]
    register = ["register", str(source), str(town_files[1]), "-o", "out", "--no-recording", *words]
    if verb == "register":
        return register, code
    dumped = CliRunner().invoke(app, [*register, "--dump-pipeline"])
    Path(f"{outcome}.json").write_text(dumped.stdout)
    return ["pipeline", f"{outcome}.json", *(one for one in options if one.startswith("--assess"))], code


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["register", "pipeline"])
def test_every_pair_of_verdicts(verb, town_files, unrelated, tmp_path, monkeypatch):
    """Whatever stood there, a run with --overwrite leaves the set that it leaves in an empty folder."""
    monkeypatch.chdir(tmp_path)
    # register has no option that makes the town doubtful
    outcomes = [name for name in OUTCOMES if verb == "pipeline" or name != "doubtful"]
    commands = {name: command_for(verb, name, town_files, unrelated) for name in outcomes}
    for name, (command, code) in commands.items():
        assert invoke(*command) == code, name
        Path("out").rename(f"fresh-{name}")
        said = json.loads(Path(f"fresh-{name}/run.json").read_text())["verdict"]
        assert said == ("refused" if name == "forced" else name)
    withheld = {"registered.laz", "transform.json"}
    assert names(Path("fresh-accepted")) >= withheld
    assert names(Path("fresh-forced")) >= withheld
    assert names(Path("fresh-refused")).isdisjoint(withheld)
    for first in outcomes:
        for second, (command, code) in commands.items():
            shutil.rmtree("out", ignore_errors=True)
            shutil.copytree(f"fresh-{first}", "out")
            Path("out/notes.txt").write_text("mine")
            assert invoke(*command, "--overwrite") == code, (first, second)
            assert names(Path("out")) == names(Path(f"fresh-{second}")) | {"notes.txt"}, (first, second)
            for path in names(Path("out")) & {"transform.cloudcompare.txt", "bev/target.tif"}:
                new, fresh = Path("out", path), Path(f"fresh-{second}", path)
                assert new.read_bytes() == fresh.read_bytes(), (first, second, path)
