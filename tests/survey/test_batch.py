from __future__ import annotations

import csv
import json
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers_survey import town_source, town_target, write_tile
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError, OptionError, OutputError
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.survey.batch import Row, run_batch, write_map
from mtpcr_geo.survey.engine import _tried
from mtpcr_geo.survey.jobs import Job, jobs_of
from mtpcr_geo.survey.options import BatchOptions

HERE = BatchOptions(workers=1)


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clouds")
    write_tile(folder / "target.laz", town_target(points=30_000))
    write_tile(folder / "scan.laz", town_source()[0], None)
    write_tile(folder / "scan2.laz", town_source()[0][::2], None)
    (folder / "broken.laz").write_bytes((folder / "scan.laz").read_bytes()[:5000])
    return folder


def write_table(folder: Path, *rows: str) -> Path:
    path = folder / "jobs.csv"
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_a_table_gives_each_job_its_options(clouds: Path) -> None:
    table = write_table(
        clouds,
        "name,source,target,source_crs,near,within,seed,force",
        "first,scan.laz,target.laz,local,367000 5820000,40,3,true",
        ",scan2.laz,,,,,,",
    )
    first, second = jobs_of(table, clouds / "target.laz", {"source_crs": "EPSG:25833"})
    assert first.name == "first"
    assert first.target == clouds / "target.laz"
    assert first.options == {
        "source_crs": "local", "near": [367000.0, 5820000.0], "within": 40.0, "seed": 3, "force": True,
    }  # fmt: skip
    assert (second.name, second.options) == ("scan2", {"source_crs": "EPSG:25833"})
    assert first.key != second.key


@pytest.mark.parametrize(
    ("rows", "error", "says"),
    [
        (("source,target,wihtin", "a.laz,b.laz,3"), OptionError, "within"),
        (("source,target,seed", "a.laz,b.laz,x"), OptionError, "line 2: option 'seed'"),
        (("source,target,overwrite", "a.laz,b.laz,true"), OptionError, "whole batch"),
        (("cloud,target", "a.laz,b.laz"), InputError, "no column source"),
        (("source",), InputError, "no rows"),
        (("source", "a.laz"), OptionError, "--target"),
        (("source,target", "a.laz,b.laz", "a.laz,c.laz"), InputError, "a job a already"),
        (("source,target", "a.laz,b.laz,c"), InputError, "more values"),
    ],
)
def test_a_table_that_is_wrong_is_refused(
    rows: tuple[str, ...], error: type[Exception], says: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=says):
        jobs_of(write_table(tmp_path, *rows), None, {})


def test_recordings_are_written_where_they_are_asked_for(clouds: Path) -> None:
    table = write_table(clouds, "source,target,recording", "scan.laz,target.laz,yes", "scan2.laz,target.laz,")
    first, second = jobs_of(table, None, {})
    assert first.options == {"recording": True}
    assert second.options == {}  # none, in a batch
    assert [job.options for job in jobs_of(table, None, {"recording": True})] == [{"recording": True}] * 2


def test_what_a_table_says_is_relative_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tab" / "poses").mkdir(parents=True)
    pose = tmp_path / "tab" / "poses" / "1.txt"
    pose.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    table = write_table(
        tmp_path / "tab",
        "name,source,target,prior",
        "a,a.laz,b.laz,poses/1.txt",
        "b,@l.txt,,",
        "c,c.laz,,georef",
    )
    relative = table.relative_to(tmp_path)
    first, second, third = jobs_of(relative, Path("t.laz"), {"prior": "poses/2.txt", "models": "models"})
    models = str(tmp_path / "models")
    assert (first.source, first.target) == (tmp_path / "tab" / "a.laz", tmp_path / "tab" / "b.laz")
    assert first.options == {"prior": str(pose), "models": models}
    # what the command line says is relative to where it is given
    assert (str(second.source), second.target) == (f"@{tmp_path / 'tab' / 'l.txt'}", tmp_path / "t.laz")
    assert second.options == {"prior": str(tmp_path / "poses" / "2.txt"), "models": models}
    assert third.options == {"prior": "georef", "models": models}


def test_another_pose_known_beforehand_is_another_job(clouds: Path, tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    pose = tmp_path / "pose.txt"
    pose.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    known = {"prior": str(pose), "models": str(tmp_path / "models")}
    job = Job("a", clouds / "scan.laz", clouds / "target.laz", known)
    first = job.key
    assert job.key == first
    pose.write_text("1 0 0 50\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    second = job.key
    assert second != first
    (tmp_path / "models" / "bev.onnx").write_bytes(b"weights")
    assert job.key not in (first, second)


def test_a_name_is_no_path(tmp_path: Path) -> None:
    table = write_table(tmp_path, "name,source,target", "../../x y,a.laz,b.laz")
    assert jobs_of(table, None, {})[0].name == "_.._x_y"


def test_every_source_is_a_job_whatever_it_is_called(tmp_path: Path) -> None:
    files = (
        "a/plot 1.laz",
        "a/plot_1.laz",
        "a/plot#1.LAZ",
        "a/Scan.las",
        "a/scan.laz",
        "b/scan.laz",
        "b/other.laz",
    )
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"LASF")

    def names_of(*names: str) -> dict[str, str]:
        (tmp_path / "list.txt").write_text("\n".join(names))
        jobs = jobs_of(Path(f"@{tmp_path / 'list.txt'}"), tmp_path / "target.laz", {})
        return {job.source.relative_to(tmp_path).as_posix(): job.name for job in jobs}

    named = names_of(*files, files[0])
    assert set(named) == set(files)
    assert len({name.lower() for name in named.values()}) == len(files)
    assert named["b/other.laz"] == "other"
    assert all(name.startswith(("plot_1-", "scan-", "Scan-", "other")) for name in named.values())
    # a name is the same whichever other sources of its kind there are
    fewer = names_of("b/scan.laz", "a/scan.laz")
    assert fewer == {name: named[name] for name in fewer}
    assert names_of("b/scan.laz") == {"b/scan.laz": "scan"}


def test_jobs_of_one_name_are_refused(tmp_path: Path) -> None:
    jobs = [Job(name, Path("a.laz"), Path("b.laz"), {}) for name in ("One", "one")]
    with pytest.raises(OptionError, match="2 jobs are called One"):
        run_batch(jobs, tmp_path / "batch", HERE)
    assert not (tmp_path / "batch").exists()


def test_a_batch_runs_goes_on_and_tells_failures(clouds: Path, tmp_path: Path) -> None:
    table = write_table(clouds, "source,target", "scan.laz,target.laz", "broken.laz,target.laz")
    jobs = jobs_of(table, None, {"source_crs": "local"})
    folder = tmp_path / "batch"
    batch = run_batch(jobs, folder, HERE)
    good, bad = batch.rows
    assert batch.run == 2
    assert good.verdict == "accepted", good.reason
    assert bad.verdict == "failed"
    assert "broken.laz" in bad.reason
    T = np.array(good.T_target_source).reshape(4, 4)
    middle = town_source()[0].mean(axis=0)[None]
    gap = transforms.apply(T, middle) - transforms.apply(town_source()[1], middle)
    assert np.linalg.norm(gap) < 0.2
    # the middle is the mean of the points, as --near means it, and not that of the outline's corners
    assert good.x is not None
    assert good.y is not None
    np.testing.assert_allclose([good.x, good.y], transforms.apply(T, middle)[0, :2], atol=0.01)
    ring = np.reshape(good.footprint, (-1, 2))
    assert np.linalg.norm(ring[:-1].mean(axis=0) - [good.x, good.y]) > 1.0
    assert (folder / good.folder / "run.json").is_file()
    with (folder / "batch.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["name"], row["verdict"]) for row in rows] == [("scan", "accepted"), ("broken", "failed")]
    assert float(rows[0]["probability"]) == good.probability
    with sqlite3.connect(folder / "batch.gpkg") as base:
        shown = base.execute("SELECT name, verdict FROM footprints").fetchall()
        assert base.execute("SELECT srs_id FROM gpkg_geometry_columns").fetchone() == (25833,)
    base.close()
    assert shown == [("scan", "accepted")]

    # what is done is not done again; what failed is
    (clouds / "broken.laz").write_bytes((clouds / "scan2.laz").read_bytes())
    row_file = folder / "rows" / "scan.json"
    before = row_file.stat().st_mtime_ns
    again = run_batch(jobs_of(table, None, {"source_crs": "local"}), folder, HERE)
    assert (again.run, row_file.stat().st_mtime_ns) == (1, before)
    assert [row.verdict for row in again.rows] == ["accepted", "accepted"]
    # another option is another job
    other = jobs_of(table, None, {"source_crs": "local", "seed": 1})
    assert other[0].key != jobs[0].key


@pytest.mark.parametrize("kinds", ["glg", "lgg", "ll", "gg", ""])
def test_whatever_was_placed_is_on_the_map(kinds: str, tmp_path: Path) -> None:
    wkts = {"l": "", "g": CRS.from_epsg(25832).to_wkt()}
    ring = (0.0, 0.0, 9.0, 0.0, 9.0, 9.0, 0.0, 0.0)
    rows = [
        Row(f"{kind}{number}", "s", "t", "accepted", footprint=ring, crs=wkts[kind])
        for number, kind in enumerate(kinds)
    ]
    path = write_map(tmp_path / "map.gpkg", [*rows, Row("none", "s", "t", "failed")])
    found: dict[str, int] = {}
    with closing(sqlite3.connect(path)) as base:
        for layer, srs in base.execute("SELECT table_name, srs_id FROM gpkg_geometry_columns").fetchall():
            assert srs == (-1 if layer == "footprints_local" or not kinds else 25832)
            found |= {name: srs for (name,) in base.execute(f"SELECT name FROM {layer}")}
    assert found == {row.name: 25832 if row.crs else -1 for row in rows}


def test_a_foreign_folder_is_left_alone(clouds: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    jobs = jobs_of(clouds / "scan.laz", clouds / "target.laz", {})
    with pytest.raises(OutputError, match="is no batch"):
        run_batch(jobs, tmp_path, HERE)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_the_command_says_what_failed(clouds: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path, "source,target", f"{clouds / 'none.laz'},{clouds / 'target.laz'}")
    result = CliRunner().invoke(app, ["batch", str(table), "-o", str(tmp_path / "out"), "--workers", "1"])
    assert result.exit_code == 5
    assert "1 failed" in result.stdout
    assert "none.laz" in result.stderr
    assert json.loads((tmp_path / "out" / "rows" / "none.json").read_text())["verdict"] == "failed"


def test_a_piece_of_work_takes_no_more_cores_than_its_share() -> None:
    assert _tried(lambda _: usable_cores(), None, 1) == (1, None)
    assert _tried(lambda _: usable_cores(), None) == (usable_cores(), None)
