"""Priors for local clouds: what is known of place and yaw, from options to the verdict."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_scene import ORIGIN, town
from pyproj import CRS, Transformer
from typer.testing import CliRunner

import mtpcr_geo as mg
from mtpcr_geo.benchmark.metrics import centroid_errors, rotation_error_deg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.cli import app as cli
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import CrsError, InputError, OptionError
from mtpcr_geo.core.types import Pair
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.pipeline.options import PriorOptions, RegisterOptions
from mtpcr_geo.pipeline.stages.matching import MatchOptions
from mtpcr_geo.pipeline.stages.priors import known_place, prior_of
from mtpcr_geo.registration import read_options

YAW_DEG = 118.0
UTM33 = CRS.from_epsg(25833)


class Site:
    """A local scan of a part of a town in UTM, and the truth between them."""

    def __init__(self) -> None:
        rng = np.random.default_rng(11)
        self.target = town(rng, 60_000) + ORIGIN
        part = town(rng, 40_000)
        part = part[np.hypot(part[:, 0] - 15.0, part[:, 1] + 10.0) < 40.0]
        turn = transforms.yaw_matrix(np.radians(YAW_DEG))
        shift = np.array([15.0, -10.0, 0.7])
        self.source = (part - shift) @ turn  # local: rotated back about the scanner
        # written about a local centre, so that no far origin is rotated about
        self.T = transforms.compose(turn, shift + ORIGIN)
        self.middle = self.source.mean(axis=0)
        self.place = transforms.apply(self.T, self.middle[None])[0]

    def files(self, folder: Path) -> tuple[Path, Path]:
        for name, xyz, crs in (("scan", self.source, None), ("tile", self.target, UTM33)):
            write_cloud(folder / f"{name}.laz", ArrayCloud(xyz, crs, name), None, crs)
        return folder / "scan.laz", folder / "tile.laz"

    def off(self, plan: float, deg: float) -> np.ndarray:
        """The truth, disturbed about the middle of the source."""
        turn = transforms.about(self.place, transforms.yaw_matrix(np.radians(deg)))
        return transforms.translation((plan * 0.6, -plan * 0.8, 0.1)) @ turn @ self.T

    def check(self, found: mg.Registration) -> None:
        assert found.verdict.name == "accepted", found.verdict.reasons
        assert found.T_target_source is not None
        assert rotation_error_deg(found.T_target_source, self.T) < 0.05
        # its boxes have hardly any walls, so that no search comes nearer than 0.2 m in plan
        assert centroid_errors(found.T_target_source, self.T, self.middle)[0] < 0.25


@pytest.fixture(scope="module")
def site() -> Site:
    return Site()


@pytest.fixture(scope="module")
def files(site: Site, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return site.files(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def levelled(files: tuple[Path, Path]) -> Pair:
    """Both clouds in the work frame, before any raster."""
    scan, tile = files
    pipeline = mg.Pipeline([str(tile), str(scan), {"type": "mtpcr.level", "source_crs": "local"}])
    pipeline.execute()
    assert pipeline.pair is not None
    return pipeline.pair


# what goes together, and what does not

NEAR = {"near": (1.0, 2.0)}
WRONG = [
    ({**NEAR, "prior": "georef"}, "--near and --prior georef both say where the source lies"),
    ({**NEAR, "prior": "T.json"}, "--near and --prior file both say where the source lies"),
    ({"yaw": 3.0, "prior": "T.json"}, "--yaw and --prior file both say how the source is turned"),
    ({"yaw": 3.0, "prior": np.eye(4)}, "--yaw and --prior matrix both say how"),
    ({"near_crs": "EPSG:4326"}, "--near-crs is of use with --near only"),
    ({"within": 30.0}, "--within has nothing to be counted from; give --near X Y or --prior"),
    ({"within": 30.0, "yaw": 20.0}, "--within has nothing to be counted from"),
    ({"yaw_tolerance": 5.0, **NEAR}, "--yaw-tolerance has nothing to be counted from"),
    ({"prior_sigma": 5.0, **NEAR}, "--prior-sigma is of use with --prior only; with --near give --within"),
    ({"prior_yaw": 5.0, "yaw": 3.0}, "--prior-yaw is of use with --prior only"),
    ({"prior": "georef", "within": 9.0, "prior_sigma": 3.0}, "--within and --prior-sigma say the same"),
    ({"prior": "georef", "yaw_tolerance": 9.0, "prior_yaw": 3.0}, "--yaw-tolerance and --prior-yaw say"),
    ({"prior": "geroef"}, "not 'geroef'; did you mean 'georef'?; a file of that name is ./geroef"),
    ({"prior": np.eye(3)}, "a matrix of four rows of four numbers"),
    ({"prior": np.full((4, 4), np.nan)}, "a matrix of four rows of four numbers"),
    ({"near": (1.0,)}, "option 'near': "),
    ({"near": (1.0, np.inf)}, "option 'near': "),
    ({**NEAR, "within": 0.0}, "option 'within': input should be greater than 0"),
    ({"yaw": 400.0}, "option 'yaw': "),
    ({"neer": (1.0, 2.0)}, "did you mean 'near'?"),
    ({"yaw_tol": 3.0}, "did you mean 'yaw_tolerance'?"),
]


@pytest.mark.parametrize(("options", "says"), WRONG)
def test_options_that_do_not_go_together_are_one_line(options, says):
    with pytest.raises(OptionError) as error:
        read_options(options)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


IN_A_PIPELINE = [
    (
        WRONG[0][0],
        '"near" of mtpcr.match and "prior": "georef" of mtpcr.match both say where the source lies',
    ),
    (WRONG[1][0], '"near" of mtpcr.match and "prior" of mtpcr.match file both say where the source lies'),
    (WRONG[2][0], '"yaw" of mtpcr.match and "prior" of mtpcr.match file both say how the source is turned'),
]


@pytest.mark.parametrize(("options", "says"), IN_A_PIPELINE)
def test_pipelines_refuse_the_same(options, says, files):
    scan, tile = files
    stages = [str(tile), str(scan), {"type": "mtpcr.level", "source_crs": "local"}, "mtpcr.bev"]
    options = {key: list(value) if isinstance(value, tuple) else value for key, value in options.items()}
    with pytest.raises(OptionError, match=says):
        mg.Pipeline([*stages[:3], {"type": "mtpcr.bev"}, {"type": "mtpcr.match", **options}]).validate()


def test_the_command_says_it_in_its_own_words():
    words = "register a.laz b.laz -o x --near -3 4.5 --prior georef"
    result = CliRunner().invoke(cli.app, words.split())
    assert result.exit_code == OptionError.exit_code
    (line,) = result.stderr.splitlines()
    assert line == (
        "mtpcr-geo: error: --near and --prior georef both say where the source lies; leave one of them out"
    )
    result = CliRunner().invoke(cli.app, [*words.split()[:5], "--near", "1", "north"])
    assert "option --near: input should be a valid number" in result.stderr


def test_how_well_a_prior_is_known():
    assert PriorOptions(prior="georef").within_m == 15.0
    assert PriorOptions(prior="T.json").yaw_within_deg == 5.0
    assert PriorOptions(prior="T.json", prior_sigma=2.0).within_m == 6.0
    assert PriorOptions(prior="T.json", within=2.0, yaw_tolerance=1.0).within_m == 2.0
    assert PriorOptions(yaw=3.0).yaw_within_deg == 15.0
    assert PriorOptions(near=(1.0, 2.0)).within_m is None
    assert MatchOptions(method="orb", near=(1.0, 2.0), within=9.0).within_m == 9.0
    assert read_options({"near": np.array([1.0, 2.0])}).near == (1.0, 2.0)


# what is known leads to the true transform, however it is told


def test_a_place_and_a_radius(site, files):
    near = tuple(site.place[:2] + [16.0, 18.0])  # 24 of 30 m
    found = mg.register(*files, source_crs="local", near=near, within=30.0)
    site.check(found)
    assert found.verdict.metrics["prior_distance_m"] == pytest.approx(np.hypot(16, 18), abs=0.1)
    assert found.verdict.metrics["null_ratio"] is not None


@pytest.mark.slow
def test_longitude_and_latitude(site, files):
    lon, lat = Transformer.from_crs(UTM33, "EPSG:4326", always_xy=True).transform(*site.place[:2])
    found = mg.register(*files, source_crs="local", near=(lon, lat), near_crs="EPSG:4326", yaw=YAW_DEG + 8.0)
    site.check(found)
    assert found.verdict.metrics["prior_distance_m"] < 1.0
    assert found.verdict.metrics["prior_yaw_difference_deg"] == pytest.approx(8.0, abs=0.1)


def test_a_yaw_alone(site, files):
    found = mg.register(*files, source_crs="local", yaw=YAW_DEG - 360.0 + 3.0, yaw_tolerance=5.0)
    site.check(found)
    assert "prior_distance_m" not in found.verdict.metrics


def test_a_matrix_that_is_off_does_not_decide(site, files):
    found = mg.register(*files, source_crs="local", prior=site.off(0.4, 0.5), within=2.0, yaw_tolerance=2.0)
    site.check(found)
    (assessed,) = [one.metadata for one in found.report if one.type == "mtpcr.assess"]
    assert assessed["prior_kept"] is False


@pytest.mark.slow
def test_a_transform_json_and_a_text_file(site, files, tmp_path):
    scan, tile = files
    mg.register(scan, tile, tmp_path / "first", source_crs="local", recording=False)
    known = tmp_path / "first" / "transform.json"
    again = mg.register(scan, tile, tmp_path / "again", source_crs="local", recording=False, prior=known)
    site.check(again)
    run = json.loads((tmp_path / "again" / "run.json").read_text())
    assert {Path(one["path"]).name for one in run["inputs"]} == {"scan.laz", "tile.laz", "transform.json"}
    T = site.off(0.4, 0.5)
    (tmp_path / "T.txt").write_text("\n".join(" ".join(f"{v:.17g}" for v in row) for row in T))
    words = f"register {files[0]} {files[1]} -o {tmp_path / 'third'} --source-crs local --no-recording -q"
    result = CliRunner().invoke(
        cli.app, [*words.split(), "--prior", str(tmp_path / "T.txt"), "--within", "3"]
    )
    assert result.exit_code == 0, result.output
    written = json.loads((tmp_path / "third" / "transform.json").read_text())
    assert rotation_error_deg(np.array(written["T_target_source"]), site.T) < 0.1


def test_a_pipeline_takes_the_same_options(site, files):
    scan, tile = files
    pipeline = mg.Pipeline(
        [
            str(tile),
            str(scan),
            {"type": "mtpcr.register", "source_crs": "local", "near": list(site.place[:2]), "within": 20},
        ]
    )
    pipeline.execute()
    assert pipeline.verdict is not None
    assert pipeline.verdict.name == "accepted"


def test_no_prior_forgets_all_of_it(monkeypatch):
    given: dict[str, RegisterOptions] = {}
    monkeypatch.setattr(
        "mtpcr_geo.registration.build_pipeline", lambda *a: given.setdefault("o", a[-1]) and []
    )
    words = "register a b -o x --near 1 2 --within 3 --yaw 4 --no-prior --dump-pipeline"
    result = CliRunner().invoke(cli.app, words.split())
    assert result.exit_code == 0, result.output
    assert given["o"] == RegisterOptions()


@pytest.mark.slow
def test_a_far_shift_of_both_changes_nothing(site):
    far = np.array([5_000_000.0, -5_000_000.0, 0.0])
    found = []
    for shift in (np.zeros(3), far):
        T = site.off(0.4, 0.5)
        # moved about a local centre, so that no far origin is rotated about
        T[:3, 3] += shift - T[:3, :3] @ shift
        middle = tuple((site.place + shift)[:2])
        for options in ({"prior": T, "within": 5.0}, {"near": middle, "within": 20.0}):
            one = mg.register(site.source + shift, site.target + shift, **options)
            assert one.T_target_source is not None
            found.append(one.apply(site.source[:50] + shift) - shift)
    assert np.abs(np.array(found[:2]) - found[2:]).max() < 1e-4


# what is wrong is refused, with the reason


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (np.diag([2.0, 2.0, 2.0, 1.0]), "it scales the source by 2;"),
        (np.diag([1 / 0.3048, 1 / 0.3048, 1 / 0.3048, 1.0]), "one of the clouds seems to be in feet"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "it mirrors the source"),
        (np.diag([1.0, 1.2, 1.0, 1.0]), "it stretches the source by 1 to 1.2 by direction"),
        (np.diag([1.0, 1.0, 0.0, 1.0]), "it flattens the source"),
        (transforms.compose(transforms.tilt_matrix(0.0, np.pi / 2), np.zeros(3)), "turn the source upright"),
        (transforms.translation((4000.0, 0.0, 0.0)), "4.0 km outside the target"),
        (transforms.translation((0.0, -6e6, 0.0)), "km outside the target"),
    ],
)
def test_matrices_that_cannot_be_true(site, levelled, change, says):
    about = transforms.translation(site.place) @ change @ transforms.translation(-site.place)
    with pytest.raises(OptionError, match=says) as error:
        known_place(PriorOptions(prior=about @ site.T), levelled, "stage match")
    assert str(error.value).startswith("--prior matrix ")


def test_a_matrix_with_the_scale_of_a_map_will_do(site, levelled):
    scaled = site.T.copy()
    scaled[:3, :3] *= 0.9996
    known = known_place(PriorOptions(prior=scaled, within=5.0), levelled, "stage match")
    assert known is not None
    assert known.T is not None
    assert np.allclose(known.T[:3, :3] @ known.T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.abs(transforms.apply(known.T, known.middle[None])[0] - known.place).max() < 1e-6
    assert known.within_m == 5.0
    assert known.yaw is not None
    assert np.degrees(known.yaw) == pytest.approx(YAW_DEG, abs=1e-6)


def test_a_place_without_a_radius_is_somewhere_in_the_source(site, levelled):
    known = known_place(PriorOptions(near=tuple(site.place[:2])), levelled, "stage match")
    assert known is not None
    reach = np.hypot(*(site.source - site.middle)[:, :2].T).max()
    assert known.within_m == pytest.approx(reach, abs=0.01)
    assert known.yaw is None


def test_a_yaw_is_that_of_the_transform_however_the_clouds_are_levelled(levelled):
    tilted = replace(levelled.source.levelling, T_level_work=transforms.compose(
        transforms.tilt_matrix(0.7, np.radians(8.0)), np.zeros(3)))  # fmt: skip
    pair = levelled.with_(source=replace(levelled.source, levelling=tilted))
    known = known_place(PriorOptions(yaw=50.0, yaw_tolerance=4.0), pair, "stage match")
    assert known is not None
    prior = prior_of(known, pair)
    assert prior.yaw is not None
    R = transforms.yaw_matrix(prior.yaw) @ tilted.T_level_work[:3, :3]
    assert np.degrees(transforms.yaw_of(R)) == pytest.approx(50.0, abs=1e-6)
    assert prior.yaw_range == pytest.approx(np.radians(4.0))


def test_a_file_that_is_not_there(files):
    with pytest.raises(InputError, match=r"there is no file nowhere\.json"):
        mg.register(*files, source_crs="local", prior="nowhere.json")


def test_a_place_that_cannot_be_meant(site, files, levelled):
    x, y = site.place[:2]
    lon, lat = Transformer.from_crs(UTM33, "EPSG:4326", always_xy=True).transform(x, y)
    for near, says in (
        ((x + 5000.0, y), "5.0 km outside the target"),
        ((y, x), "x and y seem exchanged"),
        ((lon, lat), "add --near-crs EPSG:4326"),
        ((lat, lon), "longitude comes first"),
    ):
        with pytest.raises(OptionError, match=says):
            known_place(PriorOptions(near=near, within=20.0), levelled, "stage match")
        report = check_clouds(*files, source_crs="local", near=near, within=20.0)
        assert report.exit_code == OptionError.exit_code
        (finding,) = [one for one in report.findings if one.code == "near"]
        assert finding.severity == "error"
        in_python = says.replace("--near-crs EPSG:4326", 'near_crs="EPSG:4326"')
        assert in_python in f"{finding.what}; {finding.fix}"
    with pytest.raises(CrsError, match="longitude comes before latitude"):
        known_place(PriorOptions(near=(lat, 152.0), near_crs="EPSG:4326"), levelled, "stage match")
    report = check_clouds(*files, local=True, near=(lon, lat), near_crs="EPSG:4326")
    assert report.exit_code == CrsError.exit_code
    assert any("needs a target with a coordinate reference system" in one.what for one in report.findings)


def test_check_says_where_a_place_lies(site, files):
    assert check_clouds(*files, source_crs="local", near=tuple(site.place[:2])).exit_code == 0
    outside = site.target[:, :2].max(axis=0) + [40.0, 0.0]
    report = check_clouds(*files, source_crs="local", near=tuple(outside), within=10.0)
    (finding,) = [one for one in report.findings if one.code == "near"]
    assert (finding.severity, report.exit_code) == ("warning", 0)
    assert "30 m outside the target" in finding.what
    with pytest.raises(OptionError, match="of use with near only"):
        check_clouds(*files, within=10.0)
    with pytest.raises(OptionError, match="there is one cloud"):
        check_clouds(files[1], near=(1.0, 2.0))


@pytest.mark.slow
def test_a_prior_that_is_wrong_is_not_borne_out(site, files):
    for options in (
        {"near": tuple(site.place[:2] + [-36.0, 27.0]), "within": 15.0},
        {"prior": site.off(24.0, 0.0), "within": 8.0},
        {"yaw": YAW_DEG + 90.0, "yaw_tolerance": 10.0},
    ):
        found = mg.register(*files, source_crs="local", **options)
        assert found.verdict.name != "accepted", (options, found.verdict)


def test_a_result_beyond_what_was_said_is_doubted(site, files):
    # keypoints are sought everywhere, whatever the place
    found = mg.register(
        *files, source_crs="local", matcher="rootsift", near=tuple(site.place[:2] + [20.0, 0.0]), within=5.0
    )
    if found.T_target_source is not None and rotation_error_deg(found.T_target_source, site.T) < 1.0:
        assert found.verdict.name != "accepted"
        assert any("more than the 5 m said to be possible" in one for one in found.verdict.reasons)
