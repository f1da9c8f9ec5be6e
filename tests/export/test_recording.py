"""The recording: read back, whole, and harmless to a run."""

from __future__ import annotations

import dataclasses
import os
import select
import subprocess
import sys
from concurrent.futures import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_scene import ORIGIN, make_pair, true_transform

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.recorder import NullRecorder, Recorder
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export.recording import process as process_module
from mtpcr_geo.export.recording import recorder as recorder_module
from mtpcr_geo.export.recording import writer
from mtpcr_geo.export.recording.budget import Budget
from mtpcr_geo.export.recording.recorder import RerunRecorder

# room for 2000 points of each input
SMALL = Budget((16.0 * 2000.5 / 0.055 + 150_000) / 1e6)
FACTS = {
    "pipeline": [{"type": "readers.las", "tag": "target", "filename": "target.laz"}],
    "versions": {"numpy": "2.0", "opencv-python-headless": "4"},
    "inputs": [{"path": "target.laz", "bytes": 12, "sha256": "ab" * 32}],
    "started": 1.0,
}


def states(pair: Pair):
    """The values that the stages of a whole run hand on, with their tags."""
    bare = dataclasses.replace(pair.target, bev=None), dataclasses.replace(pair.source, bev=None)
    levelled = Pair(*bare, pair.frame)
    bev = levelled.with_(target=pair.target, source=pair.source)
    matched = bev.with_(matches=pair.matches)
    pixels_to_3d = matched.with_(tie_points=pair.tie_points)
    solved = pixels_to_3d.with_(T_target_source=pair.T_target_source)
    refined = solved.with_(T_target_source=None if solved.T_target_source is None else true_transform())
    return [
        ("source", pair.source.cloud),
        ("level", levelled),
        ("bev", bev),
        ("match", matched),
        ("inverse_mapping", pixels_to_3d),
        ("solve", solved),
        ("refine", refined),
        ("assess", refined.with_(verdict=pair.verdict)),
        ("writer", None),
    ]


def record(path, pair: Pair, budget: Budget = SMALL, apart: bool = False) -> None:
    recorder: Recorder = RerunRecorder(path, budget=budget, apart=apart)
    recorder.begin(FACTS)
    for tag, value in states(pair):
        recorder.after(f"mtpcr.{tag}", tag, {"cell": 1.0}, value, 0.25)
    recorder.close()


def rows(path, entity: str) -> list[dict]:
    """Everything recorded at an entity, a dict a row, in order of the stages."""
    from rerun.chunk import RrdReader

    found = []
    for chunk in RrdReader(str(path)).stream().to_chunks():
        if chunk.entity_path == entity:
            found += chunk.to_record_batch().to_pylist()
    return sorted(found, key=lambda row: row.get("stage") or 0)


def rows_without_ids(path, entity: str) -> list[str]:
    """What was recorded at an entity, in any order and without what is numbered at random."""
    return sorted(
        repr({name: value for name, value in sorted(row.items()) if "id" not in name.lower()})
        for row in rows(path, entity)
    )


def ended(pid: int) -> bool:
    """Whether a process is gone, or no more than its exit status is left; waits for it."""
    for _ in range(3000):
        try:
            os.kill(pid, 0)
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")")[-1].split()[0]
        except (ProcessLookupError, FileNotFoundError):
            return True
        if state == "Z":
            return True
        select.select([], [], [], 0.01)
    return False


def entities(path) -> set[str]:
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(str(path)).stream().to_chunks()}


def positions(path, entity: str) -> np.ndarray:
    return np.array(
        next(row for row in rows(path, entity) if "Points3D:positions" in row)["Points3D:positions"]
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / ".audit.part-1.rrd"
    record(path, make_pair(3000))
    return path


def test_one_file_that_rerun_accepts(whole):
    assert [file.name for file in whole.parent.iterdir()] == [whole.name]
    command = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(whole)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_every_stage_left_its_trace(whole):
    wanted = {
        "/input/source", "/input/target", "/levelled/source", "/levelled/target",
        "/bev/source/relief", "/bev/target/bandpass", "/bev/target/height",
        "/matches/image", "/matches/agreeing/lines", "/matches/held_out/lines", "/matches/disagreeing/lines",
        "/hypotheses", "/stage_list",
        "/aligned/source/points", "/aligned/target/points", "/aligned/tie_points",
        "/aligned/links", "/residuals", "/map/source", "/map/target", "/stages", "/seconds", "/summary",
        "/run",
    }  # fmt: skip
    assert wanted <= entities(whole)
    lines = [row["TextLog:text"][0] for row in rows(whole, "/stages")]
    assert len(lines) == 9
    assert "verdict accepted" in lines[7]
    assert [row["stage"] for row in rows(whole, "/seconds")] == list(range(9))


def test_a_layout_is_saved_with_it(whole):
    from rerun.chunk import RrdReader

    assert len(RrdReader(str(whole)).blueprints()) == 1


def test_clouds_keep_to_the_budget_and_the_work_frame(whole):
    pair = make_pair(3000)
    xyz = positions(whole, "/input/target")
    assert xyz.shape == (2000, 3)
    known = {tuple(point) for point in pair.target.sample.astype(np.float32).tolist()}
    assert all(tuple(point) in known for point in xyz.astype(np.float32).tolist())
    assert len(positions(whole, "/levelled/source")) == 1636


def test_the_aligned_source_lies_on_the_target(whole):
    last = [row for row in rows(whole, "/aligned/source") if "Transform3D:translation" in row][-1]
    R = np.array(last["Transform3D:mat3x3"][0]).reshape(3, 3).T
    moved = positions(whole, "/aligned/source/points") @ R.T + np.array(last["Transform3D:translation"][0])
    target = positions(whole, "/aligned/target/points")
    distance = np.sqrt(((moved[:200, None, :2] - target[None, :, :2]) ** 2).sum(axis=2)).min(axis=1)
    assert np.median(distance) < 2.0
    assert np.all(np.abs(moved[:, :2]) < 60.5)


def test_properties_hold_crs_origin_hashes_and_versions(whole):
    (frame,) = rows(whole, "/__properties/frame")
    assert frame["crs"] == ["ETRS89 / UTM zone 33N"]
    assert [float(text) for text in frame["origin_m"][0].split()] == ORIGIN.tolist()
    assert frame["source_crs"] == ["local"]
    (file,) = rows(whole, "/__properties/input_1")
    assert file["sha256"] == ["ab" * 32]
    (versions,) = rows(whole, "/__properties/versions")
    assert versions["opencv_python_headless"] == ["4"]
    (run,) = rows(whole, "/__properties/program")
    assert run["name"] == ["mtpcr_geo"]


def test_footprints_are_where_the_site_is(whole):
    from pyproj import Transformer

    ring = np.array(rows(whole, "/map/source")[0]["GeoLineStrings:line_strings"][0])
    east, north = Transformer.from_crs("EPSG:4326", "EPSG:25833", always_xy=True).transform(
        ring[:, 1], ring[:, 0]
    )
    assert np.all(np.abs(east - ORIGIN[0]) < 61)
    assert np.all(np.abs(north - ORIGIN[1]) < 61)


def test_the_verdict_is_told_in_words(whole):
    text = rows(whole, "/summary")[-1]["TextDocument:text"][0]
    assert text.startswith("# Accepted")
    assert "16 held-out tie points agree to 0.11 m" in text
    assert "- **yaw**: +33.0000°" in text
    assert "|---" not in text  # a table is cut off in the narrow view that the text has


def test_same_run_same_points(tmp_path, whole):
    record(tmp_path / "again.rrd", make_pair(3000))
    for entity in ("/input/source", "/aligned/target/points"):
        assert np.array_equal(positions(whole, entity), positions(tmp_path / "again.rrd", entity))


@pytest.mark.parametrize("state", ["levelled", "matched", "tied", "solved"])
def test_a_run_that_ended_early_is_recorded_too(tmp_path, state):
    record(tmp_path / "a.rrd", make_pair(800, state=state, crs=None), budget=SMALL)
    found = entities(tmp_path / "a.rrd")
    assert "/levelled/source" in found
    assert "/map/target" not in found
    assert ("/matches/image" in found) == (state != "levelled")
    assert ("/aligned/source/points" in found) == (state == "solved")


def test_one_cloud_alone(tmp_path):
    target = make_pair(800).target
    recorder = RerunRecorder(tmp_path / "a.rrd", budget=SMALL)
    recorder.begin({})
    recorder.after("mtpcr.bev", "bev", {}, Pair(target, target, make_pair(500).frame), 0.1)
    recorder.close()
    found = entities(tmp_path / "a.rrd")
    assert "/bev/target/relief" in found
    assert "/bev/source/relief" not in found


def test_a_recording_nobody_used_is_still_whole(tmp_path):
    recorder = RerunRecorder(tmp_path / "a.rrd")
    recorder.close()
    recorder.close()
    assert (tmp_path / "a.rrd").stat().st_size > 0
    with pytest.raises(ValueError, match="closed"):
        recorder.begin({})


def test_an_unwritable_place_is_our_error(tmp_path):
    recorder = RerunRecorder(tmp_path / "no" / "a.rrd")
    recorder.begin({})
    with pytest.raises(OutputError, match="cannot write the recording"):
        recorder.close()


def test_the_run_is_told_of_a_fault_in_the_writer(tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr(writer.RecordingWriter, "after", fail)
    recorder = RerunRecorder(tmp_path / "a.rrd")
    recorder.begin({})
    recorder.after("mtpcr.bev", "bev", {}, None, 0.1)
    with pytest.raises(ZeroDivisionError, match="planted"):
        recorder.close()


def test_a_process_of_its_own_records_the_same(tmp_path):
    pair = make_pair(800)
    # a matcher may hold what cannot be sent
    assert pair.matches is not None
    pair = pair.with_(matches=dataclasses.replace(pair.matches, matcher=lambda: None))
    record(tmp_path / "a.rrd", pair)
    record(tmp_path / "b.rrd", pair, apart=True)
    assert entities(tmp_path / "a.rrd") == entities(tmp_path / "b.rrd")
    for entity in sorted(entities(tmp_path / "a.rrd")):
        if not entity.startswith("/__"):
            assert rows_without_ids(tmp_path / "a.rrd", entity) == rows_without_ids(
                tmp_path / "b.rrd", entity
            )


def test_a_fault_in_the_other_process_reaches_the_run(tmp_path):
    recorder = RerunRecorder(tmp_path / "a.rrd", apart=True)
    recorder.begin({})
    no_number: Any = "no number"
    recorder.after("mtpcr.bev", "bev", {}, None, no_number)
    recorder.after("mtpcr.bev", "bev", {}, None, 0.1)
    with pytest.raises(ValueError, match="format code"):
        recorder.close()
    assert not (tmp_path / "a.rrd").exists()


def test_the_other_process_ends_without_a_recording(tmp_path):
    recorder = RerunRecorder(tmp_path / "a.rrd", apart=True)
    recorder.begin({})
    wait([recorder._jobs[0]])
    recorder._writer._process.kill()
    with pytest.raises(OutputError, match="the process that makes it ended with"):
        recorder.close()


def test_an_unwritable_place_is_our_error_from_another_process_too(tmp_path):
    recorder = RerunRecorder(tmp_path / "no" / "a.rrd", apart=True)
    recorder.begin({})
    with pytest.raises(OutputError, match="cannot write the recording"):
        recorder.close()


def test_the_other_process_ends_with_the_run(tmp_path):
    code = (
        "import sys, os; from mtpcr_geo.export.recording.recorder import RerunRecorder;"
        "recorder = RerunRecorder(sys.argv[1], apart=True); recorder.begin({});"
        "[job.result() for job in recorder._jobs]; print(recorder._writer._process.pid, flush=True);"
        "os._exit(9)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.rrd"],
        stdout=subprocess.PIPE,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 9
    assert not (tmp_path / "a.rrd").exists()
    assert ended(int(done.stdout))


def run_as_command(code: str, *arguments: object) -> str:
    """Run Python code in a process that counts as the command, and return what it prints."""
    head = (
        "import sys; sys.argv[0] = '/usr/bin/mtpcr-geo'\n"
        "from mtpcr_geo.export.recording import process; process.usable_cores = lambda: 2\n"
    )
    command = [sys.executable, "-c", head + code, *map(str, arguments)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60, check=True).stdout


def test_a_process_started_ahead_draws_the_recording(tmp_path):
    code = (
        "process.start_ahead(); pid = process._waiting.process.pid\n"
        "from mtpcr_geo.export.recording.recorder import RerunRecorder\n"
        "recorder = RerunRecorder(sys.argv[1]); recorder.begin({}); recorder._jobs[0].result()\n"
        "print(pid == recorder._writer._process.pid); recorder.close(); print('rerun' in sys.modules)"
    )
    assert run_as_command(code, tmp_path / "a.rrd").split() == ["True", "False"]
    assert (tmp_path / "a.rrd").stat().st_size > 0


def test_a_process_started_ahead_that_has_ended_is_replaced():
    code = (
        "process.start_ahead(); one = process._waiting; one.process.kill(); one.process.wait()\n"
        "other = process.started(); print(other.process.poll() is None); other.discard()"
    )
    assert run_as_command(code) == "True\n"


def test_a_process_started_ahead_uses_no_more_cores_than_the_run():
    code = (
        "process.usable_cores = lambda: 8; process.start_ahead(2)\n"
        "path = f'/proc/{process._waiting.process.pid}/environ'\n"
        # empty until the program is loaded
        "while not (environment := open(path).read()): pass\n"
        "print([one for one in environment.split(chr(0)) if one.endswith('_NUM_THREADS=2')])"
    )
    if not Path("/proc/self/environ").exists():
        pytest.skip("the system does not show a process's environment")
    assert run_as_command(code).count("_NUM_THREADS=2") == 4


def test_a_process_started_ahead_in_vain_ends_with_the_run():
    assert ended(int(run_as_command("process.start_ahead(); print(process._waiting.process.pid)")))


@pytest.mark.parametrize(
    ("argv", "executable", "cores", "apart"),
    [
        (["/usr/bin/mtpcr-geo", "register"], "/usr/bin/python3.11", 2, True),
        (["/usr/bin/mtpcr-geo", "register"], "/usr/bin/python3.11", 1, False),
        (["/usr/bin/mtpcr-geo", "register"], "/opt/qgis/bin/qgis-bin.exe", 2, False),
        (["notebook.py"], "/usr/bin/python3.11", 2, False),
    ],
)
def test_only_a_command_draws_in_another_process(monkeypatch, argv, executable, cores, apart):
    monkeypatch.setattr(sys, "argv", argv)
    monkeypatch.setattr(sys, "executable", executable)
    monkeypatch.setattr(process_module, "usable_cores", lambda: cores)
    monkeypatch.setattr(recorder_module, "_opened", False)
    monkeypatch.delitem(sys.modules, "rerun")
    assert recorder_module._pays_apart() is apart
    # rerun will be needed again, and pays once for all
    assert recorder_module._pays_apart() is False


def test_importing_the_recorder_does_not_import_rerun():
    code = "import sys, mtpcr_geo.export.recording.recorder; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


def test_null_recorder_keeps_nothing():
    recorder: Recorder = NullRecorder()
    recorder.begin({})
    recorder.after("mtpcr.bev", "bev", {}, None, 0.1)
    recorder.close()
