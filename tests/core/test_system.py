"""What a run writes down about itself."""

from __future__ import annotations

import shlex
import sys

import pytest

from mtpcr_geo.core.system import command_line


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["/usr/bin/mtpcr-geo", "register", "a b.laz", "c.laz"], "mtpcr-geo register 'a b.laz' c.laz"),
        (["/x/mtpcr_geo/__main__.py", "demo"], "python -m mtpcr_geo demo"),
        (["/usr/bin/pytest", "-q"], None),
        (["/x/other/__main__.py"], None),
        ([""], None),
        ([], None),
    ],
)
def test_the_command_line_can_be_typed_again(argv, expected, monkeypatch):
    monkeypatch.setattr(sys, "argv", argv)
    found = command_line()
    assert found == expected
    if found is not None:
        assert shlex.split(found)[-1] == argv[-1]
