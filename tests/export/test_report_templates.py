"""Compiled templates of the report are kept where Python keeps compiled modules, or not at all."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from jinja2 import DictLoader, Environment

from mtpcr_geo.export.report.compiled import ENVIRONMENT, BesideModules


def rendered(text: str) -> str:
    environment = Environment(
        loader=DictLoader({"one.j2": text}), bytecode_cache=BesideModules(), autoescape=True
    )
    return environment.get_template("one.j2").render(name="<b>")


def kept(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return tmp_path


def test_a_compiled_template_is_kept_and_taken_again(folder: Path) -> None:
    assert rendered("a {{ name }}") == "a &lt;b&gt;"
    (path,) = kept(folder)
    assert path.suffix == ".j2c"
    before = path.stat().st_mtime_ns
    assert rendered("a {{ name }}") == "a &lt;b&gt;"
    assert path.stat().st_mtime_ns == before
    # another text under the same name is another template
    assert rendered("b {{ name }}") == "b &lt;b&gt;"
    assert len(kept(folder)) == 1


@pytest.mark.parametrize("content", [b"", b"j2", b"nothing of the kind" * 40])
def test_a_damaged_one_is_compiled_anew(folder: Path, content: bytes) -> None:
    rendered("a {{ name }}")
    (path,) = kept(folder)
    path.write_bytes(content)
    assert rendered("a {{ name }}") == "a &lt;b&gt;"


def test_nothing_is_kept_where_python_keeps_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert rendered("a {{ name }}") == "a &lt;b&gt;"
    assert kept(folder) == []


def test_nothing_is_kept_where_the_folder_cannot_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / "file"))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    assert rendered("a {{ name }}") == "a &lt;b&gt;"


def test_the_reports_templates_are_compiled_this_way() -> None:
    assert isinstance(ENVIRONMENT.bytecode_cache, BesideModules)
