"""Names that no file has or can have, links in a circle, pipes: one documented exit code for each verb."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from helpers_fuzz import write_las, write_still
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import InputError, OutputError

LONG = "x" * 300
INPUTS = {
    "missing": "missing.laz", "a folder": "folder", "empty": "empty.laz", "garbage": "garbage.laz",
    "a broken link": "broken.laz", "a circle of links": "circle.laz", "a pipe": "pipe.laz",
    "below a file": "good.las/a.laz", "long": f"{LONG}.laz", "a long pattern": f"{LONG}*.laz",
    "a long list": f"@{LONG}", "a list that is missing": "@missing.txt", "a deep list of tiles": "deep.vpc",
}  # fmt: skip


def run(*arguments) -> int:
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result.exit_code


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_las(tmp_path / "good.las", "1.4", 6)
    write_still(tmp_path / "still.json")
    Path("folder").mkdir()
    Path("empty.laz").write_text("")
    Path("garbage.laz").write_text("hello\n")
    Path("deep.vpc").write_text('{"features": ' + "[" * 50_000 + "]" * 50_000 + "}")
    if os.name != "nt":
        Path("broken.laz").symlink_to("nowhere.laz")
        Path("circle.laz").symlink_to("circle.laz")
        os.mkfifo("pipe.laz")
    return tmp_path


@pytest.mark.skipif(os.name == "nt", reason="needs links and pipes")
@pytest.mark.parametrize("name", INPUTS)
def test_an_input_that_cannot_be_read(name, place):
    path = INPUTS[name]
    code = InputError.exit_code
    before = sorted(place.rglob("*"))
    assert run("check", path) == code
    assert run("register", path, "good.las", "-o", "out") == code
    assert run("register", "good.las", path, "-o", "out") == code
    assert run("apply", "still.json", path, "o.laz") == code
    if "*" not in path:
        Path("p.json").write_text(json.dumps([{"type": "readers.las", "filename": path}, "o.laz"]))
        assert run("pipeline", "p.json", "--validate") == code
        assert run("pipeline", "p.json") == code
        Path("p.json").unlink()
    if "pipe" not in path:
        assert run("apply", path, "good.las", "o.laz") == code
        if path != "folder":
            # without an ending it is a word, like none
            assert run("register", "good.las", "good.las", "-o", "out", "--prior", path) == code
    assert sorted(place.rglob("*")) == before


@pytest.mark.skipif(os.name == "nt", reason="names are longer there")
@pytest.mark.parametrize(
    "name", [f"{LONG}.laz", "y" * 5000, "z" * 248 + ".laz", "a\0b.laz", "good.las/a.laz"]
)
def test_an_output_that_no_file_can_be(name, place):
    before = sorted(place.rglob("*"))
    Path("p.json").write_text(json.dumps(["good.las", {"type": "writers.las", "filename": name}]))
    assert run("pipeline", "p.json") == OutputError.exit_code
    Path("p.json").unlink()
    if "\0" not in name:
        assert run("apply", "still.json", "good.las", name) == OutputError.exit_code
        if not name.startswith("z"):
            # as a folder it may be
            assert run("register", "good.las", "good.las", "-o", f"{name}/out") == OutputError.exit_code
    assert sorted(place.rglob("*")) == before


def test_a_text_without_an_end(place):
    if not Path("/dev/zero").exists():
        pytest.skip("needs /dev/zero")
    assert run("apply", "/dev/zero", "good.las", "o.laz") == InputError.exit_code
    assert run("pipeline", "/dev/zero") == InputError.exit_code
