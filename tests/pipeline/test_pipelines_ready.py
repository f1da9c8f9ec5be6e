"""Every ready pipeline, on real data: with PDAL, and without it those that need none."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers_paths import REPOSITORY
from typer.testing import CliRunner

import mtpcr_geo
from mtpcr_geo.cli.app import app
from mtpcr_geo.pipeline.pdal import bindings

READY = sorted(path.stem for path in (REPOSITORY / "pipelines").glob("*.json"))
NEEDS_PDAL = {"clean_then_register"}


def run(name: str, folder):
    text = (REPOSITORY / "pipelines" / f"{name}.json").read_bytes()
    if name == "bev_only":
        changes = [f"--cloud.filename={folder / 'target.laz'}"]
    else:
        changes = [f"--target.filename={folder / 'target.laz'}", f"--source.filename={folder / 'source.laz'}"]
    if name == "paper":
        # its own matcher needs files that nobody may pass on
        changes.append("--match.method=rootsift")
    pipeline = mtpcr_geo.Pipeline(text, changes)
    pipeline.validate()
    pipeline.execute()
    return pipeline


def test_every_ready_pipeline_begins_by_saying_what_it_does_and_how_to_run_it():
    assert READY
    for name in READY:
        text = (REPOSITORY / "pipelines" / f"{name}.json").read_text(encoding="utf-8")
        assert text.startswith("// ")
        assert f"mtpcr-geo pipeline pipelines/{name}.json" in text


def shown() -> list[str]:
    """The commands that pipelines/README.md shows for the demonstration's clouds."""
    text = (REPOSITORY / "pipelines" / "README.md").read_text(encoding="utf-8")
    return [
        line for line in text.splitlines() if line.startswith("mtpcr-geo pipeline ") and "mtpcr-demo/" in line
    ]


@pytest.fixture
def demo_clouds(tmp_path, monkeypatch):
    """The clouds where `mtpcr-geo demo` leaves them, and the pipelines beside them."""
    shutil.copytree(REPOSITORY / "mtpcr_geo" / "cli" / "demo_clouds", tmp_path / "mtpcr-demo")
    shutil.copytree(REPOSITORY / "pipelines", tmp_path / "pipelines")
    monkeypatch.chdir(tmp_path)


def call(line: str, *more: str):
    name = Path(next(word for word in shlex.split(line) if word.endswith(".json"))).stem
    if name in NEEDS_PDAL and not bindings.available():
        pytest.skip("this pipeline needs PDAL, and says so")
    return CliRunner().invoke(app, [*shlex.split(line)[1:], *more])


def test_every_ready_pipeline_is_shown_with_the_demonstrations_clouds():
    assert sorted(Path(shlex.split(line)[3 if " -i " in line else 2]).stem for line in shown()) == READY


@pytest.mark.parametrize("line", shown())
def test_what_is_shown_is_valid(line, demo_clouds):
    done = call(line, "--validate")
    assert (done.exit_code, done.stdout) == (0, "the pipeline is valid\n"), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("line", shown())
def test_what_is_shown_runs(line, demo_clouds, tmp_path):
    done = call(line)
    # the paper's images show too little here, and the verdict says so
    assert done.exit_code in ((3, 4) if "paper" in line else (0,)), done.stderr
    assert (tmp_path / "out").is_dir()


@pytest.mark.slow
@pytest.mark.parametrize("pdal_there", [True, False])
@pytest.mark.parametrize("name", READY)
def test_on_real_data(name, pdal_there, shared_data, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    if pdal_there:
        request.getfixturevalue("pdal")
    elif name in NEEDS_PDAL:
        pytest.skip("this pipeline needs PDAL, and says so")
    else:
        monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    pipeline = run(name, shared_data / "coast_town_sparse_ign382")
    assert all(path.exists() for path in pipeline.outputs)
    if name == "bev_only":
        assert (tmp_path / "out" / "bev.tif").exists()
        return
    if name == "paper":
        # what the paper's images show is not enough here; the run is whole all the same
        assert pipeline.verdict is not None
        return
    assert pipeline.verdict.name == "accepted"
    # the clouds share their frame, so the true transform changes nothing
    xyz = next(iter(pipeline.pair.source.cloud.xyz_chunks()))
    work = pipeline.pair.source.link.to_work(xyz)
    moved = work @ pipeline.pair.T_target_source[:3, :3].T + pipeline.pair.T_target_source[:3, 3]
    error = pipeline.pair.target.link.to_file(moved) - xyz
    assert np.linalg.norm(error.mean(axis=0)) < 0.3
