"""Scale and offset of what is written: they suit the points, whatever a header says of them."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from pyproj import CRS

from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud

UTM = CRS.from_epsg(25832)


def site(n: int = 2_000) -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 100, (n, 3)) + [600_000.0, 5_000_000.0, 100.0]


def fine_file(path, xyz):
    """A LAS file at the finest scale that is written, with its bounds set to zero."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.0001), np.array([600_000.0, 5_000_000.0, 100.0])
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.write(path)
    with path.open("r+b") as stream:
        stream.seek(179)
        stream.write(bytes(48))
    return path


@pytest.mark.parametrize("suffix", ["las", "laz", "copc.laz"])
def test_no_returns_far_from_the_cloud_are_kept_where_they_fit(tmp_path, suffix):
    # the first chunk tells nothing of the points at the local origin, 500 km away
    xyz = np.vstack([site(), np.tile([600_000.0, 4_500_000.0, 0.0], (50, 1))])
    cloud = ArrayCloud(xyz)
    path = tmp_path / f"out.{suffix}"
    assert write_cloud(path, cloud, None, UTM, 0.0001) == 50
    assert write_cloud(path, cloud, None, UTM) == 0
    assert np.abs(np.sort(laspy.read(path).xyz, axis=0) - np.sort(xyz, axis=0)).max() <= 0.0005001


@pytest.mark.parametrize(("far", "left_out"), [(9e9, 3), (5e6, 3), (4e6, 0)])
def test_few_stray_points_do_not_cost_the_others(tmp_path, far, left_out):
    xyz = site()
    xyz[[7, 900, 1999], 0] = far
    written = write_cloud(tmp_path / "out.laz", ArrayCloud(xyz), None, UTM)
    assert written == left_out
    found = laspy.read(tmp_path / "out.laz").xyz
    kept = xyz if not left_out else np.delete(xyz, [7, 900, 1999], axis=0)
    assert np.abs(found - kept).max() <= 0.0005001


def test_many_points_apart_are_refused(tmp_path):
    xyz = site()
    xyz[::3, 0] += 9e9
    with pytest.raises(OutputError, match=r"do not fit a LAS file at scale 0\.001"):
        write_cloud(tmp_path / "out.laz", ArrayCloud(xyz), None, UTM)
    write_cloud(tmp_path / "out.laz", ArrayCloud(xyz), None, UTM, 10.0)


def test_a_scale_that_is_asked_for_is_kept(tmp_path):
    xyz = np.vstack([site(), [[600_000.0, 4_000_000.0, 0.0]]])
    assert write_cloud(tmp_path / "out.laz", ArrayCloud(xyz), None, UTM, 0.0001) == 1
    assert laspy.read(tmp_path / "out.laz").header.scales[0] == 0.0001


@pytest.mark.parametrize("code", ["EPSG:4326", "EPSG:4979", "EPSG:4326+5773"])
def test_a_scale_for_degrees_is_a_length(code, tmp_path):
    crs = CRS.from_user_input(code)
    xyz = np.array([9.0, 50.0, 100.0]) + np.random.default_rng(1).uniform(0, [0.01, 0.01, 20], (500, 3))
    cloud = ArrayCloud(xyz, crs)
    write_cloud(tmp_path / "out.laz", cloud, None, crs, 0.001)
    written = laspy.read(tmp_path / "out.laz")
    assert np.allclose(written.header.scales, [1e-8, 1e-8, 0.001], rtol=1e-12)
    assert (np.abs(written.xyz - xyz).max(axis=0) <= [0.51e-8, 0.51e-8, 0.51e-3]).all()
    # one for each axis is in the unit of that axis
    write_cloud(tmp_path / "each.laz", cloud, None, crs, (1e-7, 1e-6, 0.01))
    assert laspy.read(tmp_path / "each.laz").header.scales.tolist() == [1e-7, 1e-6, 0.01]


def test_a_finer_scale_grows_where_the_header_promised_less(tmp_path):
    # returning_scales trusts the header that all lies on one place: a hundredth of a millimetre spans 21 km
    xyz = site()
    xyz[::2, 1] += 80_000.0
    cloud = open_cloud(fine_file(tmp_path / "in.las", xyz))
    assert write_cloud(tmp_path / "out.las", cloud, None, UTM, returning=True) == 0
    assert np.abs(laspy.read(tmp_path / "out.las").xyz - cloud.to_array()).max() <= 0.0001


def test_degrees_grow_to_a_millimetre(tmp_path):
    xyz = np.vstack([np.random.default_rng(2).uniform(0, 0.01, (500, 3)) + [11.0, 47.0, 100.0], [[0, 0, 0]]])
    wgs84 = CRS.from_epsg(4326)
    assert write_cloud(tmp_path / "a.las", ArrayCloud(xyz), None, wgs84) == 1  # 47 degrees are too far
    xyz[-1] = [0, 30, 0]
    assert write_cloud(tmp_path / "a.las", ArrayCloud(xyz), None, wgs84) == 0
    assert np.abs(laspy.read(tmp_path / "a.las").xyz - xyz).max(axis=0)[:2].max() <= 5.1e-9


def test_progress_counts_every_point_once(tmp_path):
    xyz = site()
    xyz[1999, 0] = 9e9
    counted: list[int] = []
    write_cloud(tmp_path / "out.laz", ArrayCloud(xyz), None, UTM, advance=counted.append)
    assert sum(counted) == 2000
