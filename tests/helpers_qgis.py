"""QGIS of the system, as a program of its own: its modules belong to the system's Python."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

WHY_NOT = "QGIS is not installed (Debian: apt-get install qgis python3-qgis qgis-providers)"
# an environment of Python's would give QGIS modules that are not its own
PATH = os.pathsep.join(["/usr/bin", "/bin", "/usr/local/bin"])


def environment(home: Path, **more: str) -> dict[str, str]:
    """Return a bare environment for QGIS, with its settings in a folder of the test's."""
    home.mkdir(mode=0o700, exist_ok=True)
    kept = {name: os.environ[name] for name in ("TMPDIR", "LD_LIBRARY_PATH") if name in os.environ}
    return {
        **kept,
        "PATH": PATH,
        "HOME": str(home),
        "XDG_RUNTIME_DIR": str(home),
        "LANG": "C.UTF-8",
        "QT_QPA_PLATFORM": "offscreen",
        **more,
    }


@cache
def python() -> str | None:
    """Return the Python that has QGIS's modules, or None."""
    for name in ("python3", "python"):
        found = shutil.which(name, path=PATH)
        if found is None:
            continue
        try:
            done = subprocess.run(
                [found, "-c", "import qgis.core"],
                env={"PATH": PATH},
                capture_output=True,
                timeout=120,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0:
            return found
    return None


@cache
def qgis_process() -> str | None:
    """Return QGIS's command for algorithms, or None.

    Debian's `qgis_process` is a script that hands on an option which the program behind it refuses.
    """
    return next(
        (path for name in ("qgis_process.bin", "qgis_process") if (path := shutil.which(name, path=PATH))),
        None,
    )


def ask(script: str, home: Path, *words: str) -> dict[str, Any]:
    """Run a script in QGIS's Python; it has `qgis.core`, `answer` (a dict) and sys.argv; return the answer.

    Skips the test where QGIS is not installed.
    """
    found = python()
    if found is None:
        pytest.skip(WHY_NOT)
    whole = f"{_BEFORE}\n{script}\n{_BEHIND}"
    done = subprocess.run(
        [found, "-c", whole, *words],
        env=environment(home),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    marked = [line for line in done.stdout.splitlines() if line.startswith(_MARK)]
    assert marked, f"{done.returncode}: {done.stdout[-2000:]}{done.stderr[-4000:]}"
    return dict(json.loads(marked[-1][len(_MARK) :]))


def process(words: list[str], home: Path, plugins: Path) -> subprocess.CompletedProcess[str]:
    """Call qgis_process with a folder of plugins; the command that they call is this Python's."""
    found = qgis_process()
    if found is None or python() is None:
        pytest.skip(WHY_NOT)
    command = Path(sys.executable).with_name("mtpcr-geo")
    if not command.is_file():
        pytest.skip("the command mtpcr-geo is not installed beside this Python")
    kept = {name: os.environ[name] for name in ("PYTHONPATH", "OMP_NUM_THREADS") if name in os.environ}
    more = {"QGIS_PLUGINPATH": str(plugins), "MTPCR_GEO_COMMAND": str(command), **kept}
    return subprocess.run(
        [found, *words],
        env=environment(home, **more),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


_MARK = "answer: "
_BEFORE = """
import json, os, sys
from qgis.core import *
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor
application = QgsApplication([], False)
application.initQgis()
answer = {}
"""
_BEHIND = f"""
print({_MARK!r} + json.dumps(answer), flush=True)
os._exit(0)
"""
