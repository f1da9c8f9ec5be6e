"""A check as its user reads it: what matters first, nothing false, and what two clouds tell of each other."""

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS

from mtpcr_geo.check import check_clouds
from mtpcr_geo.check.findings import ABOUT_FILES

UTM = CRS.from_epsg(25832)
PLACE = np.array([440_000.0, 5_400_000.0, 120.0])


def town(seed, n=20_000):
    """Ground with relief, and boxes on it, (n, 3) metres about zero."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 1, (n, 2)) * [200.0, 160.0]
    z = 6.0 * np.sin(xy[:, 0] / 40.0) + 4.0 * np.cos(xy[:, 1] / 30.0)
    z += np.where((np.mod(xy[:, 0], 50.0) < 12.0) & (np.mod(xy[:, 1], 40.0) < 10.0), 8.0, 0.0)
    return np.column_stack([xy, z])


def write(path, xyz, crs=UTM, scale=0.001):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, scale), np.floor(xyz.min(axis=0))
    if crs is not None:
        header.vlrs.append(WktCoordinateSystemVlr(crs.to_wkt()))
    header.global_encoding.wkt = crs is not None
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.return_number[:] = las.number_of_returns[:] = 1
    las.write(path)
    return path


def codes(report):
    return [found.code for found in report.findings]


def only(report, code):
    (found,) = [found for found in report.findings if found.code == code]
    return found


def test_a_cloud_without_a_crs_that_lies_where_the_other_does(tmp_path):
    target = write(tmp_path / "t.las", town(1) + PLACE)
    same = write(tmp_path / "same.las", town(2) + PLACE, None)
    found = only(check_clouds(same, target), "same-coordinates")
    assert found.role == "source"
    assert 'source_crs="EPSG:25832"' in found.fix
    assert only(check_clouds(target, same), "same-coordinates").role == "target"
    assert check_clouds(same, target, source_crs="EPSG:25832").goes_on
    far = write(tmp_path / "far.las", town(2) + PLACE + [5_000.0, 0.0, 0.0], None)
    assert "same-coordinates" not in codes(check_clouds(far, target))
    # a local cloud may well lie at a place of the same numbers by chance: both of them tell nothing
    near = [write(tmp_path / f"local_{i}.las", town(i), None) for i in (1, 2)]
    assert "same-coordinates" not in codes(check_clouds(*near))


def test_two_clouds_without_a_crs_at_one_place(tmp_path):
    clouds = [write(tmp_path / f"{i}.las", town(i) + PLACE, None) for i in (1, 2)]
    report = check_clouds(*clouds)
    assert only(report, "same-coordinates").role == "both"
    assert codes(report)[:2] == ["crs-missing", "crs-missing"]


def test_the_wrong_way_round(tmp_path):
    local, aerial = write(tmp_path / "l.las", town(1), None), write(tmp_path / "a.las", town(2) + PLACE)
    found = only(check_clouds(aerial, local), "exchanged")
    assert found.severity == "warning"
    assert "exchanged" not in codes(check_clouds(local, aerial))
    # of two that both have a CRS, by extent and density
    dense = write(tmp_path / "d.las", town(3) * [0.2, 0.2, 1.0] + PLACE)
    sparse = write(tmp_path / "s.las", town(4, 5_000) + PLACE)
    assert "exchanged" in codes(check_clouds(sparse, dense))
    assert "exchanged" not in codes(check_clouds(dense, sparse))


@pytest.mark.parametrize("times", [1000.0, 3000.0])
def test_a_unit_that_is_seen_gives_no_second_error(tmp_path, times):
    target = write(tmp_path / "t.las", town(1), None)
    source = write(tmp_path / "s.las", town(2) * times * 20.0, None, scale=0.01)
    report = check_clouds(source, target)
    assert {found.code for found in report.findings if found.severity == "error"} == {"crs-missing"}
    fixes = [found.fix for found in report.findings if found.code == "crs-missing" and found.role == "source"]
    assert 'source_crs="local" and source_unit="mm"' in fixes[0]


def test_a_cloud_on_its_side_is_not_measured_from_that_side(tmp_path):
    xyz = town(1)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    source, target = write(tmp_path / "s.las", xyz, None), write(tmp_path / "t.las", town(2), None)
    report = check_clouds(source, target, local=True)
    assert "lies-on-its-side" in codes(report)
    assert not {"cells-few", "sparse", "flat"} & set(codes(report))


def test_a_cloud_mostly_of_holes_is_not_called_small(tmp_path):
    rng = np.random.default_rng(3)
    few = town(1)[rng.permutation(20_000)[:400]] + PLACE
    report = check_clouds(write(tmp_path / "s.las", few))
    found = only(report, "cells-few")
    assert "is spread over" in found.what
    assert "across" not in found.what


@pytest.mark.parametrize("bounds", [np.zeros(6), np.full(6, np.inf)])
def test_bounds_that_say_nothing_are_called_so(tmp_path, bounds):
    path = write(tmp_path / "s.las", town(1) + PLACE)
    data = bytearray(path.read_bytes())
    data[179 : 179 + 48] = bounds.tobytes()
    path.write_bytes(data)
    found = only(check_clouds(path), "bounds-wrong")
    assert "all zero" in found.what or "no finite" in found.what


def test_what_is_about_files_alone_comes_last(tmp_path):
    # weeks of GPS time without a week, and a cloud of which nothing tells the vertical
    target = write(tmp_path / "t.las", town(1))
    source = write(tmp_path / "s.las", town(2), None)
    las = laspy.read(source)
    las.gps_time = np.arange(len(las.points)) / 10.0
    las.write(source)
    report = check_clouds(source, target, local=True)
    notes = [found.code in ABOUT_FILES for found in report.findings if found.severity == "note"]
    assert True in notes
    assert notes == sorted(notes)


def test_files_without_a_crs_are_not_told_to_be_written_anew_for_its_bit(tmp_path):
    report = check_clouds(write(tmp_path / "s.las", town(1), None), source_crs="local")
    assert all(found.fix == "" for found in report.findings if found.code == "wkt-bit-unset")


def test_both_local_is_good_english(tmp_path):
    clouds = [write(tmp_path / f"{i}.las", town(i), None) for i in (1, 2)]
    relation = check_clouds(*clouds, local=True).relation
    assert relation is not None
    assert relation.why.startswith("both have local coordinates")
