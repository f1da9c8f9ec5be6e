"""Modules imported ahead are there when they are needed, and what cannot be imported says so in its place."""

from __future__ import annotations

import importlib
import subprocess
import sys
import textwrap

import pytest

from mtpcr_geo.core import imports
from mtpcr_geo.core.imports import import_ahead
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
