"""Surveys and batches on a running scheduler, whose workers run in a folder of their own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers_survey import digests, tiles_of, town_source, town_target, write_tile

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.survey.batch import run_batch
from mtpcr_geo.survey.build import build_survey
from mtpcr_geo.survey.engine import engine_of
from mtpcr_geo.survey.jobs import Job
from mtpcr_geo.survey.options import BatchOptions, BuildOptions, EngineOptions

distributed = pytest.importorskip("distributed", reason="Dask is not installed")
pytestmark = pytest.mark.slow

FOLDER_OF_THE_PROCESS = Path("/proc/self/cwd")
"""A path that is absolute, and another folder for each process, as on a machine that shares no disk."""
needs_proc = pytest.mark.skipif(not FOLDER_OF_THE_PROCESS.is_dir(), reason="needs /proc")


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a scheduler with one worker, which runs elsewhere than the tests do."""
    here = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    try:
        cluster = distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        )
    finally:
        os.chdir(here)
    with cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clouds")
    tiles_of(folder / "tiles", town_target(points=20_000))
    write_tile(folder / "scan.laz", town_source()[0][::2], None)
    return folder


def test_relative_paths_are_those_of_the_command(
    scheduler: str, clouds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clouds").symlink_to(clouds)
    made = build_survey(["clouds/tiles"], "survey", BuildOptions(scheduler=scheduler, cell=0.5))
    assert made.survey.folder == tmp_path / "survey"
    build_survey(["clouds/tiles"], "again", BuildOptions(workers=1, cell=0.5))
    assert digests(tmp_path / "survey") == digests(tmp_path / "again")
    assert str(tmp_path) not in (tmp_path / "survey" / "index.vpc").read_text(encoding="utf-8")

    job = Job("scan", Path("clouds/scan.laz"), Path("survey"), {"source_crs": "local"})
    row = run_batch([job], "batch", BatchOptions(scheduler=scheduler)).rows[0]
    assert row.verdict == "accepted", row.reason
    assert row.source == str(tmp_path / "clouds" / "scan.laz")
    assert (tmp_path / "batch" / row.folder / "run.json").is_file()
    assert (tmp_path / "batch" / "rows" / "scan.json").is_file()


@needs_proc
def test_workers_that_see_other_folders_are_told(
    scheduler: str, clouds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = FOLDER_OF_THE_PROCESS / f"of_{tmp_path.name}"
    # the tests run in the repository, where nothing is to be left
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="must see the same folders"):
        build_survey([clouds / "tiles"], folder, BuildOptions(scheduler=scheduler, cell=0.5))
    assert not (folder / "index.vpc").exists()

    job = Job("scan", clouds / "scan.laz", clouds / "tiles" / "tile0.laz", {"source_crs": "local"})
    row = run_batch([job], folder / "batch", BatchOptions(scheduler=scheduler)).rows[0]
    assert (row.verdict, row.folder) == ("failed", "")
    assert "must see the same folders" in row.reason
    assert (folder / "batch" / "rows" / "scan.json").is_file()


def test_two_runs_of_one_machine_do_not_want_the_same_port() -> None:
    """A warning of the second is an error here."""
    options = EngineOptions(workers=2)
    with engine_of(options, 2) as one, engine_of(options, 2) as other:
        assert one is not other
