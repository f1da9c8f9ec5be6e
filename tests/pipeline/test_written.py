"""What a run wrote, and what it withheld: terminal, report, run.json, transform.json and Python say the "
"same."""

from __future__ import annotations

import io
import json
import re
from html import unescape
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_scene import make_pair
from rich.console import Console

from mtpcr_geo.cli.summary import print_registration, print_run
from mtpcr_geo.core.types import Rival, Verdict
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.runner import RunResult, execute
from mtpcr_geo.registration import Registration, build_pipeline, register

FAR, NEAR = Rival(41.0, 0.0, 0.0, 1.1, True), Rival(1.0, 0.0, 0.0, 1.1, False)
REFUSED = {
    "registered.laz",
    "registered.tif",
    "registered.qml",
    "difference.tif",
    "difference.qml",
    "source.tif.points",
    "transform.json",
    "transform.cloudcompare.txt",
    "transform.pdal.json",
}
CASES = {
    "accepted": (Verdict("accepted", ("fits",), {}), set()),
    "doubtful": (Verdict("doubtful", ("margin",), {}, (NEAR,)), set()),
    "ambiguous": (Verdict("doubtful", ("margin",), {}, (FAR,)), {"registered.laz"}),
    "refused": (Verdict("refused", ("no",), {}), REFUSED),
}


def terminal(registration: Registration) -> str:
    text = io.StringIO()
    print_registration(registration, console=Console(file=text, width=400, highlight=False))
    return text.getvalue()


def judged(verdict: Verdict) -> Registration:
    return Registration(RunResult({"assess": make_pair(3000).with_(verdict=verdict)}, (), ()))


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("case", sorted(CASES))
def test_all_say_the_same(case, force, tmp_path):
    verdict, withheld = CASES[case]
    out = tmp_path / "out"
    found = judged(verdict)
    found.save(out, force=force)
    there = {path.name for path in out.rglob("*") if path.is_file()}
    missing = set() if force else withheld
    forced = force and bool(withheld)
    assert REFUSED - there == missing

    run = json.loads((out / "run.json").read_text())
    assert {Path(one["path"]).name for one in run["not_written"]} == missing
    # the report and run.json themselves are written last
    assert {Path(path).name for path in run["outputs"]} | {"run.json"} == there
    assert {one["why"] for one in run["not_written"]} == ({verdict.withholds_cloud} if missing else set())
    assert run["forced"] == found.forced == forced
    assert [one["far"] for one in run["rivals"]] == [rival.far for rival in verdict.rivals]
    if "transform.json" in there:
        stated = json.loads((out / "transform.json").read_text())["verdict"]
        assert (stated["name"], stated["forced"]) == (verdict.name, forced)
        assert stated["reasons"] == run["reasons"]

    html = unescape((out / "report.html").read_text())
    (sentence,) = re.findall(r'<p class="small">(Written: .*?)</p>', html)
    for name in there - {"report.html", "run.json"}:
        assert name in sentence.partition("Not written")[0]
    for name in missing:
        assert name in sentence.partition("Not written")[2]
    assert ("that was forced" in sentence) == forced

    said = terminal(found)
    assert ("not written: the registered cloud" in said) == bool(missing)
    assert ("and the transform, since the verdict is refused; --force" in said) == (missing == REFUSED)
    assert ("since that was forced" in said) == forced
    assert set(found.not_written) >= ({"registered"} if missing else set())
    if not missing:
        assert found.not_written == {}


def test_saving_with_force_what_was_withheld_before(tmp_path):
    found = judged(CASES["ambiguous"][0])
    found.save(tmp_path / "first")
    assert "registered" in found.not_written
    found.save(tmp_path / "second", force=True)
    assert found.not_written == {}
    assert found.forced
    run = json.loads((tmp_path / "second" / "run.json").read_text())
    assert (run["not_written"], run["forced"]) == ([], True)


def test_a_registration_that_was_written_can_be_saved_again(town_files, tmp_path, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.verdict.decision.assess", lambda *a, **k: CASES["ambiguous"][0])
    found = register(town_files[0], town_files[1], tmp_path / "first", recording=False)
    assert set(found.not_written) == {"registered"}
    found.save(tmp_path / "second", force=True)
    assert (tmp_path / "second" / "registered.laz").exists()
    run = json.loads((tmp_path / "second" / "run.json").read_text())
    assert (run["not_written"], run["forced"]) == ([], True)


def test_a_pipeline_names_its_own_way_to_force(town_files, tmp_path, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.verdict.decision.assess", lambda *a, **k: CASES["refused"][0])
    stages = build_pipeline(town_files[0], town_files[1], tmp_path / "out", RegisterOptions(recording=False))
    result = execute(grammar.link(grammar.parse(grammar.dump(stages))))
    text = io.StringIO()
    print_run(result, console=Console(file=text, width=400, highlight=False))
    assert "force of mtpcr.apply and mtpcr.write_transform" in text.getvalue()
    assert "--force" not in text.getvalue()
    skipped = {record.tag: record.skipped for record in result.done if record.skipped}
    assert skipped == dict.fromkeys(
        ["transform", "matrix", "pdal", "moved", "registered"], "the verdict is refused"
    )


def test_no_transform_is_given_as_the_reason_where_none_was_found(town_files, tmp_path, monkeypatch):
    from mtpcr_geo.core.errors import RegistrationError

    def nothing(*args, **kwargs):
        raise RegistrationError("nothing looks alike; give other clouds")

    monkeypatch.setattr("mtpcr_geo.match.correlation.match", nothing)
    found = register(town_files[0], town_files[1], tmp_path / "out", recording=False, force=True)
    assert found.not_written["registered"] == found.not_written["transform"] == "no transform was found"
    assert not found.forced
    assert "--force" not in terminal(found)


def test_applying_a_transform_that_was_not_accepted_warns(tmp_path):
    from mtpcr_geo.export.transform import doubts_of

    said = {}
    for case in ("accepted", "ambiguous", "refused"):
        judged(CASES[case][0]).save(tmp_path / case, force=True)
        said[case] = doubts_of(tmp_path / case / "transform.json")
    assert said == {
        "accepted": None,
        "ambiguous": "the verdict on this transform is doubtful and its files were forced: margin",
        "refused": "the verdict on this transform is refused and its files were forced: no",
    }


def test_a_scale_is_metres_where_the_registered_cloud_has_degrees(
    town_files: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    register(
        *town_files, out, out_crs="EPSG:4326+7837", target_crs="EPSG:25833+7837",
        source_crs="EPSG:25833+7837", scale=0.001, recording=False,
    )  # fmt: skip
    with laspy.open(out / "registered.laz") as file:
        assert list(file.header.scales) == pytest.approx([1e-8, 1e-8, 1e-3])
        plan = np.asarray(file.read().xyz)[:, :2]
    # of some 120 m, in steps of a millimetre
    assert min(len(np.unique(values)) for values in plan.T) > 1000
