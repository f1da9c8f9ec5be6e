"""Runs into one folder at a time, and runs killed at random moments: one set or the other, no mixture."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import helpers_fuzz as fuzz
import numpy as np
import pytest

from mtpcr_geo.io.las import open_cloud

WRITER = """
import sys
from pathlib import Path
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.io.outputs import OutputSet
place, mark = Path(sys.argv[1]), sys.argv[2]
for _ in range(int(sys.argv[3])):
    with OutputSet(overwrite=True) as outputs:
        for name in ("a.txt", "sub/b.txt", f"only-{mark}.txt"):
            outputs.path(place / name).write_text(mark * 2000)
        outputs.replace([place / f"only-{other}.txt" for other in "xy" if other != mark])
        outputs.commit()
"""


@pytest.mark.skipif(os.name == "nt", reason="open files are locked there")
def test_two_runs_into_one_folder(tmp_path):
    (tmp_path / "sub").mkdir()
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, tmp_path, mark, "30"], stderr=subprocess.PIPE, text=True
        )
        for mark in "xy"
    ]
    for run in runs:
        _, errors = run.communicate()
        assert run.returncode == 0, errors
    for name in ("a.txt", "sub/b.txt"):
        text = (tmp_path / name).read_text()
        assert text in ("x" * 2000, "y" * 2000), "half written"
    left = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert left <= {"a.txt", "b.txt", "only-x.txt", "only-y.txt"}


@pytest.mark.skipif(os.name == "nt", reason="needs signals")
@pytest.mark.parametrize("kills", [4, pytest.param(100, marks=pytest.mark.slow)])
def test_killed_at_random_moments(kills, tmp_path):
    """`apply --overwrite` of a larger cloud over an earlier output: the old file or the new one, whole."""
    seed = 15
    print(f"seed {seed}")
    rng = random.Random(seed)
    fuzz.write_still(tmp_path / "t.json")
    fuzz.write_las(tmp_path / "old.laz", "1.4", 6)
    many = np.tile(fuzz.cloud_xyz(), (500, 1))
    source = tmp_path / "source.npy"
    np.save(source, many)
    out = tmp_path / "out"
    out.mkdir()
    command = [sys.executable, "-m", "mtpcr_geo", "apply", tmp_path / "t.json", source, out / "o.laz", "-q"]

    def run() -> subprocess.Popen[bytes]:
        return subprocess.Popen([*command, "--overwrite"], stderr=subprocess.DEVNULL)

    start = time.monotonic()
    shutil.copy(tmp_path / "old.laz", out / "o.laz")
    assert run().wait() == 0
    whole = time.monotonic() - start
    states = set()
    for _ in range(kills):
        shutil.copy(tmp_path / "old.laz", out / "o.laz")
        process = run()
        try:
            process.wait(timeout=rng.uniform(0, 1.1 * whole))
        except subprocess.TimeoutExpired:
            process.send_signal(rng.choice([signal.SIGTERM, signal.SIGINT, signal.SIGKILL]))
        code = process.wait()
        count = open_cloud(out / "o.laz").count
        assert count in (fuzz.N, len(many)), "a mixture"
        assert code != 0 or count == len(many), "exit 0 without the result"
        assert sum(len(xyz) for xyz in open_cloud(out / "o.laz").xyz_chunks()) == count
        states.add(count)
    assert run().wait() == 0
    assert [path.name for path in out.iterdir()] == ["o.laz"], "something of a killed run is left"
    assert open_cloud(out / "o.laz").count == len(many)
    assert states <= {fuzz.N, len(many)}
