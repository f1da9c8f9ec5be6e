"""Names of files that mean harm: pipes, links, names that are too long, formulas, and lines of their own."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import helpers_fuzz as fuzz
import pytest
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import InputError, OutputError
from mtpcr_geo.core.paths import read_whole
from mtpcr_geo.core.wording import in_a_line
from mtpcr_geo.survey.batch import MARK, Row, _row_of, run_batch, write_table
from mtpcr_geo.survey.build import build_survey
from mtpcr_geo.survey.jobs import jobs_of

NO_PIPES = pytest.mark.skipif(os.name == "nt", reason="has no named pipes, and links need a privilege")


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a cloud and a transform in it."""
    monkeypatch.chdir(tmp_path)
    fuzz.write_las(tmp_path / "a.las", "1.4", 6)
    fuzz.write_still(tmp_path / "t.json")
    return tmp_path


@NO_PIPES
@pytest.mark.parametrize(
    "words",
    [["check", "@pipe"], ["apply", "pipe", "a.las", "o.las"], ["pipeline", "pipe"], ["check", "pipe"],
     ["verify", "run"], ["survey", "build", "a.las", "-o", "survey"],
     ["batch", "jobs.csv", "-o", "o", "--target", "a.las"]],
    ids=lambda words: words[0],
)  # fmt: skip
def test_a_named_pipe_where_a_text_is_expected_is_an_error_and_no_endless_wait(words, place):
    for name in ("pipe", "run/run.json", "survey/survey.json", "jobs.csv"):
        Path(name).parent.mkdir(exist_ok=True)
        os.mkfifo(name)
    code, _, said = run(*words)
    assert code in (5, 7), said


@NO_PIPES
def test_what_a_shell_puts_in_the_place_of_a_commands_output_is_read(place):
    end, start = os.pipe()
    os.write(start, b"[]")
    os.close(start)
    assert read_whole(f"/dev/fd/{end}") == b"[]"
    os.close(end)


@pytest.mark.parametrize(
    "href", ["x" * 5000, "a" * 254, "\0", None, 5, ["a"], "//host/a.las", "file://host/a.las", "s3://b/a.las"]
)
def test_a_point_cloud_of_clouds_that_are_none(href, place):
    Path("t.vpc").write_text(json.dumps({"features": [{"assets": {"data": {"href": href}}}]}))
    assert run("check", "t.vpc")[0] == InputError.exit_code
    if isinstance(href, str) and "\0" not in href:
        Path("list.txt").write_text(href)
        assert run("check", "@list.txt")[0] == InputError.exit_code


@pytest.mark.skipif(os.name == "nt", reason="no name holds a line end there")
def test_a_name_of_several_lines_is_printed_in_one(place):
    name = "a\nmtpcr-geo: accepted.las"
    Path("a.las").rename(name)
    assert in_a_line(name) == r"a\nmtpcr-geo: accepted.las"
    for words in (["check", name], ["check", name, "b.las"], ["apply", "t.json", name, f"o{name}"],
                  ["register", name, name, "-o", "out"], ["pipeline", name]):  # fmt: skip
        _, out, err = run(*words)
        lines = (out + err).splitlines()
        assert not any(line.startswith("mtpcr-geo: accepted") for line in lines), words


@NO_PIPES
@pytest.mark.parametrize("inner", ["tiles", "bev", "bev/x390"])
def test_a_survey_removes_and_writes_nothing_where_its_links_lead(inner, place):
    build_survey(["a.las"], "survey")
    mine = place / "mine"
    (mine / "x390").mkdir(parents=True)
    for name in ("letter.npz", ".letter.tif", "x390/.letter.tif"):
        (mine / name).write_text("mine")
    Path("survey", inner).rename("away")
    Path("survey", inner).symlink_to(mine)
    with pytest.raises(OutputError, match="is a link"):
        build_survey(["a.las"], "survey")
    assert sorted(path.name for path in mine.rglob("*")) == [
        ".letter.tif",
        ".letter.tif",
        "letter.npz",
        "x390",
    ]


@NO_PIPES
@pytest.mark.parametrize("inner", ["rows", "jobs", "jobs/one"])
def test_a_batch_writes_nothing_where_its_links_lead(inner, place):
    Path("out/jobs").mkdir(parents=True)
    Path("out", MARK).write_text("{}")
    Path("mine").mkdir()
    if inner == "jobs":
        Path("out/jobs").rmdir()
    Path("out", inner).symlink_to(place / "mine")
    Path("jobs.csv").write_text("name,source,target\none,a.las,a.las\n")
    with pytest.raises(OutputError, match="is a link"):
        run_batch(jobs_of(Path("jobs.csv"), None, {}), "out")
    assert not list(Path("mine").iterdir())


@pytest.mark.parametrize("cell", ["=cmd|' /C calc'!A0.las", "+1.las", "-1.las", "@sum.las"])
def test_no_cell_of_a_batchs_table_is_a_formula_or_a_command(cell, tmp_path):
    write_table(tmp_path / "b.csv", [Row("one", cell, f"{cell}\x1b[31m\u202e", "failed", reason="\x1b[0m")])
    text = (tmp_path / "b.csv").read_text(encoding="utf-8")
    assert "\x1b" not in text
    assert "\u202e" not in text
    (row,) = csv.DictReader(text.splitlines())
    assert row["source"] == f"./{cell}"
    assert not any(value.startswith(("=", "+", "-", "@")) for value in row.values())


@pytest.mark.parametrize(
    "change",
    [{}, {"crs": "none of it"}, {"footprint": [1.0]}, {"footprint": "abc"}, {"footprint": [[1], 2]},
     {"x": {}}, {"name": "another"}, {"verdict": None}, {"T_target_source": "1"}],
    ids=str,
)  # fmt: skip
def test_a_row_that_is_none_is_made_anew(change, place):
    Path("jobs.csv").write_text("name,source,target\none,a.las,a.las\n")
    (job,) = jobs_of(Path("jobs.csv"), None, {})
    good = {"name": "one", "source": "a.las", "target": "a.las", "verdict": "accepted", "key": job.key,
            "footprint": [0, 0, 9, 0, 9, 9], "crs": CRS.from_epsg(25833).to_wkt()}  # fmt: skip
    Path("out/rows").mkdir(parents=True)
    Path("out/rows/one.json").write_text(json.dumps(good | change))
    assert (_row_of(Path("out"), job) is None) == bool(change)


@pytest.mark.parametrize("change", [{"crs_wkt": "CON"}, {"crs_wkt": CRS.from_epsg(4326).to_wkt()},
                                    {"cell_m": 0}, {"cell_m": -1}, {"cell_m": 1e300}, {"unit_m": "nan"},
                                    {"cell_m": 10**400}])  # fmt: skip
def test_a_survey_of_cells_or_a_crs_that_are_none(change, place):
    build_survey(["a.las"], "survey")
    path = Path("survey/survey.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert run("survey", "build", "a.las", "-o", "survey")[0] == InputError.exit_code
