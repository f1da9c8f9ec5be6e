"""Modules imported ahead are there when they are needed, and what cannot be imported says so in its place."""

from __future__ import annotations

import importlib
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from mtpcr_geo.core import imports
from mtpcr_geo.core.imports import import_ahead, search_path
from mtpcr_geo.pipeline.registry import stage_types


def test_a_module_imported_ahead_is_the_one_that_is_used(tmp_path, monkeypatch):
    (tmp_path / "needed_soon.py").write_text(
        textwrap.dedent("""
            import threading
            BY = threading.current_thread().name
        """)
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(imports, "usable_cores", lambda: 2)
    import_ahead(["needed_soon_but_not_there", "needed_soon"])
    # the lock of the import makes this wait, or do it
    module = importlib.import_module("needed_soon")
    assert sys.modules["needed_soon"] is module
    with pytest.raises(ModuleNotFoundError, match="needed_soon_but_not_there"):
        importlib.import_module("needed_soon_but_not_there")


def test_with_one_core_nothing_is_imported_ahead(tmp_path, monkeypatch):
    (tmp_path / "not_needed_yet.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(imports, "usable_cores", lambda: 1)
    import_ahead(["not_needed_yet"])
    assert "not_needed_yet" not in sys.modules


def test_what_stages_need_can_be_imported():
    names = {name for stage in stage_types().values() for name in stage.needs}
    assert len(names) >= 8
    for name in names:
        importlib.import_module(name)


def test_a_package_may_be_left_out():
    code = (
        "import sys; from mtpcr_geo.core.imports import without\n"
        "with without('wave'):\n"
        "    try: import wave\n"
        "    except ModuleNotFoundError: print('missing')\n"
        "import wave\n"
        "with without('wave'): import wave as again\n"
        "print(again is wave is sys.modules['wave'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["missing", "True"]


def test_a_process_that_starts_while_opencv_is_imported_finds_pythons_own_modules(monkeypatch):
    """OpenCV puts its own folder before the standard library for as long as it is imported."""
    import cv2

    folder = str(Path(cv2.__file__).parent)
    monkeypatch.setattr(sys, "path", [sys.path[0], folder, *sys.path[1:]])
    code = "import sys; sys.path[:] = {path!r}; import typing; print(typing.__file__)"

    def found(path: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", code.format(path=path)], capture_output=True, text=True)

    assert folder not in search_path()
    assert set(search_path()) <= set(sys.path)
    done = found(search_path())
    assert done.returncode == 0, done.stderr
    assert "cv2" not in done.stdout
    # what it is for: with the path as it stands another `typing` is found
    assert "cv2" in (there := found(list(sys.path))).stdout or there.returncode
