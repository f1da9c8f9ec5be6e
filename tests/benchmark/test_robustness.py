"""The robustness benchmark: its cases, its rows, and the sites that repeat themselves."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers_paths import REPOSITORY
from helpers_scene import houses
from typer.testing import CliRunner

from mtpcr_geo.benchmark.metrics import overlap_ratios
from mtpcr_geo.benchmark.pairs import write_laz
from mtpcr_geo.benchmark.robustness import drive
from mtpcr_geo.benchmark.robustness.cases import (
    Case,
    CommonFrame,
    DiscClouds,
    ElsewhereClouds,
    MirroredClouds,
    middle_of_overlap,
    target_crs_of,
)
from mtpcr_geo.benchmark.robustness.places import dense_places, shared_places
from mtpcr_geo.benchmark.robustness.results import (
    RowFile,
    false_accept,
    read_rows,
    report,
    spreads,
    summarise,
    swaps,
)
from mtpcr_geo.benchmark.robustness.runner import COLUMNS, errors_of, run_case
from mtpcr_geo.benchmark.robustness.suites import SUITES, SuiteOptions, cases, suite_names
from mtpcr_geo.benchmark.simulator import repeating
from mtpcr_geo.benchmark.simulator.repeating import repeating_pair
from mtpcr_geo.benchmark.simulator.scan_plots import plot_options, simulate_plot
from mtpcr_geo.benchmark.worker import StartRange
from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError, OptionError

SIZE = 0.4
DATA = REPOSITORY.parent / "shared" / "data"


@dataclass(frozen=True)
class Town:
    """Two samples of one made-up town."""

    seed: int = 1

    def make(self) -> CommonFrame:
        rng = np.random.default_rng(self.seed)
        return CommonFrame(houses(rng, 6_000), houses(rng, 9_000))


@dataclass(frozen=True)
class Dying:
    """Clouds whose making ends the process."""

    def make(self) -> CommonFrame:
        raise SystemExit(3)


@dataclass(frozen=True)
class Missing:
    """Clouds that are not there."""

    def make(self) -> CommonFrame:
        raise InputError("no such file")


def row(**values):
    """A row with what is given, and nothing else."""
    return (
        dict.fromkeys(COLUMNS) | {"suite": "pairs", "site": "a", "kind": "whole", "has_truth": True} | values
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    for number in range(2):
        rng = np.random.default_rng(number)
        place = folder / f"town{number}"
        place.mkdir()
        for name, count in (("source", 6_000), ("target", 9_000)):
            write_laz(place / f"{name}.laz", ArrayCloud(houses(rng, count), None, name))
        facts = {"crs": "local", "ground_truth": {"T_target_from_source": np.eye(4).tolist()}}
        (place / "pair.json").write_text(json.dumps(facts))
    return folder


def test_truth_recovers_the_coordinates_from_any_start():
    made = Town().make()
    for start in range(3):
        case = Case("pairs", "town", "whole", Town(), start=start, ranges=StartRange(tilt_deg=10.0))
        clouds = case.clouds()
        assert clouds.T_target_source is not None
        back = transforms.apply(clouds.T_target_source, clouds.source)
        assert np.abs(back - made.source).max() < 1e-9
        assert np.array_equal(clouds.target, made.target)
        assert errors_of(clouds.T_target_source, clouds)["shift_err_m"] < 1e-9
    assert clouds.options == {"level": "none", "recording": False}


def test_errors_are_those_of_the_middle_of_the_overlap():
    clouds = Case("pairs", "town", "whole", Town()).clouds()
    assert clouds.T_target_source is not None
    off = transforms.translation((0.3, -0.4, 0.1)) @ transforms.about(
        clouds.middle, transforms.yaw_matrix(np.deg2rad(1.0))
    )
    found = errors_of(off @ clouds.T_target_source, clouds)
    assert found["rot_err_deg"] == pytest.approx(1.0)
    assert found["plan_err_m"] == pytest.approx(0.5)
    assert found["dz_err_m"] == pytest.approx(0.1)
    assert found["far_err_m"] > 0.5
    assert found["right"]
    assert not found["precise"]
    assert np.allclose(found["T_answer_true"], off)


def test_middle_of_the_overlap_is_the_sources_part_in_the_target():
    x, y = np.meshgrid(np.arange(100.0), np.arange(10.0))
    strip = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    middle = middle_of_overlap(CommonFrame(strip, strip[strip[:, 0] >= 80]))
    assert middle == pytest.approx([89.5, 4.5, 0.0])
    assert middle_of_overlap(CommonFrame(strip, strip + 500.0)) == pytest.approx([49.5, 4.5, 0.0])


def test_levelled_case_keeps_the_targets_crs_and_its_truth():
    @dataclass(frozen=True)
    class Far:
        def make(self) -> CommonFrame:
            return replace(Town().make(), target_crs="EPSG:2154", origin=(7e5, 6.6e6, 100.0))

    clouds = Case("tilts", "town", "whole", Far(), level="auto").clouds()
    assert clouds.options["target_crs"] == "EPSG:2154"
    assert clouds.options["source_crs"] == "local"
    assert clouds.target.mean(axis=0)[1] > 6e6
    assert clouds.T_target_source is not None
    back = transforms.apply(clouds.T_target_source, clouds.source)
    assert np.abs(back - [7e5, 6.6e6, 100.0] - Town().make().source).max() < 1e-6
    assert errors_of(clouds.T_target_source, clouds)["shift_err_m"] < 1e-6
    assert target_crs_of({"crs": "not in the header; RD New EPSG:28992"}) == "EPSG:28992"
    assert target_crs_of({"crs": "none: local metres"}) is None


def test_places_lie_where_both_clouds_have_points_and_apart():
    rng = np.random.default_rng(0)
    one = rng.uniform(0, [200, 100], (40_000, 2))
    other = one[one[:, 0] > 120] + 0.1
    places = shared_places(one, other, 3, np.random.default_rng(4))
    assert (places[:, 0] > 120).all()
    assert min(np.hypot(*(a - b)) for k, a in enumerate(places) for b in places[:k]) > 20
    assert np.array_equal(places, shared_places(one, other, 3, np.random.default_rng(4)))
    assert dense_places(one, 1, rng).shape == (1, 2)
    with pytest.raises(InputError, match="share no ground"):
        shared_places(one, one + 1000.0, 1, rng)


def test_suites_list_the_runs_that_are_asked_for(data):
    options = SuiteOptions(data=data, starts=2, seed=5)
    chosen = {name: list(cases([name], options)) for name in SUITES}
    counts = {name: len(runs) for name, runs in chosen.items()}
    assert counts == {
        "pairs": 4, "tilts": 4, "discs": 36, "degraded": 26, "plots": 100, "swap": 2, "repeating": 60,
        "repeating-apart": 60, "symmetric": 40, "unrelated": 4, "mirrored": 14, "elsewhere": 12,
        "standins": 28, "overlap": 49,
    }  # fmt: skip
    everything = [case for runs in chosen.values() for case in runs]
    assert len({case.name for case in everything}) == len(everything)
    assert pickle.loads(pickle.dumps(everything)) == everything
    assert {case.has_truth for case in chosen["unrelated"] + chosen["repeating-apart"]} == {False}
    assert {case.has_truth for case in chosen["mirrored"] + chosen["elsewhere"]} == {False}
    assert all(case.level == "auto" and case.ranges.tilt_deg == 10.0 for case in chosen["tilts"])
    assert len({case.batch for case in chosen["discs"]}) == 2
    assert len(list(cases(["discs", "pairs"], replace(options, only=("town1",))))) == 20
    other = list(cases(["plots"], replace(options, seed=6)))
    assert not {case.seed for case in other} & {case.seed for case in chosen["plots"]}


def test_discs_elsewhere_share_nothing_and_mirrored_ones_are_reflected(data):
    folder = data / "town1"
    disc = DiscClouds(folder, 20.0, 0).make()
    elsewhere = ElsewhereClouds(folder, 20.0, 0).make()
    assert np.array_equal(elsewhere.source, disc.source)
    away = np.hypot(*(elsewhere.target[:, :2] - disc.source[:, :2].mean(axis=0)).T)
    assert away.min() > 30.0
    mirrored = MirroredClouds(folder, 20.0, 0).make()
    assert np.array_equal(mirrored.target, disc.target)
    assert np.allclose(mirrored.source[:, 1:], disc.source[:, 1:])
    assert np.allclose(mirrored.source[:, 0] + disc.source[:, 0], 2 * np.median(disc.source[:, 0]))


def test_suite_that_is_not_there_is_named():
    assert suite_names(["starts", "pairs"]) == ["pairs"]
    assert suite_names(["all"]) == list(SUITES)
    with pytest.raises(OptionError, match="discs"):
        suite_names(["disc"])
    with pytest.raises(OptionError, match="--data"):
        list(cases(["pairs"], SuiteOptions()))


@pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data beside the checkout")
def test_unrelated_runs_of_the_real_pairs_are_enough():
    options = SuiteOptions(data=DATA)
    assert len(list(cases(["unrelated"], options))) >= 130
    assert len(list(cases(["discs"], options))) == 7 * 6 * 3
    assert len(list(cases(["pairs"], options))) == 90


@pytest.mark.parametrize("kind", repeating.KINDS)
def test_repeating_site_shares_what_was_asked(kind):
    source, target = repeating_pair(kind, 3, size=SIZE)
    share = overlap_ratios(source, target)[0]
    assert share == pytest.approx(repeating.OVERLAP, abs=0.05)
    assert np.ptp(source, axis=0)[:2] == pytest.approx(SIZE * repeating.SOURCE_M, abs=0.5)
    assert np.ptp(target, axis=0)[:2] == pytest.approx(SIZE * repeating.TARGET_M, abs=0.5)
    assert 3.5 < len(target) / np.prod(SIZE * repeating.TARGET_M) < 13.0
    # the land lies where it lies in both: lowest heights of common cells of 4 m agree
    steps = lowest_steps(source, target)
    assert len(steps) > 80
    assert abs(np.median(steps)) < 0.05
    assert np.quantile(np.abs(steps), 0.7) < 0.15


def lowest_steps(source, target, cell=4.0):
    """Differences of the lowest heights in common cells, metres."""
    lows = []
    for xyz in (source, target):
        keys, number = np.unique(np.floor(xyz[:, :2] / cell).astype(int), axis=0, return_inverse=True)
        low = np.full(len(keys), np.inf)
        np.minimum.at(low, number.ravel(), xyz[:, 2])
        lows.append(dict(zip(map(tuple, keys.tolist()), low, strict=True)))
    return np.array([lows[0][key] - lows[1][key] for key in lows[0].keys() & lows[1].keys()])


def test_repeating_site_depends_on_its_seed_only():
    first, again, other = (repeating_pair("warehouses", seed, size=SIZE)[1] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert first.shape != other.shape


def test_parts_of_a_repeating_site_share_nothing_when_apart():
    source, target = repeating_pair("warehouses", 4, apart=True, size=SIZE)
    assert overlap_ratios(source, target) == (0.0, 0.0)


def test_repeating_site_has_irregularities_that_both_clouds_show():
    """A period away the terrain and the trees differ; at the truth they agree."""
    source, target = repeating_pair("orchard", 2, size=SIZE)
    true = np.quantile(np.abs(lowest_steps(source, target)), 0.5)
    away = np.quantile(np.abs(lowest_steps(source + [20.0, 15.0, 0.0], target)), 0.5)
    assert away > 5 * true


def test_plot_is_scanned_within_its_radius_and_lies_in_the_flight():
    pytest.importorskip("embreex")
    options = replace(plot_options("forest", 7), scans=1, radius_m=15.0, extent_m=100.0, air_density=2.0)
    low, high = simulate_plot(options)
    assert np.ptp(low, axis=0)[:2].max() <= 30.0
    assert len(low) > 20_000
    assert overlap_ratios(low, high)[0] > 0.95
    again = simulate_plot(options)
    assert np.array_equal(low, again[0])
    assert np.array_equal(high, again[1])


def test_plots_cover_the_range_that_is_asked_for():
    plots = [plot_options("forest", seed) for seed in range(200)]
    for name, low, high in (("radius_m", 15, 40), ("slope", 0, 0.3), ("air_density", 2, 30), ("scans", 1, 5)):
        values = np.array([getattr(plot, name) for plot in plots], float)
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high


def test_rows_come_back_as_they_were_written(tmp_path):
    path = tmp_path / "rows.csv"
    first = row(
        case="a",
        verdict="accepted",
        right=True,
        rot_err_deg=0.1 + 0.2,
        reason='3, "4"\nand 5',
        metrics={"x": [1, None]},
    )
    with RowFile(path) as file:
        file.append(first)
        file.append(row(case="b", verdict="failed", radius=None))
    found = read_rows(path)
    assert found[0]["rot_err_deg"] == 0.1 + 0.2
    assert found[0]["metrics"] == {"x": [1, None]}
    assert found[0]["reason"] == '3, "4" and 5'
    assert found[0]["right"] is True
    assert found[1]["radius"] is None
    whole = path.read_text()
    path.write_text(whole[:-20])
    assert [one["case"] for one in read_rows(path)] == ["a"]
    with RowFile(path) as file:
        file.append(row(case="c", verdict="refused"))
    assert [one["case"] for one in read_rows(path)] == ["a", "c"]
    path.write_text("case,other\n")
    with pytest.raises(OptionError, match="other columns"):
        RowFile(path)


def test_runs_resume_and_crashes_are_rows(tmp_path):
    path = tmp_path / "rows.csv"
    near = StartRange(yaw_deg=2.0, shift_m=1.0)
    chosen = [
        Case("pairs", "town", "whole", Town(), ranges=near),
        Case("pairs", "dying", "whole", Dying()),
        Case("pairs", "missing", "whole", Missing(), has_truth=False),
    ]
    rows = {one["site"]: one for one in drive.run_cases(chosen, path, jobs=1)}
    assert rows["town"]["T_answer_true"] is not None
    assert rows["town"]["time_s"] > 0
    assert rows["town"]["metrics"]["stage_s"]
    assert rows["dying"]["verdict"] == "failed"
    assert "exit code 3" in rows["dying"]["reason"]
    assert rows["missing"]["verdict"] == "failed"
    assert "no such file" in rows["missing"]["reason"]
    before = path.read_bytes()
    assert drive.run_cases(chosen, path, jobs=2) == list(read_rows(path))
    assert path.read_bytes() == before
    with pytest.raises(OptionError, match="same name"):
        drive.run_cases(chosen[:1] * 2, path)


def test_run_beyond_its_time_is_stopped(tmp_path):
    chosen = [Case("pairs", "town", "whole", Town())]
    (found,) = drive.run_cases(chosen, tmp_path / "rows.csv", time_limit_s=1e-6)
    assert found["verdict"] == "failed"
    assert "stopped" in found["reason"]
    assert found["points_source"] == 6_000


def test_cloud_of_a_few_points_is_a_row_too():
    found = run_case(Case("discs", "missing", "disc", Missing()))
    assert found["verdict"] == "failed"
    assert found["suite"] == "discs"


def test_sums_count_what_is_right_accepted_and_wrongly_accepted():
    rows = [
        row(
            case="1",
            verdict="accepted",
            right=True,
            precise=True,
            rot_err_deg=0.1,
            plan_err_m=0.2,
            dz_err_m=-0.3,
        ),
        row(
            case="2",
            verdict="doubtful",
            right=True,
            precise=False,
            rot_err_deg=0.3,
            plan_err_m=0.6,
            dz_err_m=0.1,
        ),
        row(case="3", verdict="accepted", right=False, rot_err_deg=170.0, plan_err_m=50.0, dz_err_m=3.0),
        row(case="4", verdict="failed", right=None),
        row(case="5", suite="unrelated", site="b", verdict="refused", has_truth=False),
        row(case="6", suite="unrelated", site="b", kind="disc", verdict="accepted", has_truth=False),
        row(case="7", suite="discs", radius=15.0, verdict="accepted", right=True, time_s=3.0),
    ]
    lines = {(line["suite"], line["group"]): line for line in summarise(rows)}
    line = lines["pairs", "a"]
    assert (line["runs"], line["accepted"], line["right"]) == (4, 2, 2)
    assert (line["right_accepted"], line["wrong_accepted"], line["precise"]) == (1, 1, 1)
    assert (line["doubtful"], line["failed"]) == (1, 1)
    # errors of the right runs only
    assert line["rot_deg_max"] == 0.3
    assert line["plan_m_median"] == pytest.approx(0.4)
    assert line["dz_m_max"] == 0.3
    assert lines["unrelated", "all"]["wrong_accepted"] == 1
    assert lines["unrelated", "all"]["right"] is None
    assert lines["discs", "radius 15 m"]["time_s_median"] == 3.0
    assert [false_accept(one) for one in rows] == [False, False, True, False, False, True, False]
    text = report(rows)
    assert "| 3 | accepted |" in text
    assert "| 5 |" not in text


def test_spread_is_the_largest_distance_between_two_poses():
    poses = [np.eye(4), transforms.translation((0.003, 0.0, 0.0)), transforms.translation((0.0, 0.004, 0.0))]
    rows = [
        row(case=str(k), verdict="accepted", right=True, middle=[5.0, 6.0, 7.0], T_answer_true=T.tolist())
        for k, T in enumerate(poses)
    ]
    (line,) = spreads([*rows, row(case="9", verdict="refused", right=False)])
    assert line["right_runs"] == 3
    assert line["apart_mm"] == pytest.approx(5.0)
    assert line["apart_deg"] == pytest.approx(0.0)
    assert spreads(rows[:1]) == []
    assert swaps([*rows, row(case="s", swap_verdict="accepted", swap_mm=1.0)])[0]["swap_mm"] == 1.0


def test_command_runs_suites_and_writes_their_sums(data, tmp_path):
    out = tmp_path / "out"
    command = ["benchmark", "--robustness", "pairs swap", "--data", str(data), "--out", str(out)]
    done = CliRunner().invoke(app, [*command, "--starts", "1", "--only", "town0", "--shift", "5"])
    assert done.exit_code == 0, done.output
    assert "| pairs | town0 | 1 |" in done.output
    rows = read_rows(out / "robustness.csv")
    assert [one["suite"] for one in rows] == ["pairs", "swap"]
    assert "## Both ways" in (out / "robustness.md").read_text() or rows[1]["swap_mm"] is None
    assert {path.name for path in Path(out).iterdir()} == {"robustness.csv", "robustness.md"}


def test_suites_run_with_options_of_register(data, tmp_path):
    out = tmp_path / "out"
    command = ["benchmark", "--robustness", "pairs", "--data", str(data), "--out", str(out), "--starts", "1"]
    chosen = ["--only", "town0", "-m", "mtpcr-geo:cell=2,proposals=no"]
    done = CliRunner().invoke(app, [*command, *chosen])
    assert done.exit_code == 0, done.output
    (one,) = read_rows(out / "robustness.csv")
    assert one["case"].endswith("start0/cell=2.0/proposals=False")
    assert one["metrics"]["cell_m"] == 2.0
    # the same options in other words are the same run, and other ones want a folder of their own
    again = CliRunner().invoke(
        app, [*command, "--only", "town0", "-m", "mtpcr-geo:proposals=no,cell=2.0,focus=yes"]
    )
    assert again.exit_code == 0, again.output
    assert len(read_rows(out / "robustness.csv")) == 1
    other = CliRunner().invoke(app, [*command, "--only", "town0"])
    assert other.exit_code == 2
    assert "runs with other options" in " ".join(other.output.split())


@pytest.mark.parametrize(
    ("method", "says"),
    [
        ("icp", "takes one method, mtpcr-geo"),
        ("mtpcr-geo:cel=2", "no option 'cel'; did you mean 'cell'?"),
        ("mtpcr-geo:level=none", "set 'level' themselves"),
        ("mtpcr-geo:matcher=rootsift,proposals=no", "belongs to --matcher correlation"),
    ],
)
def test_suites_run_no_other_method(method, says, data, tmp_path):
    command = ["benchmark", "--robustness", "pairs", "--data", str(data), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*command, "-m", method])
    assert done.exit_code == 2
    assert says in " ".join(done.output.split())
