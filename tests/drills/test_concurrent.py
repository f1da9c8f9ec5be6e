"""Runs into one folder at a time, and runs killed at random moments: one set or the other, no mixture."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import helpers_fuzz as fuzz
import numpy as np
import pytest

from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.outputs import OutputSet

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


def set_in(folder: Path) -> dict[str, bytes]:
    """Return the files of a run, but for the hidden ones that a killed run leaves to the next."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="needs signals")
@pytest.mark.parametrize("kills", [10])
def test_a_registration_killed_at_random_moments(kills, town_files, tmp_path):
    """`register --overwrite` over the set of an earlier run: the old set or a new one, whole."""
    seed = 16
    print(f"seed {seed}")
    rng = random.Random(seed)
    out, old = tmp_path / "out", tmp_path / "old"
    command = [sys.executable, "-m", "mtpcr_geo", "register", *map(str, town_files), "-q", "--no-recording"]

    def run(folder: Path, *more: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([*command, "-o", str(folder), *more], stderr=subprocess.DEVNULL)

    # the earlier run had cells of its own, and a file that the next does not write
    assert run(old, "--cell", "1.5", "--also", "ply").wait() == 0
    before = set_in(old)
    start = time.monotonic()
    assert run(tmp_path / "new").wait() == 0
    whole = time.monotonic() - start
    wanted = set_in(tmp_path / "new")
    names = set(wanted)
    assert names < set(before)
    ends = set()
    for _ in range(kills):
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(old, out)
        process = run(out, "--overwrite")
        try:
            # a good half of them near the end, where the set is put in place
            process.wait(timeout=whole * rng.choice([rng.uniform(0, 1), rng.uniform(0.85, 1.05)]))
        except subprocess.TimeoutExpired:
            process.send_signal(rng.choice([signal.SIGTERM, signal.SIGINT, signal.SIGKILL]))
        code = process.wait()
        # whoever comes next finishes or forgets what was begun
        with OutputSet(overwrite=True) as outputs:
            for name in before:
                outputs.check(out / name)
        left = set_in(out)
        new = left != before
        if new:
            assert set(left) == names, "what the earlier run alone had written is left"
            for name in ("transform.cloudcompare.txt", "bev/source.tif", "bev/target.tif"):
                assert left[name] == wanted[name] != before[name], "a mixture"
        assert code != 0 or new, "exit 0 without the result"
        ends.add(new)
    assert run(out, "--overwrite").wait() == 0
    hidden = [path.name for path in out.rglob(".*")]
    assert not hidden, "something of a killed run is left"
    assert False in ends
