"""Every number that stands in two places is the same in both: files, report, recording and terminal."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from helpers_scene import make_pair
from rich.console import Console

from mtpcr_geo.cli.summary import print_registration
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export import descriptions
from mtpcr_geo.export.recording.budget import Budget
from mtpcr_geo.export.recording.writer import RecordingWriter
from mtpcr_geo.pipeline.runner import RunResult
from mtpcr_geo.registration import Registration
from mtpcr_geo.verdict.decision import Limits, assess
from mtpcr_geo.verdict.evidence import gather, tie_point_agrees
from mtpcr_geo.verdict.sentence import centimetres

LIMITS = {"accepted": Limits(), "doubtful": Limits(), "refused": Limits(overlap_m2=1e6)}
CASES = [("accepted", False), ("doubtful", False), ("refused", False), ("refused", True), ("doubtful", True)]


def judged(name: str) -> Pair:
    """A pair judged by its own evidence: the second hypothesis is as strong where it shall be doubtful."""
    pair = make_pair(3000, state="solved")
    assert pair.matches is not None
    assert pair.tie_points is not None
    assert pair.T_target_source is not None
    strengths = (4.0, 3.6 if name == "doubtful" else 0.6, 0.5, 0.4, 0.3)
    hypotheses = tuple(
        replace(one, strength=strength)
        for one, strength in zip(pair.matches.hypotheses, strengths, strict=True)
    )
    pair = pair.with_(
        matches=replace(
            pair.matches, hypotheses=hypotheses, margin=strengths[0] / strengths[1], support=0.8,
            strength=4.0, null_ratio=5.0, search_radius_m=4.0,
            mirrored_strengths=tuple(0.8 * 0.95**k for k in range(12)),
        )
    )  # fmt: skip
    evidence, more = gather(pair)
    verdict = assess(evidence, LIMITS[name], more)
    assert verdict.name == name, verdict.reasons
    assert pair.T_target_source is not None
    assert pair.tie_points is not None
    agreeing = tie_point_agrees(pair, pair.T_target_source, evidence.tolerance_m)
    return pair.with_(verdict=verdict, tie_points=replace(pair.tie_points, inlier=agreeing))


def recorded(pair: Pair, path: Path) -> str:
    """The summary that a recording begins with, as the viewer gets it."""
    from rerun.chunk import RrdReader

    writer = RecordingWriter(path, Budget(1.0), 0)
    writer.begin({})
    writer.after("mtpcr.assess", "assess", {}, pair, 0.1)
    writer.close()
    texts = [
        row["TextDocument:text"][0]
        for chunk in RrdReader(str(path)).stream().to_chunks()
        if chunk.entity_path == "/summary"
        for row in chunk.to_record_batch().to_pylist()
    ]
    return str(texts[-1])


class Figure(NamedTuple):
    """A figure of a report: as printed, as it claims to be, and whether it is printed as an upper bound."""

    text: str
    value: float
    bound: bool


def figures_of(html: str) -> dict[str, list[Figure]]:
    """The figures of a report by the place in run.json that they name."""
    found: dict[str, list[Figure]] = {}
    pattern = r'<data value="([^"]*)" data-from="([^"]*)"( data-bound="yes")?>([^<]*)</data>'
    for value, place, bound, text in re.findall(pattern, html):
        found.setdefault(place, []).append(Figure(text, float(value), bool(bound)))
    return found


def assert_rounded(figure: Figure, value: float) -> None:
    """What is printed is the figure, rounded to the digits printed; a bound is rounded up."""
    (printed,) = re.findall(r"[-+]?[\d,]*\.?\d+(?:e[-+]?\d+)?", figure.text)[:1]
    number = float(printed.replace(",", ""))
    if figure.text.endswith("%"):
        value = 100.0 * value
    digits = len(printed.partition("e")[0].partition(".")[2])
    step = 10.0**-digits * 10.0 ** int(printed.partition("e")[2] or 0)
    if figure.text.startswith("more than"):
        assert number < value <= 100.0, figure
    elif figure.bound:
        assert value <= number <= value + step + 1e-12, figure
    else:
        assert abs(number - value) <= 0.5 * step + 1e-12 * abs(value), figure


@pytest.mark.parametrize(("name", "force"), CASES)
def test_every_place_says_the_same(name: str, force: bool, tmp_path: Path) -> None:
    pair = judged(name)
    verdict = pair.verdict
    assert verdict is not None
    found = Registration(RunResult({"assess": pair}, (), ()))
    found.save(tmp_path / "out", force=force)
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    html = unescape((tmp_path / "out" / "report.html").read_text())
    page = re.sub(r"<[^>]+>", "", html.partition("<body>")[2])
    said = io.StringIO()
    print_registration(found, console=Console(file=said, width=500, highlight=False))
    terminal = said.getvalue()
    recording = recorded(pair, tmp_path / "a.rrd")

    # one sentence, first, in every place
    sentence = run["sentence"]
    assert sentence.startswith(f"{name.capitalize()}: ")
    assert terminal.startswith(sentence)
    assert sentence in page
    assert sentence in recording
    assert sentence in " ".join(repr(found).split())
    assert run["probability"] == run["metrics"]["probability"]

    # the reasons, and the table of checks
    for reason in run["reasons"]:
        assert all(reason in place for place in (page, recording))
        # the terminal does not say twice what the sentence has said
        assert reason in terminal or re.fullmatch(r"the pose is right with a probability of .* %", reason)
    assert [one["check"] for one in run["checks"]] == [one.name for one in verdict.checks]
    for one in run["checks"]:
        assert all(text in page for text in (one["value"], one["wanted"], one["meaning"]))
        assert f"- **{one['check']}, {one['status']}**: {one['value']}; wanted: {one['wanted']}." in recording
    refusing = [one for one in run["checks"] if one["status"] == "not passed"]
    assert bool(refusing) == (name != "accepted")

    # every figure of the report that stands in run.json too names its place there, and says the same
    shown = figures_of(html)
    assert {"metrics.ground_cells", "metrics.tie_points", "metrics.yaw_deg", "metrics.tilt_deg"} <= set(shown)
    if name != "refused":
        assert {"metrics.within_95_plan_m", "metrics.sigma_yaw_deg"} <= set(shown)
    numbers = {key for key, value in run["metrics"].items() if type(value) in (int, float)}
    assert {path for path in shown if path.startswith("metrics.")} == {f"metrics.{key}" for key in numbers}
    for place, printed in shown.items():
        value = run
        for key in place.split("."):
            value = value[key]
        for figure in printed:
            assert figure.value == value, place
            assert_rounded(figure, value)

    # what the terminal prints of the transform
    ((yaw, tilt),) = set(re.findall(r"yaw\s+([-+][\d.]+)\D*?tilt\s+([\d.]+)", terminal))
    assert_rounded(Figure(yaw, 0.0, False), run["metrics"]["yaw_deg"])
    assert_rounded(Figure(tilt, 0.0, False), run["metrics"]["tilt_deg"])

    # counts and measures within the checks are those of the metrics
    check = {one["check"]: one["value"] for one in run["checks"]}
    known = run["metrics"]
    assert check["tie points"].startswith(
        f"{known['held_out_tie_points']}, of which {known['held_out_agreeing']} agree when held out"
    )
    assert f"{known['refined_away_m']:.2f} m away" in check["refinement"]
    assert f" of {known['ground_cells']:,} cells" in check["ground heights"]
    share = float(check["ground heights"].partition(" %")[0])
    assert share == pytest.approx(100.0 * known["ground_agreeing"] / known["ground_cells"], abs=0.5)
    assert float(check["next distinct pose"].split()[0]) == pytest.approx(
        known["hypothesis_margin"], abs=5e-3
    )
    assert check["shared ground"].startswith(f"{known['overlap_m2']:.0f} m²")

    # the figures of the metrics, wherever they are printed
    for label, value in descriptions.metric_rows(verdict.metrics):
        assert f"- **{label}**: {value}" in recording
        assert f"{label}{value}" in page
    for line in terminal.splitlines():
        for label, value in descriptions.metric_rows(verdict.metrics):
            if line.strip().startswith(f"{label}  "):
                assert line.strip().endswith(value)

    # one count of the tie points that agree: drawn, printed, and in numbers
    assert pair.tie_points is not None
    agreeing = int(pair.tie_points.inlier.sum())
    assert run["metrics"]["tie_points_agreeing"] == agreeing
    assert f"{len(pair.tie_points)}, of which {agreeing} agree with the transform in plan" in page
    assert f"{agreeing} tie points agree with the final transform" in page

    # candidate poses are drawn by what the margin is of
    assert pair.matches is not None
    first, second = (one.strength or 0.0 for one in pair.matches.hypotheses[:2])
    assert run["metrics"]["hypothesis_margin"] == pytest.approx(first / second)
    assert f">{first:.4g}<" in html
    assert f">{second:.4g}<" in html

    # the uncertainty, in run.json, transform.json and Python
    assert verdict.uncertainty is not None
    C = np.array(run["uncertainty"]["covariance"])
    assert np.array_equal(C, verdict.uncertainty.covariance)
    assert run["metrics"]["sigma_yaw_deg"] == pytest.approx(np.degrees(np.sqrt(C[2, 2])))
    assert ("Expected error" in page) == (name != "refused")
    if name != "refused":
        assert f"{centimetres(run['metrics']['within_95_plan_m'])} m in plan" in sentence
        assert f"{centimetres(run['metrics']['within_95_plan_far_m'])} m and" in sentence
    written = {Path(path).name for path in run["outputs"]}
    withheld = {Path(one["path"]).name for one in run["not_written"]}
    assert not written & withheld
    assert ("transform.json" in written) == (name != "refused" or force)
    assert ("registered.laz" in written) == (name == "accepted" or force)
    assert ("Not written" in page) == bool(withheld)
    assert ("was forced" in page) == ("was forced" in terminal) == run["forced"] == force
    if "transform.json" not in written:
        return
    stated = json.loads((tmp_path / "out" / "transform.json").read_text())
    assert stated["verdict"]["sentence"] == sentence
    assert stated["verdict"]["probability"] == run["probability"]
    assert stated["verdict"]["reasons"] == run["reasons"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", stated["verdict"]["date"])
    assert stated["verdict"]["sigmas"].items() <= run["metrics"].items()
    assert stated["uncertainty"] == run["uncertainty"]
    assert np.allclose(stated["T_target_source"], run["T_target_source"], rtol=1e-15)


@pytest.mark.parametrize("name", ["doubtful"])
def test_two_rival_poses_are_drawn_and_named(name: str, tmp_path: Path) -> None:
    found = Registration(RunResult({"assess": judged(name)}, (), ()))
    found.save(tmp_path / "out")
    html = unescape((tmp_path / "out" / "report.html").read_text())
    assert "The pose found." in html
    (caption,) = set(re.findall(r"Rival 1: ([^<]+) \(margin 1\.11\)", html))
    assert any(caption in reason for reason in found.verdict.reasons)
    plain = Registration(RunResult({"assess": judged("accepted")}, (), ()))
    plain.save(tmp_path / "plain")
    assert "Rival 1" not in (tmp_path / "plain" / "report.html").read_text()
