"""transform.pdal.json writes what registered.laz holds, in every point format and dimension."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.crs import TransformChain, resolve_frames
from mtpcr_geo.export.pdal_file import write_pdal_pipeline
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud

UTM = CRS.from_epsg(25832)
T = transforms.compose(transforms.yaw_matrix(0.4), np.array([12.0, -7.0, 1.0]))
SKIPPED = {"scan_angle_rank", "raw_classification"}


def source(path: Path, point_format: int) -> Path:
    """A file with random values in every dimension that registering keeps."""
    rng = np.random.default_rng(3)
    n = 500
    header = laspy.LasHeader(version="1.4" if point_format > 5 else "1.3", point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.array([500_000.0, 5_200_000.0, 0.0])
    header.add_extra_dims([laspy.ExtraBytesParams("amplitude", "f4"), laspy.ExtraBytesParams("echo", "u2")])
    header.vlrs.append(laspy.VLR("maker", 9, "calibration", b"\x01\x02\x03"))
    header.file_source_id = 12
    if point_format > 5:
        header.add_crs(UTM)
    las = laspy.LasData(header)
    las.xyz = rng.uniform(0, 100, (n, 3)) + header.offsets
    modern = point_format > 5
    returns = rng.integers(1, 15 if modern else 5, n)
    las.return_number, las.number_of_returns = returns, np.minimum(returns + 1, 15 if modern else 5)
    las.classification = rng.choice([2, 6, 12, 64, 65, 255] if modern else [2, 6, 31], n)
    las.intensity, las.user_data = rng.integers(0, 65535, n), rng.integers(0, 255, n)
    las.point_source_id = rng.integers(0, 65535, n)
    las.scan_direction_flag, las.edge_of_flight_line = rng.integers(0, 2, n), rng.integers(0, 2, n)
    las.amplitude, las.echo = rng.uniform(0, 9, n).astype(np.float32), rng.integers(0, 65535, n)
    if modern:
        las.scan_angle = rng.integers(-15000, 15001, n)
        las.scanner_channel, las.overlap = rng.integers(0, 4, n), rng.integers(0, 2, n)
        las.synthetic, las.key_point = rng.integers(0, 2, n), rng.integers(0, 2, n)
        las.withheld = rng.integers(0, 2, n)
    else:
        las.scan_angle_rank = rng.integers(-90, 91, n)
    for name in ("gps_time", "red", "green", "blue", "nir"):
        if name in las.point_format.dimension_names:
            las[name] = rng.integers(0, 65535, n)
    las.write(path)
    return path


def pair_of(path: Path) -> Pair:
    cloud = open_cloud(path, UTM)
    target = ArrayCloud(cloud.to_array() + [30.0, 20.0, 5.0], UTM, name="target.laz")
    frame, target_link, source_link = resolve_frames(target, cloud)
    sides = [
        Side("target", target, target_link, target_link.to_work(target.xyz)),
        Side("source", cloud, source_link, source_link.to_work(cloud.to_array())),
    ]
    return Pair(target=sides[0], source=sides[1], frame=frame, T_target_source=T)


@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_every_dimension_is_that_of_the_registered_cloud(point_format, tmp_path, monkeypatch, pdal):
    pair = pair_of(source(tmp_path / "source.laz", point_format))
    chain = TransformChain.of(pair)
    write_cloud(tmp_path / "registered.laz", pair.source.cloud, chain.forward, UTM)
    folder = tmp_path / "out"
    folder.mkdir()
    # as a run does it: under a temporary name elsewhere, for that folder
    write_pdal_pipeline(tmp_path / "part", pair, folder)
    text = (tmp_path / "part").read_text()
    assert json.loads(text)["pipeline"][0]["filename"] == "../source.laz"
    monkeypatch.chdir(folder)
    pdal.Pipeline(text).execute()
    ours = laspy.read(tmp_path / "registered.laz")
    theirs = laspy.read(next(folder.glob("source_registered.la*")))
    assert theirs.header.point_format.id == ours.header.point_format.id
    assert theirs.header.file_source_id == 12
    assert np.array_equal(theirs.header.scales, ours.header.scales)
    names = set(ours.point_format.dimension_names) - set("XYZ") - SKIPPED
    assert {"amplitude", "echo"} <= names
    different = [name for name in sorted(names) if not np.array_equal(ours[name], theirs[name])]
    assert different == []
    assert np.abs(ours.xyz - theirs.xyz).max() <= 1e-9
    assert [vlr.record_data for vlr in theirs.header.vlrs if vlr.user_id == "maker"] == [b"\x01\x02\x03"]
