"""What is seen of a LAS file through a view is written as the file itself would be."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.views import Cropped, Head, Moved
from mtpcr_geo.io.write import write_cloud

N = 900
XYZ = np.round(np.random.default_rng(5).uniform(0, 30, (N, 3)), 4) + [5e5, 5.5e6, 100.0]
BOX = ((5e5, 5e5 + 15), (5.5e6, 5.5e6 + 30))
INSIDE = XYZ[:, 0] <= BOX[0][1]


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A file with a fine scale, identifiers, a record of its own, and a scaled extra dimension."""
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, 0.0001), np.array([5e5, 5.5e6, 100.0])
    header.file_source_id = 77
    header.vlrs.append(laspy.VLR("Acme", 7, "calibration", b"abc"))
    header.add_extra_dim(
        laspy.ExtraBytesParams("amplitude", "u2", scales=np.array([0.01]), offsets=np.array([0.0]))
    )
    las = laspy.LasData(header)
    las.xyz = XYZ
    las["amplitude"] = np.arange(N) % 600 / 100
    las.scan_angle = np.arange(N) - 400
    las.red = np.arange(N)
    las.write(tmp_path / "scan.laz")
    return tmp_path / "scan.laz"


def views(path: Path) -> dict[str, tuple[Cloud, np.ndarray]]:
    cloud, rows = open_cloud(path), np.arange(N)
    return {
        "the first": (Head(cloud, 500), rows[:500]),
        "a part": (Cropped(cloud, [BOX]), rows[INSIDE]),
        "the rest": (Cropped(cloud, [BOX], outside=True), rows[~INSIDE]),
        "a part of the first": (Cropped(Head(cloud, 500), [BOX]), rows[:500][INSIDE[:500]]),
    }


@pytest.mark.parametrize("ending", ["las", "laz", "copc.laz"])
@pytest.mark.parametrize("name", ["the first", "a part", "the rest", "a part of the first"])
def test_a_view_of_a_file_keeps_what_the_file_has(name, ending, scan, tmp_path):
    cloud, rows = views(scan)[name]
    write_cloud(tmp_path / f"out.{ending}", cloud, None, None)
    first, found = laspy.read(scan), laspy.read(tmp_path / f"out.{ending}")
    assert found.header.scales.tolist() == [0.0001] * 3
    assert found.header.file_source_id == 77
    assert [one.record_data for one in found.vlrs if one.user_id == "Acme"] == [b"abc"]
    order = np.argsort(found.red)
    for dimension in ("amplitude", "scan_angle", "red", "x", "y", "z"):
        expected = np.asarray(first[dimension])[rows]
        assert np.allclose(np.asarray(found[dimension])[order], expected, rtol=0, atol=1e-9), dimension
    (extra,) = found.point_format.extra_dimensions
    assert extra.scales is not None
    assert extra.scales[0] == 0.01


def test_a_view_that_is_moved_keeps_it_too(scan, tmp_path):
    moved = Moved(Head(open_cloud(scan), 500), lambda xyz: xyz + 1.0, None)
    write_cloud(tmp_path / "out.laz", moved.base, moved.move, None)
    found = laspy.read(tmp_path / "out.laz")
    assert found.header.file_source_id == 77
    assert np.abs(found.xyz - (XYZ[:500] + 1.0)).max() < 1e-6


def test_a_view_of_nothing_is_not_written(scan, tmp_path):
    nothing = Cropped(open_cloud(scan), [((0.0, 1.0), (0.0, 1.0))])
    with pytest.raises(InputError, match="empty"):
        write_cloud(tmp_path / "out.laz", nothing, None, None)
