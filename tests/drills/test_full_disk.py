"""A disk that is full: one line, its own exit code, and nothing half written."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mtpcr_geo.core.errors import OutputError

SIZES_KB = (16, 400, 1500, 3000)
"""Room that ends in the first file of the set, in its rasters, in its recording, and late."""


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on which a small disk can be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    yield folder
    subprocess.run(["umount", str(folder)], capture_output=True, check=False)


def mounted(folder: Path, size_kb: int) -> None:
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root of Linux mounts a small disk")
    try:
        command = ["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", str(folder)]
        subprocess.run(command, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"a small disk cannot be mounted here: {error}")


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mtpcr_geo", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.slow
@pytest.mark.parametrize("size_kb", SIZES_KB)
def test_registering_onto_a_full_disk_leaves_nothing(disk: Path, size_kb: int, town_files) -> None:
    mounted(disk, size_kb)
    source, target = town_files
    ended = run("register", source, target, "-o", disk / "out", "-q")
    assert ended.returncode == OutputError.exit_code, ended.stderr
    told = ended.stderr.strip().splitlines()
    assert len(told) == 1, ended.stderr
    assert told[0].startswith("mtpcr-geo: error: ")
    assert ended.stdout == ""
    assert not [path for path in disk.rglob("*") if path.is_file()]


@pytest.mark.slow
def test_applying_onto_a_full_disk_keeps_what_was_there(disk: Path, tmp_path: Path, town_files) -> None:
    source, target = town_files
    out = tmp_path / "out"
    assert run("register", source, target, "-o", out, "-q", "--no-recording").returncode == 0
    mounted(disk, 64)
    moved = disk / "moved.laz"
    moved.write_bytes(b"what an earlier run left")
    ended = run("apply", out / "transform.json", source, moved, "--overwrite", "-q")
    assert ended.returncode == OutputError.exit_code, ended.stderr
    assert len(ended.stderr.strip().splitlines()) == 1, ended.stderr
    assert moved.read_bytes() == b"what an earlier run left"
    assert [path.name for path in disk.iterdir()] == ["moved.laz"]
