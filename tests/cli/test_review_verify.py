"""`review` reads a recording alone; `verify` finds what has changed since a run, and else passes."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mtpcr_geo.cli import review
from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import EXIT_DIFFERENT
from mtpcr_geo.registration import register

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def job(town_files, tmp_path_factory) -> Path:
    """A folder of a job: both clouds, and the run of a registration beside them, named relatively."""
    folder = tmp_path_factory.mktemp("job")
    for file in town_files:
        shutil.copy(file, folder / file.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert register("source.laz", "target.laz", "out").verdict.name == "accepted"
    return folder


@pytest.fixture
def copy(job, tmp_path, monkeypatch) -> Path:
    """The same job to spoil; the current folder is another one."""
    shutil.copytree(job, tmp_path / "job")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "job"


def change(path: Path, **changes: object) -> None:
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | changes))


def verify(folder: Path) -> tuple[int, dict]:
    done = RUNNER.invoke(app, ["verify", str(folder), "--json"])
    return done.exit_code, json.loads(done.stdout) if done.stdout else {}


def kinds(found: dict) -> list[tuple[str, str]]:
    return [(one["kind"], one["name"]) for one in found["differences"]]


def test_an_untouched_run_is_reproduced_and_nothing_is_written(copy):
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    code, found = verify(copy / "out")
    assert (code, found["reproduced"], found["identical"], found["differences"]) == (0, True, True, [])
    assert found["moved"] == 0.0
    assert "bit for bit" in found["sentence"]
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before


def test_a_changed_input_is_found_by_its_hash_and_not_run(copy):
    file = copy / "target.laz"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    code, found = verify(copy / "out")
    assert code == EXIT_DIFFERENT
    assert not found["ran"]
    assert kinds(found) == [("input", "target.laz")]
    quiet = RUNNER.invoke(app, ["verify", str(copy / "out"), "-q"])
    assert (quiet.exit_code, quiet.stdout) == (EXIT_DIFFERENT, "")
    assert quiet.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_changed_option_is_found_and_changes_the_result(copy):
    path = copy / "out" / "run.json"
    record = json.loads(path.read_text())
    pipeline = [one | ({"cell": 2.5} if one["type"] == "mtpcr.bev" else {}) for one in record["pipeline"]]
    change(path, pipeline=pipeline)
    code, found = verify(copy / "out")
    assert code == EXIT_DIFFERENT
    assert ("option", "bev.cell") in kinds(found)
    assert ("file", "audit.rrd") in kinds(found)
    assert ("transform", "T_target_source") in kinds(found)


def test_the_recording_knows_of_an_option_changed_throughout_the_record(copy):
    path = copy / "out" / "run.json"
    record = json.loads(path.read_text())
    pipeline = [one | ({"cell": 2.5} if one["type"] == "mtpcr.bev" else {}) for one in record["pipeline"]]
    options = record["options"] | {"bev": record["options"]["bev"] | {"cell": 2.5}}
    change(path, pipeline=pipeline, options=options)
    (copy / "source.laz").write_bytes(b"")
    code, found = verify(copy / "out")
    assert code == EXIT_DIFFERENT
    assert ("option", "bev.cell") in kinds(found)


@pytest.mark.slow
def test_other_versions_are_named_and_do_not_count_alone(copy):
    (copy / "out" / "audit.rrd").unlink()
    path = copy / "out" / "run.json"
    change(path, versions=json.loads(path.read_text())["versions"] | {"numpy": "0.1"})
    code, found = verify(copy / "out")
    assert code == 0
    assert kinds(found) == [("version", "numpy")]
    assert "1 other version" in found["sentence"]


def test_a_changed_result_is_found(copy):
    path = copy / "out" / "run.json"
    T = json.loads(path.read_text())["T_target_source"]
    T[0][3] += 0.5
    change(path, T_target_source=T, verdict="doubtful")
    (copy / "source.laz").write_bytes(b"")
    code, found = verify(copy / "out")
    assert code == EXIT_DIFFERENT
    assert ("file", "transform.json") in kinds(found)
    assert kinds(found).count(("file", "audit.rrd")) == 2


def test_a_verdict_that_was_made_better_in_the_transform_is_found(copy):
    path = copy / "out" / "transform.json"
    verdict = json.loads(path.read_text())["verdict"]
    change(path, verdict=verdict | {"name": "doubtful" if verdict["name"] == "accepted" else "accepted"})
    code, found = verify(copy / "out")
    assert code == EXIT_DIFFERENT
    assert kinds(found) == [("file", "transform.json")]


@pytest.mark.parametrize("spoil", ["no record", "no json", "another json", "gone"])
def test_what_cannot_be_verified_is_said_in_a_line(copy, spoil):
    path = copy / "out" / "run.json"
    if spoil == "no record":
        path.unlink()
    elif spoil == "gone":
        (copy / "source.laz").unlink()
    else:
        path.write_text("{" if spoil == "no json" else '{"pipeline": 3}')
    done = RUNNER.invoke(app, ["verify", str(copy / "out")])
    assert done.exit_code == 5
    assert done.stderr.startswith("mtpcr-geo: error: ")
    assert done.stderr.count("\n") == 1


def test_review_prints_the_trail_from_the_recording_alone(job, tmp_path):
    shutil.copy(job / "out" / "audit.rrd", tmp_path / "moved.rrd")
    done = RUNNER.invoke(app, ["review", str(tmp_path / "moved.rrd"), "--open", "none"])
    assert done.exit_code == 0, done.stderr
    record = json.loads((job / "out" / "run.json").read_text())
    assert done.stdout.startswith(record["sentence"])
    for one in record["inputs"]:
        assert f"{one['path']}, {one['bytes']:,} bytes, sha256 {one['sha256']}" in done.stdout
    for tag in ("level", "bev", "match", "solve", "refine", "assess"):
        assert f"{tag} (mtpcr.{tag})" in done.stdout
    assert "of at most 5 MB" in done.stdout
    assert done.stderr == ""
    trail = json.loads(RUNNER.invoke(app, ["review", str(job / "out"), "--json"]).stdout)
    for key in ("verdict", "metrics", "checks", "T_target_source", "versions", "inputs", "pipeline"):
        assert trail[key] == record[key], key
    assert {one["tag"]: one["options"] for one in trail["stages"]}.items() <= record["options"].items()


def test_review_of_what_is_no_recording(tmp_path):
    import rerun as rr

    (tmp_path / "a.rrd").write_bytes(b"nothing of the kind")
    stream = rr.RecordingStream("another")
    stream.save(tmp_path / "b.rrd")
    stream.log("a", rr.TextLog("a"))
    stream.disconnect()
    for name, why in (("a.rrd", "no recording"), ("b.rrd", "no audit trail"), ("c", "there is no recording")):
        done = RUNNER.invoke(app, ["review", str(tmp_path / name)])
        assert done.exit_code == 5
        assert why in done.stderr
        assert done.stderr.count("\n") == 1


def test_the_viewer_is_the_one_beside_this_package():
    done = subprocess.run(
        [*review.VIEWER, "--version"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0
    assert "rerun" in done.stdout


def test_a_window_is_opened_only_where_there_is_a_display(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    assert not review.has_display({})
    assert review.has_display({"WAYLAND_DISPLAY": "wayland-0"})
