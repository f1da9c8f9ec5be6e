"""`mtpcr_geo.register` from Python: what it takes, what it returns, what it leaves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_paths import REPOSITORY
from helpers_scene import ORIGIN, TOWN_TURNED, make_pair
from typer.testing import CliRunner

import mtpcr_geo as mg
from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import (
    CrsError,
    InputError,
    MissingPartError,
    OptionError,
    OutputError,
    RegistrationError,
)
from mtpcr_geo.core.types import Pair, Verdict
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.records import InputFile, RunFacts
from mtpcr_geo.pipeline.runner import RunResult
from mtpcr_geo.registration import Registration

UNSOLVED = {
    "bev/source.tif", "bev/target.tif", "bev/source.qml", "bev/target.qml", "project.qgz", "report.html",
    "run.json",
}  # fmt: skip
WITHOUT_RECORDING = UNSOLVED | {
    "bev/registered.tif", "bev/registered.qml", "bev/difference.tif", "bev/difference.qml",
    "bev/source.tif.points", "ties.gpkg", "transform.json",
    "transform.cloudcompare.txt", "transform.pdal.json", "registered.laz",
}  # fmt: skip
# run by run these differ: they tell the time
TIMED = {"report.html", "run.json", "ties.gpkg", "audit.rrd"}


def names_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def bits(registration: Registration) -> bytes:
    assert registration.T_target_source is not None
    return registration.T_target_source.tobytes()


def of_pair(pair: Pair, *, force: bool = False) -> Registration:
    """A registration that ended in the given state."""
    return Registration(RunResult({"assess": pair}, (), ()), RegisterOptions(force=force))


@pytest.fixture(scope="module")
def xyz(town_files) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of source and target, as they stand in the files."""
    source, target = (mg.read(path).to_array() for path in town_files)
    return source, target


@pytest.fixture(scope="module")
def of_arrays(xyz) -> Registration:
    return mg.register(*xyz)


@pytest.fixture(scope="module")
def of_files(town_files) -> Registration:
    return mg.register(*map(str, town_files))


@pytest.fixture(scope="module")
def of_command(town_files, tmp_path_factory) -> Path:
    """What the command leaves of the same points."""
    out = tmp_path_factory.mktemp("command") / "out"
    words = ["register", *map(str, town_files), "-o", str(out), "--local", "--quiet"]
    assert CliRunner().invoke(app, words).exit_code == 0
    return out


def test_arrays_give_the_transform_of_the_command_bit_for_bit(of_arrays, of_command):
    T = json.loads((of_command / "run.json").read_text(encoding="utf-8"))["T_target_source"]
    assert bits(of_arrays) == np.array(T).tobytes()
    assert of_arrays.verdict.name == "accepted"
    assert of_arrays.outputs == {}


def test_las_data_clouds_lists_and_files_mix(town_files, xyz, of_files):
    source, target = town_files
    assert bits(mg.register(laspy.read(source), mg.read(target))) == bits(of_files)
    rows = mg.register(xyz[0].tolist(), laspy.read(target), source_crs="EPSG:25833")
    assert bits(rows) == bits(of_files)
    assert rows.pair is not None
    assert rows.pair.frame.crs is not None
    assert rows.pair.frame.crs.to_epsg() == 25833


def test_saving_a_run_of_files_leaves_what_the_command_leaves(town_files, tmp_path, of_command):
    registration = mg.register(*town_files, local=True, recording=True)
    assert registration.outputs == {}
    written = registration.save(tmp_path / "out")
    assert written == registration.outputs
    assert names_below(tmp_path / "out") == names_below(of_command) == WITHOUT_RECORDING | {"audit.rrd"}
    for name in names_below(of_command) - TIMED:
        assert (tmp_path / "out" / name).read_bytes() == (of_command / name).read_bytes(), name
    ours, theirs = (
        json.loads((folder / "run.json").read_text(encoding="utf-8"))
        for folder in (tmp_path / "out", of_command)
    )
    assert list(ours) == list(theirs)
    assert ours["inputs"] == theirs["inputs"]
    assert ours["T_target_source"] == theirs["T_target_source"]
    assert {stage["type"] for stage in ours["pipeline"]} == {stage["type"] for stage in theirs["pipeline"]}


def test_saving_arrays_twice(of_arrays, xyz, tmp_path):
    of_arrays.save(tmp_path / "out")
    assert names_below(tmp_path / "out") == WITHOUT_RECORDING
    moved = np.asarray(laspy.read(tmp_path / "out" / "registered.laz").xyz)
    np.testing.assert_allclose(moved, of_arrays.apply(xyz[0]), atol=0.00051)
    before = (tmp_path / "out" / "run.json").stat().st_mtime_ns
    with pytest.raises(OutputError, match="exists already"):
        of_arrays.save(tmp_path / "out")
    assert (tmp_path / "out" / "run.json").stat().st_mtime_ns == before
    of_arrays.save(tmp_path / "out", overwrite=True)
    assert names_below(tmp_path / "out") == WITHOUT_RECORDING


def test_a_file_that_has_changed_since_is_not_saved_as_if_it_had_not(tmp_path):
    file = tmp_path / "source.laz"
    file.write_bytes(b"as it was read")
    facts = RunFacts(inputs=(InputFile.of(file),))
    registration = Registration(RunResult({"assess": make_pair(2000)}, (), (), facts=facts))
    file.write_bytes(b"something else")
    with pytest.raises(InputError, match="has changed since"):
        registration.save(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_apply_and_inverse_of_every_kind(of_arrays, xyz, town_files):
    source, _ = xyz
    moved = of_arrays.apply(source)
    assert moved.dtype == np.float64
    np.testing.assert_allclose(
        moved, source @ of_arrays.T_target_source[:3, :3].T + of_arrays.T_target_source[:3, 3], atol=1e-6
    )
    np.testing.assert_allclose(of_arrays.inverse(moved), source, atol=1e-6)
    np.testing.assert_allclose(of_arrays.T_source_target @ of_arrays.T_target_source, np.eye(4), atol=1e-6)
    for cloud in (town_files[0], laspy.read(town_files[0]), mg.read(town_files[0])):
        there = of_arrays.apply(cloud)
        assert isinstance(there, mg.Cloud)
        np.testing.assert_array_equal(there.to_array(), moved)
    np.testing.assert_array_equal(mg.apply(of_arrays, source), moved)
    np.testing.assert_allclose(np.asarray(mg.apply(of_arrays, moved, inverse=True)), source, atol=1e-6)


def test_apply_writes_only_where_a_file_is_named(of_arrays, town_files, tmp_path):
    of_arrays.save(tmp_path / "out")
    written = tmp_path / "moved.laz"
    assert mg.apply(tmp_path / "out" / "transform.json", town_files[0], written) == written
    before, after = laspy.read(town_files[0]), laspy.read(written)
    np.testing.assert_allclose(np.asarray(after.xyz), of_arrays.apply(np.asarray(before.xyz)), atol=0.0011)
    np.testing.assert_array_equal(before.intensity, after.intensity)
    with pytest.raises(OutputError, match="exists already"):
        mg.apply(of_arrays, town_files[0], written)
    mg.apply(of_arrays, town_files[0], written, overwrite=True)


def test_apply_refuses_a_cloud_of_another_place(town_files, of_files):
    elsewhere = ArrayCloud(mg.read(town_files[0]).to_array(), mg.read(town_files[0], "EPSG:2154").crs)
    with pytest.raises(CrsError, match="reproject"):
        of_files.apply(elsewhere)


def test_a_refused_transform_is_not_used_unless_forced(tmp_path):
    registration = of_pair(make_pair(verdict="refused"))
    points = np.zeros((1, 3))
    with pytest.raises(RegistrationError, match=r"refused.*force=True"):
        registration.apply(points)
    with pytest.raises(RegistrationError, match="refused"):
        mg.apply(registration, points)
    assert registration.apply(points, force=True).shape == (1, 3)
    assert of_pair(make_pair(verdict="refused"), force=True).inverse(points).shape == (1, 3)
    registration.save(tmp_path / "evidence")
    assert names_below(tmp_path / "evidence") == UNSOLVED | {"ties.gpkg"}
    registration.save(tmp_path / "forced", force=True)
    assert {"registered.laz", "transform.json"} <= names_below(tmp_path / "forced")


def test_nothing_found_is_refused_and_no_error(town_files, monkeypatch, tmp_path):
    def nothing(*args, **kwargs):
        raise RegistrationError("no part of the source looks like the target")

    monkeypatch.setattr("mtpcr_geo.match.correlation.match", nothing)
    found = mg.register(*town_files)
    assert found.verdict == Verdict("refused", ("no part of the source looks like the target",), {})
    assert found.T_target_source is None
    assert found.T_source_target is None
    assert "no part of the source" in repr(found)
    with pytest.raises(RegistrationError, match="no transform was found: no part"):
        found.apply(np.zeros((1, 3)))
    assert found.plot().axes
    found.save(tmp_path / "out")
    assert names_below(tmp_path / "out") == UNSOLVED


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.zeros((5, 2)), r"source must be \(n, 3\).*shape \(5, 2\)"),
        (np.zeros(3), r"shape \(3,\)"),
        ([[1, 2, 3], [4, 5]], "rows differ in length"),
        ([["a", "b", "c"]], "laspy.LasData or a Cloud, and is a list of dtype"),
        (None, "and is NoneType"),
        (np.ones((5, 3), complex), "dtype complex128"),
        (np.zeros(5, [("X", float), ("Y", float)]), "must have the fields X, Y and Z"),
    ],
)
def test_what_is_no_cloud_is_said(points, said, xyz):
    with pytest.raises(InputError, match=said):
        mg.register(points, xyz[1])


def test_points_that_cannot_be_used(xyz, tmp_path):
    source, target = xyz
    holes = source.copy()
    holes[[7, 9], 1] = np.nan
    with pytest.raises(InputError, match=r"target has 2 points that are not finite .*row 7"):
        mg.register(target, holes)
    with pytest.raises(InputError, match="source has 50 usable points"):
        mg.register(source[:50], target)
    with pytest.raises(InputError, match="source is empty"):
        mg.register(np.empty((0, 3)), target)
    with pytest.raises(InputError, match="the same points"):
        mg.register(target, target.copy())
    with pytest.raises(InputError, match="there is no file"):
        mg.register(tmp_path / "missing.laz", target)


def test_options_are_checked_by_name(xyz):
    with pytest.raises(OptionError, match="cell"):
        mg.register(*xyz, cel=1.0)
    with pytest.raises(OptionError, match="overwrite is of use with a folder only"):
        mg.register(*xyz, overwrite=True)


def test_swapping_source_and_target_gives_the_way_back(of_arrays, xyz):
    source, target = xyz
    back = mg.register(target, source)
    both = back.apply(of_arrays.apply(source))
    assert np.linalg.norm(both - source, axis=1).mean() < 0.5


def test_repr_is_a_few_lines(of_arrays):
    lines = repr(of_arrays).splitlines()
    assert lines[0] == "Registration: accepted"
    assert len(lines) <= 10
    assert max(map(len, lines)) < 140
    yaw = next(float(line.split("yaw ")[1].split("°")[0]) for line in lines if "yaw " in line)
    # the town's few walls hold the yaw to some hundredths of a degree
    assert yaw == pytest.approx(61.0, abs=0.1)
    assert any("m²" in line and "of the source" in line for line in lines)


def test_html_is_escaped():
    pair = make_pair(verdict="doubtful")
    side = pair.source
    side.cloud.name = "a<b>&.laz"
    judged = pair.with_(verdict=Verdict("doubtful", ("margin < 1 & <script>",), {}))
    text = of_pair(judged)._repr_html_()
    assert "a&lt;b&gt;&amp;.laz" in text
    assert "margin &lt; 1 &amp; &lt;script&gt;" in text
    assert "<script>" not in text


def test_plot_shows_both_panels_with_metres(of_arrays):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    figure = of_arrays.plot()
    over, difference, bar = figure.axes
    assert "registered source" in over.get_title()
    assert over.get_xlabel() == difference.get_xlabel() == "x (m)"
    assert bar.get_ylabel() == "metres"
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert figure.get_suptitle() == "source to target: accepted"
    # where it fits, most of the ground is at the same height
    apart = difference.images[0].get_array().compressed()
    assert np.median(np.abs(apart)) < 0.15
    # the registered source fills most of the target's area
    low, high = over.get_xlim()
    assert 100 < high - low < 140


def test_plot_of_a_georeferenced_pair_names_the_origin():
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    figure = of_pair(make_pair(2000)).plot()
    assert figure.axes[0].get_xlabel() == "metres east of 367000"


def test_plot_without_matplotlib_says_what_to_install(of_arrays, monkeypatch):
    monkeypatch.delitem(sys.modules, "mtpcr_geo.export.figure", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)
    with pytest.raises(MissingPartError, match="pip install"):
        of_arrays.plot()


def test_names_at_the_top_are_there_and_lazy():
    code = (
        "import sys, mtpcr_geo as mg\n"
        "assert 'numpy' not in sys.modules\n"
        "assert set(mg.__all__) <= set(dir(mg))\n"
        "import mtpcr_geo.registration, mtpcr_geo.check.preflight\n"
        "from mtpcr_geo import apply, check, read, register, Cloud, Pipeline, Registration\n"
        "assert all(map(callable, (apply, check, read, register, mg.register, mg.check)))\n"
        "assert 'matplotlib' not in sys.modules and 'rerun' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    with pytest.raises(AttributeError, match="no attribute 'registre'"):
        mg.registre  # noqa: B018


def test_steps_of_the_method_alone(of_arrays, xyz):
    from mtpcr_geo.match.correlation import CorrelationSettings, match

    origins = [np.floor(points.mean(axis=0)) for points in xyz]
    source, target = (points - origin for points, origin in zip(xyz, origins, strict=True))
    for points in (source, target):
        assert mg.level(points, "auto", georeferenced=False).T_level_work.shape == (4, 4)
    of_source, of_target = (mg.make_bev(points, cell=1.0) for points in (source, target))
    ties = mg.tie_points_of(match(of_source, of_target, CorrelationSettings()), of_source, of_target)
    solution, inlier = mg.solve_tie_points(ties, tolerance=1.5)
    assert inlier.sum() > 30
    T = mg.refine(source, target, solution.T).T
    there = source @ T[:3, :3].T + T[:3, 3] + origins[1]
    # among this town's level fields surfaces hold x to 0.3 m only
    true = transforms.apply(transforms.inverse(TOWN_TURNED), xyz[0] - ORIGIN) + ORIGIN
    assert np.linalg.norm(there - true, axis=1).mean() < 0.3
    assert np.linalg.norm(of_arrays.apply(xyz[0]) - true, axis=1).mean() < 0.3


def test_check_and_read_at_the_top(town_files):
    report = mg.check(*town_files)
    assert report.goes_on
    cloud = mg.read(town_files[0], "EPSG:2154")
    assert cloud.crs is not None
    assert cloud.crs.to_epsg() == 2154
    assert cloud.to_array().shape == (cloud.count, 3)
    with pytest.raises(CrsError):
        mg.read(town_files[0], "EPSG:nothing")


def test_few_modules_stand_between_the_command_and_the_first_point(town_files, tmp_path, monkeypatch):
    import traceback

    from mtpcr_geo.io.las import LasCloud

    seen: list[str] = []

    def watched(self, *args):
        frames = [Path(frame.filename) for frame in traceback.extract_stack()]
        ours = [path for path in frames if path.is_relative_to(REPOSITORY / "mtpcr_geo")]
        seen.extend(dict.fromkeys(path.relative_to(REPOSITORY).as_posix() for path in ours))
        raise InputError("enough")

    monkeypatch.setattr(LasCloud, "noise_chunks", watched)
    words = ["register", *map(str, town_files), "-o", str(tmp_path / "out"), "--no-recording"]
    assert CliRunner().invoke(app, words).exit_code == InputError.exit_code
    between = [name for name in seen if not name.startswith("mtpcr_geo/cli/")]
    assert 0 < len(between) <= 4, between
