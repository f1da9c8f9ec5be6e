"""Fuzzed pipelines, transforms and model descriptions: each is taken, or refused by an error of its own."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import MtpcrError, OptionError
from mtpcr_geo.export.prior_file import read_pose
from mtpcr_geo.export.transform import read_transform
from mtpcr_geo.match.learned.model_cards import descriptions
from mtpcr_geo.pipeline.grammar import link, parse
from mtpcr_geo.pipeline.pdal.switches import Access
from mtpcr_geo.pipeline.safety import check

DIGITS, DEEP = "1" * 5000, "[" * 100_000 + "]" * 100_000
NASTY = {
    "digits": DIGITS,
    "digits in a stage": f'["a.laz", {{"type": "mtpcr.bev", "cell": {DIGITS}}}]',
    "deep": DEEP,
    "deep objects": '{"pipeline": ' * 50_000 + "1" + "}" * 50_000,
    "deep option": f'["a.laz", {{"type": "filters.range", "limits": {DEEP}}}]',
    "many digits in a matrix": f'{{"type": "mtpcr-geo transform", "version": 1, "chain": {"9" * 400}}}',
    "empty": "",
    "NUL": "\0",
}  # fmt: skip
STAGES = [
    "readers.las",
    "readers.ept",
    "filters.range",
    "filters.overlay",
    "writers.ogr",
    "mtpcr.bev",
    "x",
    "",
]
KEYS = ["filename", "plugin", "ogr", "raster", "datasource", "cell", "inputs", "tag", "where", "user_data"]
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["/vsi", "a://b"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
STAGE = st.builds(
    lambda kind, options: {"type": kind, **options},
    st.sampled_from(STAGES),
    st.dictionaries(st.sampled_from(KEYS), VALUES | VALUES.map(json.dumps), max_size=4),
)


def refused_or_taken(function, *arguments) -> None:
    with suppress(MtpcrError):
        function(*arguments)


def checked(text: str) -> None:
    check(link(parse(text)), Access())


@given(st.lists(STAGE | VALUES, max_size=4).map(json.dumps))
@settings(max_examples=300)
def test_pipelines_of_any_shape(text):
    refused_or_taken(checked, text)


@given(st.data())
@settings(max_examples=200)
def test_pipelines_with_letters_changed(data):
    text = json.dumps(["a.laz", {"type": "filters.range", "tag": "r", "limits": "Z[0:1]"}, "b.laz"])
    at = data.draw(st.integers(0, len(text) - 1))
    refused_or_taken(checked, text[:at] + data.draw(st.text(max_size=3)) + text[at + 1 :])


@pytest.mark.parametrize("name", NASTY)
@pytest.mark.parametrize("read", ["pipeline", "transform", "prior"])
def test_nasty_texts(name, read, tmp_path):
    path = tmp_path / "t.json"
    path.write_text(NASTY[name])
    with pytest.raises(MtpcrError):
        {"pipeline": lambda: checked(NASTY[name]), "transform": lambda: read_transform(path),
         "prior": lambda: read_pose(path)}[read]()  # fmt: skip


@pytest.mark.parametrize(
    "text", ["a" + ".a" * 100_000 + "=1", "a=" + DEEP, f"a={DIGITS}", "a=[1", "[[[", "origin=1", "a=\0"]
)
def test_nasty_model_descriptions(text, tmp_path):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(OptionError, match="model description"):
        descriptions(tmp_path)


def test_the_wall_says_that_it_is_a_defect_and_keeps_nothing(tmp_path, monkeypatch):
    def broken(*arguments, **named):
        raise ZeroDivisionError("\x1b[31mred")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mtpcr_geo.cli.pipeline.run_pipeline", broken)
    result = CliRunner().invoke(app, ["pipeline", "p.json"])
    assert result.exit_code == 70
    (line,) = result.stderr.splitlines()
    assert re.match(r"mtpcr-geo: this is a defect of mtpcr-geo .*nothing was kept: ZeroDivisionError", line)
    assert "\x1b" not in line
    assert list(Path().iterdir()) == []
