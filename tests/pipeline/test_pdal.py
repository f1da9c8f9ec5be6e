"""Our pipelines beside real PDAL: the same points, the same files, the same words."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from helpers_paths import REPOSITORY
from pyproj import CRS

import mtpcr_geo
from mtpcr_geo.core.cloud import ArrayCloud, Cloud
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export.apply import apply_transform
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.registration import register


def run_pdal(pdal: Any, stages: list[Any]) -> np.ndarray:
    pipeline = pdal.Pipeline(json.dumps(stages))
    pipeline.execute()
    return np.concatenate(pipeline.arrays)


def run_ours(stages: list[Any], **settings: Any) -> mtpcr_geo.Pipeline:
    pipeline = mtpcr_geo.Pipeline(stages, **settings)
    pipeline.validate()
    pipeline.execute()
    return pipeline


def assert_same_points(ours: np.ndarray, theirs: np.ndarray) -> None:
    names = theirs.dtype.names or ()
    assert set(ours.dtype.names or ()) == set(names)
    for name in names:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


CLEAN_UPS: dict[str, list[Any]] = {
    "streamed": [
        {"type": "filters.range", "limits": "Classification[2:2]"},
        {"type": "filters.assign", "value": "Classification = 8"},
    ],
    "whole": [
        {"type": "filters.outlier", "mean_k": 6},
        {"type": "filters.range", "limits": "Classification![7:7]"},
    ],
    "ground": [{"type": "filters.smrf"}, {"type": "filters.range", "limits": "Classification[2:2]"}],
    "thinned": [{"type": "filters.sample", "radius": 2.0}],
    "voxels": [{"type": "filters.voxelcentroidnearestneighbor", "cell": 2.0}],
    "reprojected": [{"type": "filters.reprojection", "out_srs": "EPSG:32633"}],
}


@pytest.mark.parametrize("name", CLEAN_UPS)
def test_clean_up_gives_the_points_pdal_gives(name, pdal, town_files):
    stages = [str(town_files[1]), *CLEAN_UPS[name]]
    ours = run_ours(stages)
    assert_same_points(np.concatenate(ours.arrays), run_pdal(pdal, stages))


@pytest.mark.slow
def test_clean_up_of_real_data_gives_the_points_pdal_gives(pdal, shared_data):
    for pair in ("coast_town_sparse_ign382", "park_two_epochs_ttp"):
        stages = [str(shared_data / pair / "source.laz"), *CLEAN_UPS["whole"], {"type": "filters.smrf"}]
        ours = run_ours(stages)
        assert_same_points(np.concatenate(ours.arrays), run_pdal(pdal, stages))


@pytest.mark.parametrize("name", ["streamed", "whole"])
def test_clean_up_reaches_our_stages_unchanged(name, pdal, town_files):
    stages = [str(town_files[1]), *CLEAN_UPS[name]]
    expected = run_pdal(pdal, stages)
    ours = run_ours(
        [*stages, {"type": "mtpcr.level", "tag": "level", "method": "none"}, {"type": "mtpcr.bev"}]
    )
    levelled = ours.stages["level"]
    assert isinstance(levelled, Pair)
    side = levelled.target
    xyz = np.concatenate(list(side.cloud.xyz_chunks(10_000)))
    np.testing.assert_array_equal(xyz, np.column_stack([expected[axis] for axis in "XYZ"]))
    assert side.cloud.crs is not None
    assert side.cloud.crs.to_epsg() == 25833
    assert side.cloud.count == len(expected)


def test_reprojection_changes_the_crs_our_stages_see(pdal, town_files):
    stages = [str(town_files[1]), {"type": "filters.reprojection", "out_srs": "EPSG:32633"}]
    ours = run_ours([*stages, {"type": "mtpcr.level", "tag": "level", "method": "none"}])
    levelled = ours.stages["level"]
    assert isinstance(levelled, Pair)
    assert levelled.frame.crs is not None
    assert levelled.frame.crs.to_epsg() == 32633


def test_streamed_chain_larger_than_what_is_kept_streams_again(pdal, town_files, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.pipeline.pdal.cloud._KEEP_BYTES", 1000)
    stages = [str(town_files[1]), *CLEAN_UPS["streamed"]]
    ours = run_ours(stages)
    assert_same_points(np.concatenate(ours.arrays), run_pdal(pdal, stages))


def test_writers_in_the_middle_write_once_and_pass_on(pdal, town_files, tmp_path):
    raster = {
        "type": "writers.gdal",
        "filename": str(tmp_path / "top.tif"),
        "resolution": 1,
        "output_type": "max",
    }
    cloud = {"type": "writers.las", "filename": str(tmp_path / "kept.laz"), "compression": "laszip"}
    ours = run_ours(
        [
            str(town_files[1]),
            *CLEAN_UPS["whole"],
            {**cloud, "tag": "kept"},
            {**raster, "inputs": ["kept"]},
            {"type": "mtpcr.level", "method": "none", "inputs": ["kept"]},
        ]
    )
    assert {path.name for path in ours.outputs} == {"top.tif", "kept.laz"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept.laz", "top.tif"]
    expected = run_pdal(pdal, [str(town_files[1]), *CLEAN_UPS["whole"]])
    assert len(laspy.read(tmp_path / "kept.laz")) == len(expected)


def test_numbered_files_of_a_splitter(pdal, town_files, tmp_path):
    stages = [str(town_files[1]), {"type": "filters.splitter", "length": 100}]
    writer = {"type": "writers.las", "filename": str(tmp_path / "tile_#.laz"), "compression": "laszip"}
    ours = run_ours([*stages, writer])
    tiles = sorted(tmp_path.iterdir())
    assert sorted(ours.outputs) == tiles
    assert len(tiles) > 1
    assert sum(len(laspy.read(tile)) for tile in tiles) == 60_000


def test_metadata_and_results_by_tag(pdal, town_files):
    stages = [{"type": "readers.las", "filename": str(town_files[1]), "tag": "all"}]
    ours = run_ours([*stages, {"type": "filters.stats", "tag": "statistics", "dimensions": "Z"}])
    statistic = ours.metadata["metadata"]["filters.stats"]["statistic"]
    assert statistic["count"] == 60_000 if isinstance(statistic, dict) else statistic[0]["count"] == 60_000
    assert ours.metadata["stages"]["statistics"]["seconds"] > 0
    passed = ours.stages["statistics"]
    assert isinstance(passed, Cloud)
    assert passed.count == 60_000


def test_our_las_reader_and_crop_give_what_pdal_gives(pdal, town_files):
    target = laspy.read(town_files[1])
    x, y = target.header.mins[:2] + 20
    bounds = f"([{x}, {x + 50}], [{y}, {y + 50}])"
    stages = [str(town_files[1]), {"type": "filters.crop", "bounds": bounds}]
    ours = np.concatenate(run_ours(stages).arrays)
    theirs = run_pdal(pdal, stages)
    for name in ("X", "Y", "Z", "Intensity", "Classification", "GpsTime", "ReturnNumber", "PointSourceId"):
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


def test_classes_and_flags_of_points_that_pdal_reads(pdal, tmp_path):
    rng = np.random.default_rng(5)
    xyz = rng.uniform(0, 50, (300, 3)).round(3)
    rows = [f"{x},{y},{z},200" for x, y, z in xyz]
    (tmp_path / "points.csv").write_text("\n".join(["X,Y,Z,Classification", *rows]) + "\n")
    las = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
    las.header.scales = np.full(3, 0.001)
    las.x, las.y, las.z = xyz.T
    las.classification = np.full(300, 5, np.uint8)
    las.withheld = np.arange(300) < 20
    las.write(tmp_path / "old.las")
    every = {"type": "filters.range", "limits": "Z[0:100]", "tag": "last"}
    for reader, name, noise, kind in (("text", "points.csv", 0, 200), ("las", "old.las", 20, 5)):
        stages = [{"type": f"readers.{reader}", "filename": str(tmp_path / name)}, every]
        cloud = run_ours(stages).stages["last"]
        assert isinstance(cloud, Cloud)
        assert sum(int(mask.sum()) for _, mask in cloud.noise_chunks()) == noise
        write_cloud(tmp_path / "out.las", cloud, None, None)
        after = laspy.read(tmp_path / "out.las")
        assert set(np.asarray(after.classification)) == {kind}
        assert int(np.asarray(after.withheld).sum()) == noise


def test_moved_cloud_goes_on_in_pdal(pdal, town_files, tmp_path):
    source, target = (str(file) for file in town_files)
    ours = run_ours(
        [
            target,
            source,
            {"type": "mtpcr.register", "tag": "pair"},
            {"type": "mtpcr.apply", "tag": "moved"},
            {"type": "filters.range", "limits": "Classification[6:6]"},
            {"type": "writers.las", "filename": str(tmp_path / "roofs.laz"), "compression": "laszip"},
        ]
    )
    applied = ours.stages["moved"]
    assert isinstance(applied, Cloud)
    moved = np.concatenate(list(applied.xyz_chunks()))
    roofs = np.asarray(laspy.read(source).classification) == 6
    written = laspy.read(tmp_path / "roofs.laz")
    assert written.header.parse_crs().to_epsg() == 25833
    np.testing.assert_allclose(np.asarray(written.xyz), moved[roofs], atol=0.0061)


def test_clean_then_register(pdal, town_files, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source, target = town_files
    text = (REPOSITORY / "pipelines" / "clean_then_register.json").read_bytes()
    pipeline = mtpcr_geo.Pipeline(text, [f"--target.filename={target}", f"--source.filename={source}"])
    pipeline.validate()
    pipeline.execute()
    assert pipeline.verdict is not None
    assert pipeline.verdict.name == "accepted"
    written = laspy.read(tmp_path / "out" / "registered.laz")
    assert {1, 2} <= set(np.unique(written.classification).tolist())
    assert written.header.version.minor == 4


@pytest.mark.parametrize("where", ["town", "real"])
def test_plain_pdal_applies_the_transform_as_we_do(where, pdal, request, tmp_path, monkeypatch):
    if where == "town":
        source, target = request.getfixturevalue("town_files")
        options: dict[str, Any] = {}
    else:
        folder = request.getfixturevalue("shared_data") / "delft_urban_ahn3"
        source, target = folder / "source.laz", folder / "target.laz"
        options = {"source_crs": "EPSG:28992", "target_crs": "EPSG:28992"}
    out = tmp_path / "out"
    register(source, target, out, recording=False, **options)
    monkeypatch.chdir(out)  # its paths are as seen from where it lies
    pdal.Pipeline((out / "transform.pdal.json").read_text(encoding="utf-8")).execute()
    apply_transform(out / "transform.json", source, tmp_path / "ours.laz")
    (theirs,) = out.glob("*_registered.la?")
    mine, plain = laspy.read(tmp_path / "ours.laz"), laspy.read(theirs)
    before = laspy.read(source)
    assert len(mine) == len(plain) == len(before)
    np.testing.assert_allclose(np.asarray(mine.xyz), np.asarray(plain.xyz), rtol=0, atol=0.00101)
    kept = (
        "intensity",
        "classification",
        "return_number",
        "number_of_returns",
        "point_source_id",
        "gps_time",
    )
    for name in kept:
        np.testing.assert_array_equal(mine[name], plain[name], err_msg=name)
        np.testing.assert_array_equal(mine[name], before[name], err_msg=name)
    extra = set(before.point_format.extra_dimension_names)
    assert extra <= set(mine.point_format.extra_dimension_names)


def test_half_a_file_is_never_left(pdal, town_files, tmp_path):
    cut = tmp_path / "cut.laz"
    cut.write_bytes(town_files[1].read_bytes()[:100_000])
    before = sorted(tmp_path.iterdir())
    stages: list[Any] = [str(cut), {"type": "filters.outlier"}, str(tmp_path / "out" / "clean.laz")]
    with pytest.raises(mtpcr_geo.core.errors.MtpcrError, match="PDAL says"):
        run_ours(stages)
    assert sorted(tmp_path.iterdir()) == before


def test_paths_with_spaces(pdal, town_files, tmp_path: Path):
    place = tmp_path / "with a space"
    place.mkdir()
    (place / "in put.laz").write_bytes(town_files[1].read_bytes())
    ours = run_ours([str(place / "in put.laz"), *CLEAN_UPS["streamed"], str(place / "out put.laz")])
    assert [path.name for path in ours.outputs] == ["out put.laz"]


def test_benchmark_of_rasters_runs(pdal, town_files):
    done = subprocess.run(
        [
            sys.executable,
            REPOSITORY / "examples" / "benchmark_bev.py",
            town_files[1],
            "--runs",
            "1",
            "--json",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    table = json.loads(done.stdout)
    assert set(table) == {"mtpcr-geo", "PDAL"}
    assert all(row["best_s"] > 0 for row in table.values())


@pytest.mark.parametrize(
    ("code", "place", "size"),
    [
        ("EPSG:4979", [9.0, 50.0, 100.0], 1e-3),
        ("EPSG:4978", [4.06e6, 6.4e5, 4.86e6], 50.0),
        ("EPSG:25832+5783", [5e5, 5.5e6, 100.0], 50.0),
    ],
)
def test_points_are_handed_to_pdal_whatever_their_system(code, place, size, pdal, tmp_path):
    crs = CRS.from_user_input(code)
    xyz = np.array(place) + np.random.default_rng(2).uniform(0, size, (400, 3))
    write_cloud(tmp_path / "in.laz", ArrayCloud(xyz, crs), None, crs)
    reader = {"type": "mtpcr.read", "filename": str(tmp_path / "in.laz")}
    crop = {"type": "filters.crop", "bounds": f"([{place[0] - 1}, {place[0] + size / 2}], [0, 1e8])"}
    writer = {"type": "mtpcr.write", "filename": str(tmp_path / "out.laz")}
    run_ours([reader, crop, {"type": "filters.outlier", "multiplier": 100}, writer])
    written, found = open_cloud(tmp_path / "in.laz"), open_cloud(tmp_path / "out.laz")
    kept = written.to_array()
    kept = kept[kept[:, 0] <= place[0] + size / 2]
    assert found.count == len(kept) < 400
    assert np.abs(found.to_array() - kept).max() < 1e-5 * size
    assert found.crs is not None
    assert found.crs.equals(crs, ignore_axis_order=True)
