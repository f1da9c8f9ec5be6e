"""A run that is killed between any two steps of putting its set in place: before or after, never between."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mtpcr_geo.io.outputs import OutputSet

# kills itself at the nth call that changes a folder
CHILD = """
import os, signal, sys
from pathlib import Path
from mtpcr_geo.io.outputs import OutputSet

signal.signal(signal.SIGINT, signal.default_int_handler)  # who starts this in the background has it ignored
place, at, number = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
calls = 0
def counted(function):
    def call(*arguments, **named):
        global calls
        calls += 1
        if calls == at:
            os.kill(os.getpid(), number)
        return function(*arguments, **named)
    return call
with OutputSet(overwrite=True) as outputs:
    for name in ("one.txt", "bev/two.txt", "three.txt"):
        outputs.path(place / name).write_text("new")
    outputs.replace([place / "stale.txt"])
    os.replace, os.unlink, Path.unlink = counted(os.replace), counted(os.unlink), counted(Path.unlink)
    outputs.commit()
print(calls)
"""
BEFORE = {"one.txt": "old", "bev/two.txt": "old", "three.txt": "old", "stale.txt": "old"}
AFTER = {"one.txt": "new", "bev/two.txt": "new", "three.txt": "new"}


def fill(place: Path) -> None:
    for name, text in BEFORE.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)


def found(place: Path) -> dict[str, str]:
    return {str(path.relative_to(place)): path.read_text() for path in place.rglob("*") if path.is_file()}


def run(place: Path, at: int, number: int = signal.SIGTERM) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", CHILD, str(place), str(at), str(int(number))]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM", "SIGINT"])
def test_killed_between_any_two_steps(name, tmp_path):
    number = getattr(signal, name)
    fill(tmp_path / "whole")
    whole = run(tmp_path / "whole", 0)
    assert whole.returncode == 0, whole.stderr
    assert found(tmp_path / "whole") == AFTER
    steps = int(whole.stdout)
    assert steps >= 5
    states = []
    for at in range(1, steps + 1):
        place = tmp_path / str(at)
        fill(place)
        assert run(place, at, number).returncode == -number
        # the next run that writes there, whatever it writes, finishes or forgets what was begun
        with OutputSet(overwrite=True) as outputs:
            for file in ("one.txt", "bev/two.txt", "three.txt"):
                outputs.check(place / file)
        left = {file: text for file, text in found(place).items() if not Path(file).name.startswith(".")}
        assert left in (BEFORE, AFTER), at
        states.append(left == AFTER)
        assert run(place, 0).returncode == 0
        assert found(place) == AFTER, "something of the killed run is left"
    assert states == sorted(states)
    assert {True, False} == set(states)
