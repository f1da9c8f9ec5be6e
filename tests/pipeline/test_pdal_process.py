"""PDAL's crashes are errors of ours: a process of its own, from which nothing is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_security import write_ept
from typer.testing import CliRunner

import mtpcr_geo
from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.pipeline.pdal import process
from mtpcr_geo.pipeline.pdal.switches import Access

POLYGON = {"type": "Polygon", "coordinates": [[[0, 0], [5, 0], [5, 5], [0, 0]]]}
FAUX = {"type": "readers.faux", "bounds": "([0, 9], [0, 9], [0, 9])", "mode": "constant", "tag": "made"}


def features(geometry: Any) -> str:
    one = {"type": "Feature", "properties": {"c": 1}, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [one]})


def newer(pdal: Any) -> bool:
    """Return whether this PDAL is not the one whose crashes these are."""
    return not pdal.__version__.endswith("pdal2.2.0")


CRASHES: dict[str, Any] = {
    "crop by nothing": {"type": "filters.crop", "polygon": "POLYGON EMPTY"},
    "overlay without a shape": {
        "type": "filters.overlay", "dimension": "Classification", "datasource": "none.geojson", "column": "c",
    },
    "ept by a vector file": {"type": "readers.ept", "ogr": {"datasource": "shape.geojson"}},
    "ept by inline GeoJSON": {"type": "readers.ept", "ogr": {"datasource": features(POLYGON)}},
}  # fmt: skip


@pytest.mark.parametrize("name", CRASHES)
def test_a_crash_is_an_error_and_leaves_nothing(name, pdal, town_files, tmp_path, monkeypatch):
    """Each of these ends PDAL 2.2 by a segmentation fault; a PDAL that takes them is as welcome."""
    monkeypatch.chdir(tmp_path)
    stage = dict(CRASHES[name])
    Path("none.geojson").write_text(features(None))
    Path("shape.geojson").write_text(features(POLYGON))
    if stage["type"] == "readers.ept":
        stages: list[Any] = [{**stage, "filename": str(write_ept(tmp_path / "ept"))}]
    else:
        stages = [str(town_files[1]), stage]
    Path("p.json").write_text(json.dumps([*stages, {"type": "writers.las", "filename": "out/o.laz"}]))
    before = sorted(tmp_path.rglob("*"))
    for arguments in (["--validate"], []):
        result = CliRunner().invoke(app, ["pipeline", "p.json", *arguments])
        assert "Traceback" not in result.output
        assert result.exception is None or isinstance(result.exception, SystemExit)
        if not newer(pdal) and not arguments:
            assert result.exit_code == InputError.exit_code
            assert "PDAL crashed (Segmentation fault, SIGSEGV), and nothing of it is kept" in result.stderr
        if result.exit_code:
            assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc and SIGKILL")
def test_after_a_crash_the_next_run_works(pdal, town_files):
    with pytest.raises(InputError, match="PDAL crashed"):
        _killed_while_streaming()
    pipeline = mtpcr_geo.Pipeline([str(town_files[1]), {"type": "filters.range", "limits": "Z[0:1000]"}])
    assert pipeline.execute() == len(np.concatenate(pipeline.arrays)) > 0


def _killed_while_streaming() -> None:
    from mtpcr_geo.pipeline.pdal.cloud import _blamed

    run = {"do": "run", "stages": [{**FAUX, "count": 10**9}], "size": 1000, "crs": False}
    with _blamed([]):
        for count, answer in enumerate(process.ask(Access(), **run)):
            if count == 5:
                (child,) = _children()
                os.kill(child, signal.SIGKILL)
            assert count < 10_000
            del answer


def _children() -> list[int]:
    """Return the processes of PDAL that this one has started, by /proc: not every machine has ps."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            # pid (name) state parent ...: the name may hold blanks and brackets
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
            line = stat.with_name("cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(parent) == os.getpid() and state != "Z" and b"pdal.worker" in line:
            found.append(int(stat.parent.name))
    return sorted(found)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc and SIGKILL")
def test_who_stops_taking_points_ends_the_process(pdal):
    process.end_waiting()
    run = {"do": "run", "stages": [{**FAUX, "count": 10**9}], "size": 1000, "crs": False}
    answers = process.ask(Access(), **run)
    next(answers)
    assert len(_children()) == 1
    answers.close()
    assert _children() == []
    # one that has answered waits for the next question, until the run ends
    process.done(Access(), do="drivers")
    first = _children()
    process.done(Access(), do="drivers")
    assert _children() == first
    process.done(Access(network=True), do="drivers")
    assert len(_children()) == 1, "one with other rights would wait for ever"
    assert _children() != first
    process.end_waiting()
    assert _children() == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc and SIGKILL")
def test_pdal_does_not_outlive_a_killed_run(pdal, tmp_path):
    """Nobody tells the process that the run is gone: its input ends."""
    code = (
        "import json, os, signal\n"
        "from mtpcr_geo.pipeline.pdal import process\n"
        "from mtpcr_geo.pipeline.pdal.switches import Access\n"
        f"stages = [{{**{FAUX!r}, 'count': 10**7}}, {{'type': 'filters.outlier', 'mean_k': 64}}]\n"
        "one = process._WAITING.take(Access(code=True))\n"
        "list(one.ask({'do': 'drivers'}))\n"
        "print(one._popen.pid, flush=True)\n"
        "question = {'do': 'execute', 'stages': stages, 'crs': False}\n"
        "one._questions.write(json.dumps(question).encode() + b'\\n')\n"
        "one._questions.flush()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    # where code is allowed, PDAL's process shares the standard error: only its end ends that, and it has
    # many minutes to go
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert run.returncode == -signal.SIGKILL, run.stderr
    assert run.stdout.strip().isdecimal()


def test_nothing_is_imported_from_the_current_folder(pdal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("json", "numpy", "pdal", "queue", "sitecustomize"):
        Path(f"{name}.py").write_text("open('ran', 'w')\nraise SystemExit(1)\n")
    process.end_waiting()
    assert process.done(Access(), do="drivers")["drivers"]
    assert not Path("ran").exists()
    process.end_waiting()


@pytest.mark.parametrize("how", ["validate", "execute"])
def test_ept_of_a_folder(how, pdal, tmp_path):
    with pytest.raises(InputError, match=r"is a folder; name the ept\.json in it"):
        getattr(mtpcr_geo.Pipeline([{"type": "readers.ept", "filename": str(tmp_path)}]), how)()


def test_a_request_for_more_memory_than_there_is_is_an_error(pdal, tmp_path):
    """PDAL 2.2 asks for as much as a folder's size seems to be."""
    stage = {"type": "readers.ept", "filename": str(tmp_path)}
    words = "" if newer(pdal) else "more memory is asked for than there is"
    with pytest.raises(process.PdalError, match=words):
        process.done(Access(), do="execute", stages=[stage], crs=False)
