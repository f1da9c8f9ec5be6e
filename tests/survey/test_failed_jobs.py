"""What a batch says and leaves of a job that came to no result."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers_survey import town_source, town_target, write_tile

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.survey.batch import Row, run_batch
from mtpcr_geo.survey.build import build_survey
from mtpcr_geo.survey.engine import Engine
from mtpcr_geo.survey.jobs import Job
from mtpcr_geo.survey.options import BatchOptions, BuildOptions

HERE = BatchOptions(workers=1)
LOCAL = {"source_crs": "local"}


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with clouds and a batch of one job, accepted."""
    folder = tmp_path_factory.mktemp("done")
    write_tile(folder / "target.laz", town_target(points=30_000))
    (folder / "scans").mkdir()
    for number in range(2):
        write_tile(folder / "scans" / f"scan{number}.laz", town_source()[0][number::2], None)
    assert one_job(folder, folder / "scans").verdict == "accepted"
    return folder


@pytest.fixture
def copied(done: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(done, tmp_path / "copy"))


def one_job(folder: Path, source: Path, target: Path | None = None, **options: object) -> Row:
    job = Job("scan", source, target or folder / "target.laz", LOCAL | options)
    return run_batch([job], folder / "batch", HERE).rows[0]


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_a_failed_job_leaves_no_result_of_another_input(copied: Path) -> None:
    made = copied / "batch" / "jobs" / "scan"
    assert {"run.json", "transform.json", "registered/scan0.laz"} <= files_below(made)
    (made / "notes.txt").write_text("mine")
    (made / "registered" / "mine.laz").write_text("mine too")
    (copied / "broken.laz").write_bytes((copied / "target.laz").read_bytes()[:5000])
    row = one_job(copied, copied / "broken.laz")
    assert (row.verdict, row.folder) == ("failed", "")
    assert files_below(made) == {"notes.txt", "registered/mine.laz"}
    assert "jobs/scan" not in (copied / "batch" / "batch.csv").read_text(encoding="utf-8")


def test_where_nothing_else_lies_the_folder_goes_too(copied: Path) -> None:
    (copied / "broken.laz").write_bytes((copied / "target.laz").read_bytes()[:5000])
    row = one_job(copied, copied / "broken.laz")
    assert (row.verdict, row.folder) == ("failed", "")
    assert not (copied / "batch" / "jobs" / "scan").exists()


def test_what_a_drive_holds_that_is_not_there_costs_no_result(copied: Path) -> None:
    before = files_below(copied / "batch" / "jobs" / "scan")
    (copied / "scans").rename(copied / "elsewhere")
    row = one_job(copied, copied / "scans")
    assert (row.verdict, row.folder) == ("failed", "")
    assert files_below(copied / "batch" / "jobs" / "scan") == before
    (copied / "elsewhere").rename(copied / "scans")
    assert one_job(copied, copied / "scans").verdict == "accepted"


def test_a_prior_in_the_folder_of_the_job_is_not_removed(copied: Path) -> None:
    prior = copied / "batch" / "jobs" / "scan" / "transform.json"
    row = one_job(copied, copied / "scans", prior=str(prior))
    assert row.verdict == "failed"
    assert prior.is_file()


@pytest.mark.parametrize("name", ["../scan", "/scan", "a b", ""])
def test_a_job_is_called_as_a_folder_may_be(tmp_path: Path, name: str) -> None:
    job = Job(name, tmp_path / "s.laz", tmp_path / "t.laz", {})
    with pytest.raises(OptionError, match="can be called"):
        run_batch([job], tmp_path / "batch", HERE)


def test_a_job_that_a_survey_has_no_place_for_leaves_none_either(copied: Path) -> None:
    survey = build_survey([copied / "target.laz"], copied / "survey", BuildOptions(workers=1)).survey
    flat = np.random.default_rng(0).uniform([0, 0, 0], [4, 4, 0.01], (500, 3))
    corner = tuple(survey.bounds[0, :2])
    source = write_tile(copied / "flat.laz", flat, None)
    row = one_job(copied, source, survey.folder, near=corner, within=1.0)
    assert (row.verdict, row.folder, row.T_target_source) == ("refused", "", ())
    assert not (copied / "batch" / "jobs" / "scan").exists()


def test_what_a_job_reads_is_never_removed(copied: Path) -> None:
    own = copied / "batch" / "jobs" / "scan" / "registered" / "scan0.laz"
    (copied / "broken.laz").write_bytes((copied / "target.laz").read_bytes()[:5000])
    row = one_job(copied, own, copied / "broken.laz")
    assert row.verdict == "failed"
    assert own.is_file()
    assert not (own.parent / "scan1.laz").exists()


def test_a_defect_fails_its_job_alone(done: Path, tmp_path: Path) -> None:
    target = done / "target.laz"
    jobs = [
        Job("odd", done / "scans" / "scan0.laz", target, {"progress": "no progress at all"}),
        Job("none", done / "none.laz", target, {}),
    ]
    odd, none = run_batch(jobs, tmp_path / "batch", HERE).rows
    assert odd.verdict == none.verdict == "failed"
    assert odd.reason.startswith("a defect: AttributeError")
    assert "there is no file" in none.reason
    assert "Error" not in none.reason
    assert (tmp_path / "batch" / "rows" / "odd.json").is_file()


def test_a_piece_of_work_that_fails_says_where() -> None:
    first, second = Engine().run(reciprocal, [0, 2])
    assert first.made is None
    assert first.error is not None
    assert first.error.startswith("a defect: ZeroDivisionError")
    assert "test_failed_jobs.py, line" in first.error
    assert (second.made, second.error) == (0.5, None)


def reciprocal(number: int) -> float:
    return 1 / number
