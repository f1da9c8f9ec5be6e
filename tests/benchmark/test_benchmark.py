from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from helpers_scene import houses
from typer.testing import CliRunner

from mtpcr_geo.benchmark import methods, pairs, published, standins, tables
from mtpcr_geo.benchmark.baselines import fpfh
from mtpcr_geo.benchmark.baselines.open3d import import_open3d
from mtpcr_geo.benchmark.pairs import write_laz
from mtpcr_geo.benchmark.plots import binned, cumulative
from mtpcr_geo.benchmark.protocol import RUNS, read_rows, run_protocol
from mtpcr_geo.benchmark.runs import PairSelection, run_benchmark
from mtpcr_geo.benchmark.worker import StartRange
from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError, MissingPartError, OptionError

NEAR = StartRange(yaw_deg=2.0, tilt_deg=0.5, shift_m=1.0, seed=5)
T_TRUE = transforms.compose(transforms.yaw_matrix(0.7), np.array([400_000.0, 5_400_000.0, 30.0]))


def write_pair(folder: Path, seed: int, group: str = "A-G") -> Path:
    """Two samples of one made-up town, each in a frame of its own."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    target = transforms.apply(T_TRUE, houses(rng, 9_000))
    for name, xyz in (("source", houses(rng, 6_000)), ("target", target)):
        write_laz(folder / f"{name}.laz", ArrayCloud(xyz, None, name))
    facts = {"ground_truth": {"T_target_from_source": T_TRUE.tolist()}, "benchmark": {"group": group}}
    (folder / "pair.json").write_text(json.dumps(facts))
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_pair(folder / "A03-G05", 1)
    write_pair(folder / "other", 2, "pairs")
    return folder


@pytest.fixture(scope="module")
def clouds():
    """A source, turned by 40 degrees, and the target it fits."""
    rng = np.random.default_rng(3)
    T_true = transforms.compose(transforms.yaw_matrix(np.deg2rad(40)), np.array([5.0, -3.0, 1.0]))
    return transforms.apply(transforms.inverse(T_true), houses(rng, 20_000)), houses(rng, 20_000), T_true


def test_protocol_runs_judges_and_resumes(data, tmp_path):
    folders = pairs.pair_folders(data)
    assert [folder.name for folder in folders] == ["A03-G05", "other"]
    method = "icp:voxel=0.5,max_correspondence_distance=3"
    first = run_protocol(folders[:1], [method], tmp_path, starts=1, ranges=NEAR)
    rows = run_protocol(folders, [method], tmp_path, starts=2, ranges=NEAR, jobs=2)
    assert [(r["pair"], r["start"]) for r in rows[:1]] == [("A03-G05", 0)]
    assert rows[0] == first[0]  # not run again
    assert {(r["pair"], r["start"]) for r in rows} == {(f.name, k) for f in folders for k in (0, 1)}
    for row in rows:
        assert row["rotation_deg"] < 0.5
        assert row["translation_m"] < 0.5
        assert row["rmsd_m"] <= row["rms_m"] < 0.5
        assert 0.0 <= row["yaw_deg"] <= 2.0
        assert row["overlap_source"] > 0.9
        assert row["time_s"] > 0
        assert row["memory_mib"] > 10
    assert {row["group"] for row in rows} == {"A-G", "pairs"}
    # fewer starts than there are results: all count
    assert run_protocol(folders, [method], tmp_path, starts=1, ranges=NEAR) == rows


def test_interrupted_results_lose_only_the_run_under_way(data, tmp_path):
    folders = pairs.pair_folders(data, ("other",))
    rows = run_protocol(folders, ["icp"], tmp_path, starts=2, ranges=NEAR)
    path = tmp_path / RUNS
    whole = path.read_text()
    path.write_text(whole[:-40])
    assert read_rows(path) == rows[:1]
    again = run_protocol(folders, ["icp"], tmp_path, starts=2, ranges=NEAR)
    # what was there stays as it was; the same start leads to the same answer
    assert again[0] == rows[0]
    assert again[1]["T_target_source"] == rows[1]["T_target_source"]
    with pytest.raises(OptionError, match="other starts"):
        run_protocol(folders, ["icp"], tmp_path, starts=2, ranges=StartRange(yaw_deg=90.0))
    path.write_text("broken\n" + whole)
    with pytest.raises(InputError, match="line 1"):
        read_rows(path)


def test_run_beyond_its_time_is_stopped_and_has_no_answer(data, tmp_path):
    folders = pairs.pair_folders(data, ("other",))
    (row,) = run_protocol(folders, ["icp"], tmp_path, starts=1, ranges=NEAR, time_limit_s=1e-6)
    assert "time limit" in row["reason"]
    assert row["group"] == "pairs"
    assert not tables.answered(row)


def test_starts_are_the_same_for_every_method_and_within_their_range():
    centroid = np.array([10.0, 20.0, 3.0])
    ranges = StartRange(90.0, 5.0, 50.0, 1)
    T, drawn = ranges.draw("pair", 4, centroid)
    assert np.array_equal(T, ranges.draw("pair", 4, centroid)[0])
    assert not np.array_equal(T, ranges.draw("pair", 5, centroid)[0])
    for k in range(50):
        T, drawn = ranges.draw("pair", k, centroid)
        moved = transforms.apply(T, centroid[None])[0]
        assert np.linalg.norm(moved - centroid) == pytest.approx(drawn["shift_m"])
        assert drawn["shift_m"] <= 50.0
        assert drawn["yaw_deg"] <= 90.0
        assert np.rad2deg(np.arccos(T[2, 2])) == pytest.approx(drawn["tilt_deg"], abs=1e-6)


def test_pair_is_placed_by_its_truth_near_the_origin(data):
    pair = pairs.load_pair(data / "A03-G05")
    low, high = transforms.bounds(pair.target)
    assert np.abs((low + high) / 2).max() <= 1.0
    assert np.abs(transforms.bounds(pair.source)[0] - low).max() < 4.0
    assert np.array_equal(pair.origin, np.floor(pair.origin))


def test_folder_without_pairs_or_with_a_bad_one_is_refused(data, tmp_path):
    with pytest.raises(InputError, match=r"no pair\.json"):
        pairs.pair_folders(tmp_path)
    with pytest.raises(InputError, match="A03-G05, other"):
        pairs.pair_folders(data, ("missing",))
    (tmp_path / "pair.json").write_text('{"ground_truth": {}}')
    with pytest.raises(InputError, match="4x4"):
        pairs.read_facts(tmp_path)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("icpp", "icp"),
        ("fpfh-gnc", "did you mean 'fpfh-kiss-solver'"),
        ("icp:voxl=1", "voxel"),
        ("icp:voxel", "option=value"),
        ("fpfh-svd:voxel=0", "above 0"),
        ("mtpcr-geo:levle=none", "level"),
    ],
)
def test_method_or_option_that_is_not_there_is_named(spec, message):
    with pytest.raises(OptionError, match=message):
        methods.make_method(spec)


def test_missing_library_is_said(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingPartError, match="kiss_matcher"):
        methods.make_method("kiss-matcher")


def test_options_of_a_method():
    assert methods.options_of("a:x=1,y=0.5,z=no,w=word") == {"x": 1, "y": 0.5, "z": False, "w": "word"}
    assert methods.options_of("a") == {}


@pytest.mark.slow
def test_ours_answers_with_a_verdict(clouds):
    source, target, T_true = clouds
    answer = methods.make_method("mtpcr-geo").estimate(source, target, seed=0)
    assert answer.verdict == "accepted"
    assert answer.T_target_source is not None
    assert np.abs(answer.T_target_source - T_true).max() < 0.05
    assert answer.details["held_out_tie_points"] > 10
    blind = methods.make_method("mtpcr-geo").estimate(
        source, np.array(target[:, [0, 1, 2]] * [1, 1, 0]), seed=0
    )
    assert blind.verdict == "refused"


@pytest.mark.parametrize(
    "spec",
    [
        "fpfh-ransac:voxel=2,iterations=50000",
        "fpfh-fgr:voxel=2",
        "fpfh-svd:voxel=2",
        "fpfh-kiss-solver:voxel=2",
    ]
    + ["kiss-matcher:voxel=1.5", "kiss-matcher:voxel=2,quatro=yes"],
)
def test_baselines_register_an_easy_pair(spec, clouds, capfd):
    if "kiss" in spec:
        pytest.importorskip("kiss_matcher", reason="kiss-matcher is not installed (extra benchmark)")
    source, target, T_true = clouds
    answer = methods.make_method(spec).estimate(source, target, seed=1)
    assert answer.verdict == "unjudged"
    T = answer.T_target_source
    assert T is not None
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.rad2deg(transforms.rotation_angle(T[:3, :3] @ T_true[:3, :3].T)) < 1.0
    assert np.linalg.norm(T[:3, 3] - T_true[:3, 3]) < 0.5


def test_least_squares_fit_is_exact():
    rng = np.random.default_rng(0)
    T = transforms.compose(
        transforms.axis_angle_matrix(np.array([0.6, 0.0, 0.8]), 2.0), np.array([1.0, 2, 3])
    )
    xyz = rng.normal(size=(10, 3))
    assert np.allclose(fpfh.best_rigid(xyz, transforms.apply(T, xyz)), T)


def row(method="a", pair="p", group="A-G", verdict="unjudged", errors=None, **more):
    """One run by hand; errors are degrees and metres, None for no answer."""
    out = {"method": method, "pair": pair, "group": group, "verdict": verdict, "time_s": 1.0} | more
    out |= {"memory_mib": 100.0, "overlap_source": 0.2, "overlap_target": 0.1, "yaw_deg": 10.0}
    if errors is not None:
        names = ("translation_m", "plan_m", "rmsd_m", "rms_m")
        out |= {"rotation_deg": errors[0], "height_m": -errors[1], **dict.fromkeys(names, errors[1])}
    return out


def test_counts_by_hand():
    rows = [
        row(verdict="accepted", errors=(0.1, 0.2)),
        row(verdict="accepted", errors=(1.0, 1.0)),
        row(verdict="accepted", errors=(6.0, 1.0)),
        row(verdict="doubtful", errors=(1.0, 3.0)),
        row(verdict="refused", errors=(0.1, 0.1)),
        row(verdict="refused"),
        row(verdict="unjudged"),
        row(verdict="unjudged", errors=(4.9, 1.9)),
    ]
    s = tables.summarise(rows)
    assert s["runs"] == 8
    assert s["answered"] == 5
    assert s["success_5deg_2m_pct"] == pytest.approx(100 * 3 / 8)
    assert s["success_0.2deg_0.5m_pct"] == pytest.approx(100 * 1 / 8)
    assert (s["wrong_answers"], s["false_accepts"]) == (2, 1)
    assert [s[name] for name in tables.VERDICTS] == [3, 1, 2, 2]
    assert s["rotation_deg_mean"] == pytest.approx((0.1 + 1 + 6 + 1 + 0.1 + 4.9) / 6)
    assert s["translation_m_median"] == pytest.approx(1.0)
    assert s["height_abs_m_mean"] == pytest.approx((0.2 + 1 + 1 + 3 + 0.1 + 1.9) / 6)
    # errors must lie below the thresholds, not at them
    assert not tables.success(row(errors=(5.0, 1.0)))


def test_tables_keep_our_figures_apart_from_the_papers():
    rows = [row(pair="standin_A03-G05", errors=(1.0, 2.5)), row(pair="standin_A03-G05", errors=(3.0, 0.5))]
    rows += [row(pair="standin_G01-G02", group="G-G", errors=(0.1, 0.1))]
    second = tables.table_2(rows)
    assert [line["figures"] for line in second[:3]] == ["measured here"] * 3
    assert second[0] == {
        "figures": "measured here", "method": "a", "metric": "e_r_deg",
        "standin_A03-G05": 2.0, "standin_G01-G02": pytest.approx(0.1),
    }  # fmt: skip
    paper = next(line for line in second if line["method"] == "MT-PCR" and line["metric"] == "e_t_m")
    assert (paper["standin_A03-G05"], paper["standin_G01-G02"]) == (0.794, 0.820)
    assert next(line for line in second if line["method"] == "FPFH+SVD")["figures"].endswith("not printed")
    third = tables.table_3(rows)
    assert third[0] == {"figures": "measured here", "method": "a", "A-G": 50.0, "G-G": 100.0}
    assert third[-1] == {"figures": "paper, GrAco", "method": "MT-PCR", "A-G": 97.25, "G-G": 96.67}
    assert all(line["figures"] == "measured here" for line in tables.table_3(rows, tables.STRICT))
    first = tables.table_1({"standin_A03-G03": (1.0, 2.0, 3.0)}, [row(pair="standin_A03-G03")])
    assert first[0]["dx_m"] == 1.0
    assert first[0]["paper_overlap_target_pct"] == 22.28
    assert (
        tables.table_2([row(pair="unknown", group="pairs", errors=(1, 1))])[-1]["figures"] == "measured here"
    )


def test_ablation_lines():
    parts = {"RES": "res", "FOCUS": "focus", "IE": "enhance"}
    rows = [row("mtpcr-geo:profile=paper,res=no,focus=yes", errors=(1.0, 1.0)), row("icp", errors=(1.0, 1.0))]
    lines = tables.table_4(rows, parts)
    assert (lines[0]["RES"], lines[0]["FOCUS"], lines[0]["IE"]) == (False, True, True)
    assert len(lines) == 1 + 2 * len(published.TABLE_IV)
    assert tables.table_4(rows[1:], parts) == []


def test_curves_by_hand():
    x, y = cumulative([3.0, 1.0, 2.0], 4)
    assert x.tolist() == [1.0, 2.0, 3.0]
    assert y.tolist() == [25.0, 50.0, 75.0]
    bins = binned([0.0, 5.0, 10.0, 20.0, 25.0], [True, False, True, True, True], [0, 10, 20])
    assert bins == [
        {"middle": 5.0, "success_pct": 50.0, "runs": 2.0},
        {"middle": 15.0, "success_pct": 100.0, "runs": 2.0},
    ]


def test_papers_figures_are_whole():
    assert set(published.TABLE_II) == set(published.TABLE_III)
    for errors in published.TABLE_II.values():
        assert {len(values) for values in errors.values()} == {14}
    full = next(row for row in published.TABLE_IV if row.res and row.focus and row.ie)
    at = [c.name for c in published.COMBINATIONS].index("A03-G05")
    assert full.a03_g05 == tuple(published.TABLE_II["MT-PCR"][metric][at] for metric in published.METRICS)


def test_stand_in_has_the_papers_overlap_and_is_kept(tmp_path):
    chosen = {one.combination.name: one for one in standins.stand_ins()}
    assert len(chosen) == 14
    assert chosen["A04-G01"].given
    assert not chosen["A02-G05"].given
    assert chosen["A02-G05"].extent_and_overlap.overlap_source_pct == pytest.approx(16.96)
    small = standins.StandIn(
        published.Combination("A03", "G05"), published.Extent(150, 150, 30, 20, 25), True, "suburb", 3
    )
    place = standins.write_stand_in(tmp_path, small, density=0.05)
    facts = json.loads((place / "pair.json").read_text())
    assert "not GrAco" in facts["benchmark"]["stand_in"]
    assert 0.1 < facts["overlap"]["source_cells_near_target"] < 0.4
    before = (place / "source.laz").stat().st_mtime_ns
    assert standins.write_stand_in(tmp_path, small, density=0.05) == place
    assert (place / "source.laz").stat().st_mtime_ns == before
    with pytest.raises(OptionError, match="made otherwise"):
        standins.write_stand_in(tmp_path, small, density=0.06)


@pytest.mark.parametrize("pair", [("G04", "G05"), ("A01", "A02")])
def test_stand_ins_of_two_alike(pair):
    combination = published.Combination(*pair)
    small = standins.StandIn(combination, published.Extent(150, 150, 30, 40, 60), True, "suburb", 3)
    made = standins.simulate_stand_in(small, density=0.05)
    moved = transforms.apply(made.T_target_source, made.source.xyz)
    assert np.abs(np.median(moved[:, 2]) - np.median(made.target.xyz[:, 2])) < 5.0
    assert made.overlap_source == pytest.approx(0.4, abs=0.12)
    assert made.overlap_target == pytest.approx(0.6, abs=0.15)


def test_benchmark_leaves_tables_and_plots(data, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra benchmark)")
    selection = PairSelection(data=(data,), only=("A03-G05",))
    run_benchmark(selection, ["icp"], tmp_path, starts=2, ranges=NEAR)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "runs.jsonl", "methods.log", "runs.csv", "protocol.json", "methods.csv", "pairs.csv", "results.json",
        "tables.md", "cumulative_errors.png", "success_overlap.png", "success_yaw.png",
    }  # fmt: skip
    with (tmp_path / "runs.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["success_5deg_2m"] for line in lines] == ["True", "True"]
    assert "Table II" in (tmp_path / "tables.md").read_text()
    assert json.loads((tmp_path / "results.json").read_text())["methods"][0]["success_5deg_2m_pct"] == 100.0


def test_verb_prints_what_it_found_and_says_what_is_wrong(data, tmp_path):
    out = ["benchmark", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(
        app, [*out, "--data", str(data), "--only", "other", "-m", "icp", "--starts", "1"]
    )
    assert result.exit_code == 0, result.output
    assert "| icp | 1 | 1 |" in result.output
    assert CliRunner().invoke(app, out).exit_code == 2
    assert CliRunner().invoke(app, [*out, "--data", str(data), "-m", "none"]).exit_code == 2
    assert CliRunner().invoke(app, [*out, "--data", str(tmp_path)]).exit_code == 5


@pytest.mark.parametrize(("n", "m"), [(4, 7), (700, 2300), (513, 1), (0, 5)])
def test_mutual_matches_are_each_others_nearest(n, m):
    o3d = import_open3d()
    rng = np.random.default_rng(n)
    data = [rng.uniform(0, 100, (count, 33)) for count in (n, m)]
    described = []
    for one in data:
        feature = o3d.pipelines.registration.Feature()
        feature.data = one.T
        described.append(fpfh.Features(o3d.geometry.PointCloud(), feature))
    found = fpfh.mutual_matches(*described)
    if not n:
        assert found.shape == (0, 2)
        return
    squared = (data[0] ** 2).sum(1)[:, None] + (data[1] ** 2).sum(1) - 2 * data[0] @ data[1].T
    there, back = squared.argmin(axis=1), squared.argmin(axis=0)
    assert found.tolist() == [[i, j] for i, j in enumerate(there) if back[j] == i]
