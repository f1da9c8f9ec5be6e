"""Broken pipelines: each gives one line that names the stage and the nearest valid word, and no file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app

TARGET = {"type": "readers.las", "filename": "target.laz", "tag": "target"}
SOURCE = {"type": "readers.las", "filename": "source.laz", "tag": "source"}
LEVEL = {"type": "mtpcr.level", "tag": "level", "inputs": ["target", "source"], "method": "none"}
OUT = {"type": "writers.las", "filename": "out/x.laz", "tag": "out"}


def chain(*stages: Any) -> str:
    return json.dumps([TARGET, SOURCE, *stages])


BROKEN: dict[str, tuple[str | bytes, str, int]] = {
    # grammar
    "not JSON": ("[1, 2", "is not JSON: line 1", 2),
    "trailing comma": ('["target.laz",]', "is not JSON: line 1", 2),
    "wrong encoding": (json.dumps([TARGET, OUT]).encode("utf-16"), "is not UTF-8", 2),
    "latin 1": ('["t\xe4rget.laz", "out/x.laz"]'.encode("latin-1"), "not UTF-8 text (byte 3 is 0xe4)", 2),
    "endless comment": ("[ /* never", "the comment that opens in line 1 never ends", 2),
    "no array": ('"target.laz"', "must be an array of stages", 2),
    "empty": ("[]", "holds no stages", 2),
    "misspelt pipeline key": ('{"pipelin": []}', "did you mean 'pipeline' by 'pipelin'", 2),
    "a number for a stage": (chain(3), "stage 3 is a number", 2),
    "key twice": (
        '[{"type": "readers.las", "filename": "a", "filename": "b"}]',
        '"filename" stands twice',
        2,
    ),
    "no type, no filename": (chain({"typ": "mtpcr.bev"}), "did you mean 'type' by 'typ'", 2),
    "type is a number": (chain({"type": 5}), 'stage 3: "type" must be a string', 2),
    "unknown suffix": (
        json.dumps(["target.laz", "x.docx"]),
        "cannot tell the writer from the name 'x.docx'",
        2,
    ),
    "bad tag": (chain({**LEVEL, "tag": "1st"}), "the tag '1st' must be a letter", 2),
    "tag twice": (
        chain({**OUT, "tag": "source"}),
        "stage source (writers.las): the tag 'source' is used twice",
        2,
    ),
    "inputs of a number": (chain({**LEVEL, "inputs": 3}), '"inputs" must be a tag or a list of tags', 2),
    # wiring
    "missing tag": (chain({**LEVEL, "inputs": ["target", "sorce"]}), "did you mean 'source'?", 2),
    "takes from itself": (
        chain({**LEVEL, "inputs": ["level"]}),
        "stage level (mtpcr.level) takes from itself",
        2,
    ),
    "cycle": (
        chain({**LEVEL, "inputs": ["bev"]}, {"type": "mtpcr.bev", "tag": "bev", "inputs": ["level"]}),
        "stage level (mtpcr.level) takes from 'bev', which stands after it",
        2,
    ),
    "reader with inputs": (
        chain({**TARGET, "tag": "t2", "inputs": ["source"]}),
        "a reader takes no inputs",
        2,
    ),
    "nothing before": (
        json.dumps([LEVEL | {"inputs": []}]),
        "stage level (mtpcr.level) has nothing to take",
        2,
    ),
    "two writers to one file": (
        json.dumps([TARGET, OUT, {**OUT, "tag": "twice", "filename": "out/../out/x.laz"}]),
        "stage twice (writers.las) and stage out (writers.las) both write",
        2,
    ),
    "writes over its input": (
        json.dumps([TARGET, {**OUT, "filename": "target.laz"}]),
        "stage out (writers.las) would write over target.laz",
        2,
    ),
    "three clouds": (
        chain({**TARGET, "tag": "third"}, {"type": "mtpcr.level", "tag": "level"}),
        "stage level (mtpcr.level) takes two clouds",
        2,
    ),
    "pair without level": (
        chain({"type": "mtpcr.match", "tag": "m"}),
        "stage m (mtpcr.match) needs a pair",
        2,
    ),
    "writer without apply": (chain(LEVEL, OUT), "put mtpcr.apply before it", 2),
    "match without bev": (chain(LEVEL, {"type": "mtpcr.match", "tag": "m"}), "put mtpcr.bev before it", 2),
    # stages and options
    "unknown stage": (chain({**LEVEL, "type": "mtpcr.levle"}), "did you mean 'mtpcr.level'?", 2),
    "unknown family": (chain({"type": "mtpc.level", "tag": "l"}), "did you mean 'mtpcr.level'?", 2),
    "misspelt option": (chain({**LEVEL, "metod": "none"}), "no option 'metod'; did you mean 'method'?", 2),
    "wrong type": (
        chain(LEVEL, {"type": "mtpcr.bev", "tag": "bev", "cell": "wide"}),
        "stage bev (mtpcr.bev): option 'cell': input should be a valid number",
        2,
    ),
    "out of range": (chain(LEVEL, {"type": "mtpcr.bev", "tag": "bev", "cell": -1}), "greater than 0", 2),
    "wrong choice": (chain({**LEVEL, "method": "ransak"}), "input should be 'auto', 'ransac' or 'none'", 2),
    "missing option": (
        chain(LEVEL, {"type": "mtpcr.write_tie_points", "tag": "w"}),
        "option 'filename' is missing",
        2,
    ),
    "bad bounds": (
        json.dumps([TARGET, {"type": "filters.crop", "tag": "c", "bounds": "([0, 1]"}]),
        "stage c (filters.crop)",
        2,
    ),
    "unknown CRS": (
        json.dumps([{**TARGET, "override_srs": "EPSG:0"}, OUT]),
        "'EPSG:0' is not a coordinate",
        6,
    ),
    "different CRSs": (chain({**LEVEL, "target_crs": "EPSG:2193"}), "reproject one of", 6),
    # files
    "missing file": (
        json.dumps([{**TARGET, "filename": "tarjet.laz"}, OUT]),
        "there is no file tarjet.laz",
        5,
    ),
    "pattern without file": (
        json.dumps([{**TARGET, "filename": "*.copc"}, OUT]),
        "no file fits the pattern",
        2,
    ),
    "not a cloud": (
        json.dumps([{**TARGET, "filename": "text.laz"}, OUT]),
        "text.laz is not a LAS, LAZ or COPC",
        5,
    ),
    "existing output": (json.dumps([TARGET, {**OUT, "filename": "text.laz"}]), "text.laz exists already", 7),
    "output below a file": (
        json.dumps([TARGET, {**OUT, "filename": "text.laz/x.laz"}]),
        "text.laz is a file",
        7,
    ),
    # safety
    "code": (
        json.dumps([TARGET, {"type": "filters.python", "tag": "p", "source": "x"}]),
        "say --allow-code",
        2,
    ),
    "remote": (json.dumps(["https://example.org/a.laz", "out/x.laz"]), "say --allow-network", 2),
    "virtual": (json.dumps(["/vsicurl/https://example.org/a.laz", "out/x.laz"]), "say --allow-network", 2),
    "options elsewhere": (
        json.dumps([TARGET, {**OUT, "option_file": "more.txt"}]),
        "'option_file' is not",
        2,
    ),
}

BY_PDAL: dict[str, tuple[str, str, int]] = {
    "unknown PDAL stage": (
        json.dumps([TARGET, {"type": "filters.outlire"}]),
        "did you mean 'filters.outlier'?",
        2,
    ),
    "misspelt PDAL option": (
        json.dumps([TARGET, {"type": "filters.range", "tag": "r", "limit": "Z[0:1]"}]),
        "stage r (filters.range): no option 'limit'; did you mean 'limits'?",
        2,
    ),
    "wrong PDAL value": (
        json.dumps([TARGET, {"type": "filters.smrf", "tag": "g", "cell": "wide"}, OUT]),
        "stage g (filters.smrf): PDAL says: Invalid value 'wide'",
        2,
    ),
    "missing PDAL option": (
        json.dumps([TARGET, {"type": "filters.range", "tag": "r"}]),
        "stage r (filters.range)",
        2,
    ),
    "missing dimension": (
        json.dumps([TARGET, {"type": "filters.range", "tag": "r", "limits": "Height[0:1]"}, OUT]),
        "stage r (filters.range): PDAL says: Invalid dimension name",
        2,
    ),
    "late PDAL option": (
        chain(
            {"type": "mtpcr.register"},
            {"type": "mtpcr.apply"},
            {"type": "filters.smrf", "tag": "g", "cut": "x"},
            OUT,
        ),
        "stage g (filters.smrf): PDAL says: Invalid value 'x'",
        2,
    ),
    "pair to PDAL": (
        chain(LEVEL, {"type": "filters.outlier", "tag": "o"}, OUT),
        "stage o (filters.outlier) needs a cloud and gets a pair",
        2,
    ),
    "PDAL fails in the middle": (
        json.dumps([{**TARGET, "filename": "cut.laz"}, {"type": "filters.outlier", "tag": "o"}, OUT]),
        "PDAL says",
        5,
    ),
}


@pytest.fixture
def place(town_files, tmp_path, monkeypatch) -> Path:
    source, target = town_files
    (tmp_path / "source.laz").symlink_to(source)
    (tmp_path / "target.laz").symlink_to(target)
    (tmp_path / "text.laz").write_text("no points here")
    (tmp_path / "cut.laz").write_bytes(target.read_bytes()[: target.stat().st_size // 2])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complaint(place: Path, text: str | bytes, *arguments: str) -> tuple[str, int]:
    """Run a pipeline that must fail; give its one line and its exit code."""
    (place / "broken.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    before = sorted(place.rglob("*"))
    result = CliRunner().invoke(app, ["pipeline", "broken.json", *arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert sorted(place.rglob("*")) == before, "something was left"
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("mtpcr-geo: error: ")
    return lines[0], result.exit_code


@pytest.mark.parametrize("name", BROKEN)
def test_broken(name, place):
    text, words, code = BROKEN[name]
    line, exit_code = complaint(place, text)
    assert words in line
    assert exit_code == code


@pytest.mark.parametrize("name", sorted(set(BROKEN) - {"match without bev"}))
def test_broken_is_found_by_validation(name, place):
    text, words, code = BROKEN[name]
    line, exit_code = complaint(place, text, "--validate")
    assert words in line
    assert exit_code == code


@pytest.mark.parametrize("name", BY_PDAL)
def test_broken_by_pdal(name, place, pdal):
    text, words, code = BY_PDAL[name]
    line, exit_code = complaint(place, text)
    assert words in line
    assert exit_code == code


@pytest.mark.parametrize("name", sorted(set(BY_PDAL) - {"PDAL fails in the middle"}))
def test_broken_by_pdal_is_found_by_validation(name, place, pdal):
    text, words, code = BY_PDAL[name]
    line, exit_code = complaint(place, text, "--validate")
    assert words in line
    assert exit_code == code


def test_without_pdal_its_stages_say_how_to_get_it(place, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    line, exit_code = complaint(place, json.dumps([TARGET, {"type": "filters.outlier", "tag": "o"}, OUT]))
    assert "stage o (filters.outlier) needs PDAL" in line
    assert "conda-forge" in line
    assert exit_code == 8


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("--tarjet.filename=a.laz", "names no stage of the pipeline; did you mean 'target'?"),
        ("--stage.sorce.filename=a.laz", "did you mean 'source'?"),
        ("--readers.lass.filename=a.laz", "did you mean 'readers.las'?"),
        ("--target.filenam=a.laz", "did you mean 'filename'?"),
        ("--target=a.laz", "overrides are written --stage.option=value"),
        ("--out.filename", "has no value"),
    ],
)
def test_broken_overrides(override, words, place):
    line, exit_code = complaint(place, json.dumps([TARGET, SOURCE, LEVEL]), override)
    assert words in line
    assert exit_code == 2
