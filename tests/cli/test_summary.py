"""What the terminal says of a run: each fact once, the files that are there, and nothing a terminal obeys."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from helpers_scene import make_pair
from rich.console import Console

from mtpcr_geo.cli.shared import end_with
from mtpcr_geo.cli.summary import print_registration, print_run
from mtpcr_geo.core.types import Verdict
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.runner import RunResult
from mtpcr_geo.registration import Registration
from mtpcr_geo.verdict.findings import chance_text

FILES = ("bev/source.tif", "bev/target.tif", "bev/registered.tif", "ties.gpkg", "transform.json", "audit.rrd",
         "report.html", "run.json", "registered.laz")  # fmt: skip


def result(verdict: Verdict) -> RunResult:
    pair = make_pair(2000).with_(verdict=verdict)
    return RunResult({"assess": pair}, (), tuple(Path("out") / name for name in FILES))


def printed(verdict: Verdict, **console: object) -> str:
    text = io.StringIO()
    options = {"file": text, "width": 300, "highlight": False} | console
    print_registration(Registration(result(verdict), RegisterOptions()), console=Console(**options))  # type: ignore[arg-type]
    return text.getvalue()


def accepted() -> Verdict:
    metrics = {"probability": 0.995, "overlap_m2": 5152.5, "overlap_source": 0.25, "sigma_yaw_deg": 0.06}
    chance = f"the pose is right with {chance_text(0.995)}"
    return Verdict(
        "accepted",
        (chance, "the clouds share 5152 m2: 25% of the source"),
        metrics,
        sentence=f"the pose is right, within 5 degrees and 2 m, with {chance_text(0.995)}.",
    )


def test_each_fact_is_said_once():
    text = printed(accepted())
    assert text.count("probability") == 1
    assert text.count("5152") + text.count("5,152") == 1
    assert "standard deviation of yaw" in text
    doubtful = Verdict("doubtful", ("the next pose is as strong", "few cells"), {"overlap_m2": 5152.5},
                       sentence="the next pose is as strong.")  # fmt: skip
    text = printed(doubtful)
    assert text.count("the next pose is as strong") == 1
    assert "few cells" in text
    assert "5,152.5" in text


def test_the_files_worth_opening_are_named_and_the_rasters_by_their_folder():
    text = printed(accepted())
    for name in ("registered.laz", "transform.json", "report.html", "audit.rrd", "ties.gpkg", "run.json"):
        assert text.count(str(Path("out") / name)) == 1
    assert text.count(f"{Path('out') / 'bev'}/") == 1
    assert ".tif" not in text


def test_a_pipeline_names_no_file_twice():
    text = io.StringIO()
    run = result(accepted())
    more = RunResult(run.values, (), (*run.outputs, Path("out/more.laz")))
    print_run(more, console=Console(file=text, width=300, highlight=False))
    assert text.getvalue().count("out/bev/") == 1
    assert [line for line in text.getvalue().splitlines() if "wrote" in line] == ["  wrote out/more.laz"]


def test_colours_only_where_they_are_wanted(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[1;32m" in printed(accepted(), force_terminal=True)
    monkeypatch.setenv("NO_COLOR", "1")
    assert "32m" not in printed(accepted(), force_terminal=True)
    assert "\x1b" not in printed(accepted())


def test_nothing_that_a_terminal_obeys_is_printed():
    verdict = Verdict("refused", ("a cloud named \x1b[31m\u202e.laz\r",), {}, sentence="no.\x07")
    text = printed(verdict)
    assert all(letter.isprintable() or letter == "\n" for letter in text)


@pytest.mark.parametrize(("name", "lines"), [("accepted", 0), ("doubtful", 1), ("refused", 1)])
def test_quiet_is_one_line_where_the_verdict_is_not_accepted(name, lines, capsys):
    end_with(Verdict(name, ("one reason\nand a line", "another"), {}), quiet=True)
    found = capsys.readouterr()
    assert found.out == ""
    assert found.err.count("\n") == lines
    assert ("one reason and a line" in found.err) == bool(lines)
