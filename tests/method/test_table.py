"""The table of `mtpcr_geo.method`: step, equation, function, parameter."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from dataclasses import fields
from pkgutil import resolve_name

import pytest

from mtpcr_geo import method
from mtpcr_geo.core.types import SolveSettings
from mtpcr_geo.method.focus import FocusSettings
from mtpcr_geo.method.refine import RefineSettings

ROWS = re.split(r"^=+  =[= ]+\n", method.__doc__ or "", flags=re.MULTILINE)[2].splitlines()
NAMES = sorted({name for row in ROWS for name in re.findall(r"`([\w.]+)`", row)})
PARAMETERS = [found.groups() for row in ROWS if (found := re.search(r"`([\w.]+)`[^`]*?  (\w+): ", row))]


def called(name: str) -> object:
    """Return what the table calls by this name."""
    return resolve_name(name if name.startswith("mtpcr_geo.") else f"mtpcr_geo.method.{name}")


def test_the_table_has_every_step_and_equation() -> None:
    text = "\n".join(ROWS)
    assert {row[0] for row in ROWS} - {" "} == set("12345678")
    assert all(f"Eq. {number} " in text for number in range(1, 6))


@pytest.mark.parametrize("name", NAMES)
def test_every_function_is_there(name: str) -> None:
    assert callable(called(name))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_every_parameter_is_there(name: str, parameter: str) -> None:
    function = called(name)
    assert callable(function)
    settings = (SolveSettings, RefineSettings) if "settings" in inspect.signature(function).parameters else ()
    known = {field.name for one in settings for field in fields(one)}
    assert parameter in known | set(inspect.signature(function).parameters)


def test_focus_has_the_settings_named() -> None:
    row = next(row for row in ROWS if "`focus.focus`" in row)
    named = row.partition("settings: ")[2].split(", ")
    assert set(named) <= {field.name for field in fields(FocusSettings)}


@pytest.mark.parametrize("name", method.__all__)
def test_every_name_offered_can_be_imported(name: str) -> None:
    assert callable(getattr(method, name))
    assert name in dir(method)


def test_the_room_loads_nothing_by_itself() -> None:
    code = "import sys, mtpcr_geo.method; sys.exit('numpy' in sys.modules or 'cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
