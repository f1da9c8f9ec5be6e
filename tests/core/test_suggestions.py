"""The nearest valid name: what people write, and what they are told."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mtpcr_geo.core.suggestions import SYNONYMS, edit_distance, meant, nearest, suggestions

OPTIONS = [
    "--out", "--source-crs", "--target-crs", "--local", "--level", "--cell", "--vertical", "--out-crs",
    "--prior", "--no-prior", "--prior-sigma", "--prior-yaw", "--motion", "--profile", "--matcher", "--models",
    "--no-res", "--no-focus", "--no-enhance", "--seed", "--overwrite", "--force", "--no-recording",
    "--dump-pipeline", "--json", "--verbose", "--quiet", "--help",
]  # fmt: skip
STAGES = ["mtpcr.level", "mtpcr.bev", "mtpcr.match", "mtpcr.register", "readers.las", "filters.outlier"]

MISSPELT = {
    "--resolution": "--cell",
    "--cel": "--cell",
    "--cell-size": "--cell",
    "--voxel": "--cell",
    "--output": "--out",
    "--out-dir": "--out",
    "--force-overwrite": "--overwrite",
    "--over": "--overwrite",
    "--overwrit": "--overwrite",
    "--clobber": "--overwrite",
    "--quite": "--quiet",
    "--silent": "--quiet",
    "--crs-source": "--source-crs",
    "--source_crs": "--source-crs",
    "--src-crs": "--source-crs",
    "--source": "--source-crs",
    "--output-crs": "--out-crs",
    "--prior-sgima": "--prior-sigma",
    "--sigma": "--prior-sigma",
    "--record": "--no-recording",
    "--focus": "--no-focus",
    "--random-seed": "--seed",
    "--sed": "--seed",
    "--dump": "--dump-pipeline",
    "--jsn": "--json",
    "--debug": "--verbose",
    "--weights": "--models",
    "--method": "--matcher",
    "--dof": "--motion",
    "--moton": "--motion",
    "--foo": None,
    "--xyz": None,
    "--iterations": None,
    "--gpu": None,
    "-": None,
    "": None,
}


@pytest.mark.parametrize("word", MISSPELT)
def test_misspelt_options(word):
    assert nearest(word, OPTIONS) == MISSPELT[word]


@pytest.mark.parametrize("word", ["--crs", "--epsg", "--srs"])
def test_a_word_for_two_options_names_both(word):
    assert suggestions(word, OPTIONS) == ["--source-crs", "--target-crs"]
    assert meant(word, OPTIONS) == "; did you mean '--source-crs' or '--target-crs'?"


def test_python_names_are_returned_as_spelt():
    names = ["source_crs", "target_crs", "cell", "motion", "res"]
    assert nearest("resolution", names) == "cell"
    assert nearest("sourceCrs", names) == "source_crs"
    assert nearest("Source-CRS", names) == "source_crs"


@pytest.mark.parametrize(
    ("word", "stage"),
    [
        ("mtpcr.levle", "mtpcr.level"),
        ("mtpc.level", "mtpcr.level"),
        ("mtpcr.matching", "mtpcr.match"),
        ("mtpcr.reg", "mtpcr.register"),
        ("reader.las", "readers.las"),
        ("las", "readers.las"),
        ("outlier", "filters.outlier"),
        ("mtpcr.foo", None),  # a family in common says nothing
        ("filters.xyz", None),
    ],
)
def test_stages(word, stage):
    assert nearest(word, STAGES) == stage


def test_what_is_there_is_listed_where_nothing_is_near():
    assert meant("zzz", ["b", "a"]) == " (there are: a, b)"
    assert meant("zzz", map(str, range(100, 120))) == ""
    assert meant("zzz", []) == ""
    assert meant("type", ["tpye", "filename"], turned=True) == "; did you mean 'type' by 'tpye'?"
    assert meant("type", ["filename"], turned=True) == ""


@pytest.mark.parametrize(
    ("a", "b", "slips"),
    [("", "", 0), ("", "abc", 3), ("cell", "cel", 1), ("ab", "ba", 1), ("motion", "cell", 6)],
)
def test_edit_distance(a, b, slips):
    assert edit_distance(a, b) == edit_distance(b, a) == slips


@given(
    st.text(alphabet="abcde-_.", max_size=12), st.lists(st.text(alphabet="abcde-", min_size=1), max_size=8)
)
def test_whatever_is_written_the_answer_is_valid(word, names):
    found = suggestions(word, names)
    assert set(found) <= set(names)
    assert isinstance(meant(word, names), str)
    for name in names:
        if name.strip("-"):
            assert suggestions(name, [name]) == [name]


def test_synonyms_are_written_as_they_are_looked_up():
    assert all(word.isalpha() and word.islower() for word in SYNONYMS)
    assert list(SYNONYMS) == sorted(SYNONYMS)
    assert all(word not in meanings for word, meanings in SYNONYMS.items())


def test_a_word_of_many_letters_is_like_nothing():
    assert suggestions("a" * 101, ["a" * 100]) == []
    assert suggestions("a" * 99, ["a" * 100]) == ["a" * 100]
