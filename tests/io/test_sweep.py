"""Every kind of LAS file that can be made, moved by a transform and back: no value is lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers_sweep import Kind, kinds, main, try_kind

KINDS = list(kinds())
FEW = [
    kind
    for i, kind in enumerate(KINDS)
    # one of each, and of those that differ in format or type alone every seventh
    if i % 7 == 0 or kind.name not in {one.name for one in KINDS[:i]}
    if i % 3 == 0 or not kind.name.startswith("extra bytes of type")
]


def called(kind: Kind) -> str:
    return f"{kind.point_format}-1.{kind.minor}-{kind.name}"


@pytest.mark.parametrize("kind", FEW, ids=called)
def test_a_file_moved_there_and_back_keeps_all(kind: Kind, tmp_path: Path) -> None:
    row = try_kind(kind, ".las", tmp_path)
    assert row.result == "kept", row.lost


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz"])
@pytest.mark.parametrize("kind", KINDS, ids=called)
def test_all_kinds_in_all_containers(kind: Kind, suffix: str, tmp_path: Path) -> None:
    row = try_kind(kind, suffix, tmp_path)
    assert row.result in ("kept", "no such file"), row.lost


def test_the_table_names_what_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("helpers_sweep.kinds", lambda: iter(KINDS[:1]))
    assert main(tmp_path / "table.md") == 0
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert len(lines) == 2 + 3
    assert all(" kept |" in line for line in lines[2:])
