from __future__ import annotations

import json
import sys

import pytest
from typer.testing import CliRunner

from mtpcr_geo.benchmark.pairs import load_pair, pair_folders
from mtpcr_geo.benchmark.simulator.options import PairOptions, pair_options
from mtpcr_geo.benchmark.simulator.pairs import simulate_from, simulate_pair
from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import OptionError

SMALL = ("--extent-m", "120", "--ground-beams", "60000", "--air-density", "2", "--overlap", "0.3")


def run(*words: object):
    return CliRunner().invoke(app, ["simulate", *map(str, words)])


def test_pairs_are_written_and_are_what_the_benchmark_reads(tmp_path):
    result = run(tmp_path, "--kind", "campus", "--seed", 4, "--count", 2, *SMALL)
    assert result.exit_code == 0, result.output
    assert [folder.name for folder in pair_folders(tmp_path)] == ["campus_4", "campus_5"]
    assert "campus_5" in result.stdout
    pair = load_pair(tmp_path / "campus_4")
    facts = json.loads((tmp_path / "campus_4" / "pair.json").read_text())
    assert facts["source"]["points"] == len(pair.source) > 1000
    assert facts["simulation"]["kind"] == "campus"
    again = run(tmp_path, "--kind", "campus", "--seed", 4, *SMALL)
    assert again.exit_code == 7
    winter = run(tmp_path / "winter", "--kind", "campus", "--seed", 4, "--ground-leaves", 0.25, *SMALL)
    assert winter.exit_code == 0
    bare = json.loads((tmp_path / "winter" / "campus_4" / "pair.json").read_text())
    assert bare["simulation"]["ground_leaves"] == 0.25
    assert bare["source"]["points"] != facts["source"]["points"]
    assert "exists already" in again.stderr


def test_every_option_of_a_pair_is_an_option_of_the_verb():
    text = run("--help").output
    for name, field in PairOptions.model_fields.items():
        assert f"--{name.replace('_', '-')}" in text, name
        assert field.description, name
    assert "  simulate " in CliRunner().invoke(app, ["--help"]).output


@pytest.mark.parametrize(
    "words",
    [("--kind", "village"), ("--overlap", "3"), ("--seed", "-1"), ("--count", "0"), ("--kinds", "town")],
)
def test_wrong_options_are_refused(words, tmp_path):
    result = run(tmp_path / "out", *words)
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    result = run(tmp_path / "out", *SMALL)
    assert result.exit_code == 8
    assert "mtpcr-geo[benchmark]" in result.stderr
    assert not (tmp_path / "out").exists()


def test_misspelt_option_names_the_nearest():
    with pytest.raises(OptionError, match="overlap"):
        simulate_pair("town", 0, overlp=0.2)


def test_options_and_keywords_give_the_same_pair():
    words = {"extent_m": 120.0, "ground_beams": 40_000, "air_density": 2.0, "overlap": 0.3}
    one = simulate_pair("suburb", 1, **words)
    other = simulate_from(pair_options(kind="suburb", seed=1, **words))
    assert (one.source.xyz == other.source.xyz).all()
    assert other.options["extent_m"] == 120.0
