"""The benchmark of surveys: a small region, built thrice, and a scan found in it."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from mtpcr_geo.benchmark.survey import report, run_survey
from mtpcr_geo.core.errors import OptionError


@pytest.mark.slow
def test_a_small_region_is_built_and_searched(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    told = run_survey(0.5, 1, tmp_path, seed=3)
    with (tmp_path / "places.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["near"] for row in rows] == ["False", "True"]
    assert all(row["right"] == "True" or row["verdict"] != "accepted" for row in rows)
    with (tmp_path / "jobs.csv").open(newline="", encoding="utf-8") as file:
        jobs = {row["job"]: row["same"] for row in csv.DictReader(file)}
    assert jobs == {
        "build, 1 worker": "",
        "build, 2 workers": "True",
        "build, 2 workers, killed and resumed": "True",
    }
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.csv")}
    assert run_survey(0.5, 1, tmp_path, seed=3) == told
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.csv")} == before


def test_a_report_names_what_is_wrong() -> None:
    row = {"near": "False", "wall_s": "3.0", "cpu_s": "4.0", "peak_mib": "100", "plan_m": "12.0"}
    rows = [
        {**row, "right": "False", "verdict": "accepted"},
        {**row, "right": "True", "verdict": "accepted", "plan_m": "0.1"},
    ]
    jobs = [{"job": "build", "wall_s": "1.0", "same": "False"}]
    told = report(jobs, rows)
    assert "build: 1.0 s, NOT the same" in told
    assert "anywhere: 1 of 2 right, 2 accepted, 1 accepted wrongly; 0.100 m off" in told


@pytest.mark.parametrize("edge", [0.1, 60.0])
def test_a_size_of_no_use_is_refused(edge: float, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="kilometres"):
        run_survey(edge, 1, tmp_path)
