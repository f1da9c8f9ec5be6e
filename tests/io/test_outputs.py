"""The set of outputs: whole or not at all, and never over what it may not replace."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.io import journal
from mtpcr_geo.io.outputs import OutputSet


def put(
    place: Path, texts: dict[str, str], *, overwrite: bool = False, replaces: tuple[str, ...] = ()
) -> None:
    with OutputSet(overwrite) as outputs:
        for name, text in texts.items():
            outputs.path(place / name).write_text(text)
        outputs.replace(place / name for name in replaces)
        outputs.commit()


def files(place: Path) -> dict[str, str]:
    return {str(p.relative_to(place)): p.read_text() for p in sorted(place.rglob("*")) if p.is_file()}


def test_only_regular_files_are_replaced(tmp_path):
    (tmp_path / "missing").symlink_to(tmp_path / "nowhere")
    os.mkfifo(tmp_path / "pipe")
    for path, words in (
        (Path("/dev/null"), "no regular file"),
        (tmp_path / "pipe", "no regular file"),
        (tmp_path, "is a folder"),
    ):
        with pytest.raises(OutputError, match=words):
            OutputSet(overwrite=True).check(path)
    # a link that leads nowhere is there all the same
    with pytest.raises(OutputError, match="exists already"):
        OutputSet().check(tmp_path / "missing")


def test_an_input_is_never_replaced_whatever_its_name(tmp_path):
    (tmp_path / "in").write_text("kept")
    os.link(tmp_path / "in", tmp_path / "linked")
    (tmp_path / "symbolic").symlink_to(tmp_path / "in")
    for name in ("in", "linked", "symbolic"):
        outputs = OutputSet(overwrite=True)
        outputs.keep([tmp_path / "in"])
        with pytest.raises(OutputError, match="is an input"):
            outputs.path(tmp_path / name)
    with OutputSet(overwrite=True) as outputs:
        outputs.keep([tmp_path / "in"])
        outputs.replace([tmp_path / "linked"])
        outputs.commit()
    assert (tmp_path / "linked").exists()


def test_the_set_replaces_the_set(tmp_path):
    put(tmp_path, {"a": "1", "b/c": "1", "mine": "1"})
    put(tmp_path, {"a": "2"}, overwrite=True, replaces=("a", "b/c", "not there"))
    assert files(tmp_path) == {"a": "2", "mine": "1"}


def test_without_leave_to_overwrite_or_without_commit_nothing_goes(tmp_path):
    put(tmp_path, {"b": "1"})
    put(tmp_path, {"a": "2"}, replaces=("b",))
    with OutputSet(overwrite=True) as outputs:
        outputs.path(tmp_path / "a").write_text("3")
        outputs.replace([tmp_path / "b"])
    assert files(tmp_path) == {"a": "2", "b": "1"}


def test_an_interruption_between_two_renames_waits(tmp_path, monkeypatch):
    put(tmp_path, {"a": "1", "b": "1", "old": "1"})
    rename = os.replace
    done: list[str] = []

    def interrupted(part, final):
        if not str(part).endswith(".new") and len(done) == 1:
            done.append("interrupted")
            raise KeyboardInterrupt
        done.append(final)
        rename(part, final)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        put(tmp_path, {"a": "2", "b": "2"}, overwrite=True, replaces=("old",))
    assert "interrupted" in done
    assert files(tmp_path) == {"a": "2", "b": "2"}


def test_part_files_of_runs_that_are_gone_are_removed_and_others_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "runs", lambda process: process in (5, os.getpid()))
    for name in (".a.part-4.laz", ".a.part-5.laz", ".b.part-4.laz", ".a.part-4.tif", ".a.part-x.laz"):
        (tmp_path / name).write_text("")
    put(tmp_path, {"a.laz": "1"})
    assert set(files(tmp_path)) == {
        ".a.part-5.laz",
        ".b.part-4.laz",
        ".a.part-4.tif",
        ".a.part-x.laz",
        "a.laz",
    }


HOSTILE = {
    "outside": {"put": [[".x.part-4", "x"]], "remove": ["../victim"]},
    "absolute": {"put": [], "remove": ["{victim}"]},
    "over another file": {"put": [["evil", "y"]], "remove": []},
    "from elsewhere": {"put": [["../.x.part-4", "x"]], "remove": []},
    "through a link": {"put": [], "remove": ["link/victim"]},
    "no journal": ["put"],
    "numbers": {"put": [[1, 2]], "remove": [3]},
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_journal_of_someone_else_moves_and_removes_nothing_elsewhere(name, tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "runs", lambda process: False)
    place = tmp_path / "out"
    place.mkdir()
    for path in (tmp_path / "victim", tmp_path / ".x.part-4", place / "evil"):
        path.write_text("kept")
    (place / "link").symlink_to(tmp_path)
    text = json.dumps(HOSTILE[name]).replace("{victim}", str(tmp_path / "victim"))
    (place / ".mtpcr-geo-4.journal").write_text(text)
    put(place, {"a": "1"})
    assert (tmp_path / "victim").exists()
    assert (tmp_path / ".x.part-4").exists()
    assert (place / "evil").exists()


def test_numbered_files_of_an_earlier_set_go(tmp_path):
    for count in (3, 2):
        with OutputSet(overwrite=True) as outputs:
            part = outputs.template(tmp_path / "tile_#.txt")
            for number in range(count):
                part.with_name(part.name.replace("#", str(number))).write_text(str(count))
            outputs.adopt(tmp_path / "tile_#.txt")
            outputs.commit()
    assert files(tmp_path) == {"tile_0.txt": "2", "tile_1.txt": "2"}
