from __future__ import annotations

import hashlib
import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_paths import REPOSITORY

import mtpcr_geo
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.runner import Settings, execute
from mtpcr_geo.registration import build_pipeline, register

WITHOUT_PDAL = ["ground_to_aerial", "flight_strips"]


def ready(name: str) -> bytes:
    return (REPOSITORY / "pipelines" / f"{name}.json").read_bytes()


def files_below(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


@pytest.fixture(scope="module")
def registered(town_files, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "out"
    return register(town_files[0], town_files[1], out), out


def test_register_brings_the_source_home_and_leaves_everything(registered):
    result, out = registered
    assert result.verdict.name == "accepted"
    yaw = np.degrees(transforms.yaw_of(result.T_target_source[:3, :3]))
    assert yaw == pytest.approx(61.0, abs=0.1)
    names = {str(path.relative_to(out)) for path in files_below(out)}
    assert names == {
        "bev/source.tif", "bev/target.tif", "bev/registered.tif", "ties.gpkg", "transform.json",
        "bev/source.qml", "bev/target.qml", "bev/registered.qml", "bev/difference.tif", "bev/difference.qml",
        "bev/source.tif.points", "project.qgz",
        "transform.cloudcompare.txt",
        "transform.pdal.json", "audit.rrd", "report.html", "run.json", "registered.laz",
    }  # fmt: skip


def test_run_json_tells_the_whole_run(registered, town_files):
    result, out = registered
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert run["verdict"] == result.verdict.name
    assert run["reasons"] == list(result.verdict.reasons)
    assert {"verdict", "reasons", "time_s", "peak_memory_mb", "versions", "options"} <= set(run)
    assert {"level", "bev", "match", "solve", "refine", "registered", "total"} <= set(run["time_s"])
    assert run["time_s"]["total"] >= max(run["time_s"][tag] for tag in ("match", "refine"))
    np.testing.assert_array_equal(run["T_target_source"], result.T_target_source)
    text = json.dumps(run)
    for file in town_files:
        assert hashlib.sha256(file.read_bytes()).hexdigest() in text


def test_registered_cloud_keeps_count_and_moves_every_point(registered, town_files):
    result, out = registered
    before, after = laspy.read(town_files[0]), laspy.read(out / "registered.laz")
    assert len(before) == len(after)
    moved = transforms.apply(result.T_target_source, np.asarray(before.xyz))
    np.testing.assert_allclose(np.asarray(after.xyz), moved, atol=0.0011)
    np.testing.assert_array_equal(before.intensity, after.intensity)


def test_dumped_pipeline_gives_the_same_bits(registered, town_files, tmp_path):
    result, out = registered
    stages = build_pipeline(town_files[0], town_files[1], tmp_path / "again", RegisterOptions())
    text = grammar.dump(stages)
    again = execute(grammar.link(grammar.parse(text)), Settings())
    assert again.pair is not None
    assert TransformChain.of(again.pair).T_file.tobytes() == result.T_target_source.tobytes()
    for name in ("transform.cloudcompare.txt", "bev/source.tif", "registered.laz"):
        first, second = (out / name).read_bytes(), (tmp_path / "again" / name).read_bytes()
        assert first == second, name


def test_another_seed_is_in_the_dump(town_files, tmp_path):
    stages = build_pipeline(town_files[0], town_files[1], tmp_path, RegisterOptions(seed=5))
    assert {stage["type"] for stage in stages if stage.get("seed") == 5} >= {"mtpcr.level", "mtpcr.solve"}


@pytest.mark.parametrize("name", WITHOUT_PDAL)
def test_ready_pipelines_without_pdal(name, town_files, tmp_path, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    monkeypatch.chdir(tmp_path)
    source, target = town_files
    pipeline = mtpcr_geo.Pipeline(ready(name), [f"--target.filename={target}", f"--source.filename={source}"])
    pipeline.validate()
    assert files_below(tmp_path) == []
    count = pipeline.execute()
    source_cloud = pipeline.stages["source"]
    assert isinstance(source_cloud, Cloud)
    assert count == source_cloud.count
    assert pipeline.verdict is not None
    assert pipeline.verdict.name == "accepted"
    assert (tmp_path / "out" / "registered.laz").exists()


def test_bev_only(town_files, tmp_path, monkeypatch):
    import rasterio

    monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    monkeypatch.chdir(tmp_path)
    pipeline = mtpcr_geo.Pipeline(
        ready("bev_only"), [f"--readers.las.filename={town_files[1]}", "--bev.cell=2"]
    )
    pipeline.execute()
    with rasterio.open(tmp_path / "out" / "bev.tif") as raster:
        assert raster.res == (2.0, 2.0)
        assert raster.crs.to_epsg() == 25833


def test_composite_gives_what_its_steps_give(registered, town_files):
    source, target = town_files
    pipeline = mtpcr_geo.Pipeline([str(target), str(source), {"type": "mtpcr.register"}])
    pipeline.execute()
    assert pipeline.pair is not None
    assert TransformChain.of(pipeline.pair).T_file.tobytes() == registered[0].T_target_source.tobytes()


def test_crop_count_and_arrays_without_pdal(town_files, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    target = laspy.read(town_files[1])
    x, y = np.asarray(target.x), np.asarray(target.y)
    low = [x.min() + 20.0, y.min() + 30.0]
    bounds = f"([{low[0]}, {low[0] + 40.0}], [{low[1]}, {low[1] + 40.0}])"
    pipeline = mtpcr_geo.Pipeline([str(town_files[1]), {"type": "filters.crop", "bounds": bounds}])
    inside = (x >= low[0]) & (x <= low[0] + 40.0) & (y >= low[1]) & (y <= low[1] + 40.0)
    assert pipeline.execute() == inside.sum()
    (array,) = pipeline.arrays
    np.testing.assert_array_equal(array["X"], x[inside])
    np.testing.assert_array_equal(array["Intensity"], target.intensity[inside])
    first = mtpcr_geo.Pipeline([{"type": "readers.las", "filename": str(town_files[1]), "count": 123}])
    assert first.execute() == 123


def test_refused_run_keeps_evidence_and_writes_no_result(town_files, tmp_path):
    stages = build_pipeline(town_files[0], town_files[1], tmp_path / "out", RegisterOptions(recording=False))
    next(stage for stage in stages if stage["type"] == "mtpcr.assess")["neg_log10_p"] = 1e9
    next(stage for stage in stages if stage["type"] == "mtpcr.assess")["margin"] = 1e9
    result = execute(grammar.link(grammar.parse(grammar.dump(stages))))
    written = {path.name for path in files_below(tmp_path)}
    assert result.verdict is not None
    if result.verdict.name == "refused":
        assert not written & {"registered.laz", "transform.json"}
    assert {"run.json", "ties.gpkg", "source.tif"} <= written


def test_registration_that_finds_nothing_is_refused_with_evidence(town_files, tmp_path, monkeypatch):
    from mtpcr_geo.core.errors import RegistrationError

    def nothing(*args, **kwargs):
        raise RegistrationError("no part of the source looks like the target")

    monkeypatch.setattr("mtpcr_geo.match.correlation.match", nothing)
    result = register(town_files[0], town_files[1], tmp_path / "out", recording=False)
    assert result.verdict.name == "refused"
    assert "looks like" in result.verdict.reasons[0]
    written = {path.name for path in files_below(tmp_path)}
    styled = {"source.tif", "source.qml", "target.tif", "target.qml"}
    assert written == styled | {"project.qgz", "run.json", "report.html"}
    assert result.T_target_source is None


def test_interrupted_run_leaves_nothing(town_files, tmp_path, monkeypatch):
    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("mtpcr_geo.verdict.decision.assess", interrupt)
    with pytest.raises(KeyboardInterrupt):
        register(town_files[0], town_files[1], tmp_path / "out", recording=False)
    assert not (tmp_path / "out").exists()
