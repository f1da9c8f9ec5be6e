"""Surveys and batches on worker processes, some of which are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from helpers_survey import digests, tiles_of, town_source, town_target, write_tile

from mtpcr_geo.survey.batch import run_batch
from mtpcr_geo.survey.build import build_survey
from mtpcr_geo.survey.jobs import jobs_of
from mtpcr_geo.survey.options import BatchOptions, BuildOptions

pytest.importorskip("distributed", reason="Dask is not installed")
psutil = pytest.importorskip("psutil", reason="psutil, which Dask brings, is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups"),
]

LONGEST_S = 900.0


def start(*arguments: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "mtpcr_geo", *(str(argument) for argument in arguments)]
    return subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE)


def wait_for(process: subprocess.Popen[bytes], pattern: str, folder: Path, count: int) -> None:
    """Wait until some files are there, or the process has ended."""
    end = time.monotonic() + LONGEST_S
    while len(list(folder.glob(pattern))) < count and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_two_workers_killed_and_resumed_give_the_bits_of_one(tmp_path: Path) -> None:
    tiles = [
        one
        for number in range(6)
        for one in tiles_of(tmp_path / f"tiles{number}", town_target(number) + [130.0 * number, 0.0, 0.0])
    ]
    build_survey(tiles, tmp_path / "one", BuildOptions(workers=1, cell=0.25))
    names = [tmp_path / f"tiles{number}" for number in range(6)]
    command = ("survey", "build", *names, "-o", tmp_path / "two", "--workers", 2, "--cell", 0.25)
    process = start(*command)
    wait_for(process, "tiles/*.npz", tmp_path / "two", 5)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert not (tmp_path / "two" / "index.vpc").exists()
    again = start(*command)
    assert again.communicate()[1] == b""
    assert again.returncode == 0
    assert digests(tmp_path / "two") == digests(tmp_path / "one")


def test_a_worker_that_dies_loses_its_job_only(tmp_path: Path) -> None:
    write_tile(tmp_path / "target.laz", town_target(points=30_000))
    scans = tmp_path / "scans"
    scans.mkdir()
    xyz = town_source()[0]
    for number in range(8):
        write_tile(scans / f"scan{number}.laz", xyz[number % 3 :: 3 + number % 2], None)
    command = ("batch", scans, "--target", tmp_path / "target.laz", "--source-crs", "local")
    process = start(*command, "-o", tmp_path / "two", "--workers", 2)
    wait_for(process, "rows/*.json", tmp_path / "two", 2)
    children = psutil.Process(process.pid).children(recursive=True)
    workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    assert process.communicate()[1] == b""
    assert process.returncode == 0
    jobs = jobs_of(scans, tmp_path / "target.laz", {"source_crs": "local"})
    two = run_batch(jobs, tmp_path / "two", BatchOptions(workers=1))
    assert two.run == 0
    one = run_batch(jobs, tmp_path / "one", BatchOptions(workers=1))
    assert [row.name for row in two.rows] == [row.name for row in one.rows]
    for left, right in zip(two.rows, one.rows, strict=True):
        assert left.verdict == right.verdict == "accepted"
        np.testing.assert_array_equal(left.T_target_source, right.T_target_source)
