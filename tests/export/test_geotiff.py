"""What GIS programs read back from the rasters and the tie points, by value."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing

import numpy as np
import pytest
import rasterio
from helpers_scene import ORIGIN, SHIFT, YAW, make_pair, make_sides, true_transform
from pyproj import CRS

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.crs import FrameLink, WorkFrame
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export import geotiff, resample, tie_points
from mtpcr_geo.export.geopackage import Layer, blob, write_geopackage


def tiny_bev() -> Bev:
    top = np.array([[1.0, 2.0, np.nan], [4.5, 5.0, 6.25]], np.float32)
    count = np.array([[3, 1, 0], [2, 7, 9]], np.uint32)
    return Bev(Grid(-10.0, 20.0, 0.5, 3, 2), top, top - np.float32(0.5), count)


def test_values_positions_and_tags(tmp_path):
    path = tmp_path / ".target.part-1.tif"
    geotiff.write_bev(path, tiny_bev(), WorkFrame(CRS("EPSG:25833"), ORIGIN), tags={"ROLE": "target"})
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    with rasterio.open(path) as file:
        assert file.crs.to_epsg() == 25833
        assert file.dtypes == ("float32",) * 3
        assert np.isnan(file.nodata)
        assert file.units == ("metre", "metre", "count")
        assert "metres" in file.descriptions[0]
        assert file.tags()["AREA_OR_POINT"] == "Area"
        assert file.tags()["ROLE"] == "target"
        assert file.tags()["LEVELLED"] == "no"
        assert file.profile["compress"] == "deflate"
        # the edge of the corner cell, and half a cell in, its centre
        assert (file.transform.c, file.transform.f) == (ORIGIN[0] - 10.0, ORIGIN[1] + 20.0)
        assert file.xy(0, 0) == (ORIGIN[0] - 9.75, ORIGIN[1] + 19.75)
        top, low, count = file.read()
        assert top[1, 0] == 34.5
        assert low[1, 0] == 34.0
        assert np.isnan(top[0, 2])
        assert np.isnan(low[0, 2])
        assert count.tolist() == [[3, 1, 0], [2, 7, 9]]
        value = next(file.sample([(ORIGIN[0] - 9.75, ORIGIN[1] + 19.25)]))
        assert value.tolist() == [34.5, 34.0, 2.0]


def test_a_cell_sits_where_its_points_are(tmp_path):
    target, _ = make_sides(4000)
    geotiff.write_side_bev(tmp_path / "t.tif", target)
    xyz = target.cloud.xyz[:500]
    with rasterio.open(tmp_path / "t.tif") as file:
        values = np.array(list(file.sample(xyz[:, :2])))
    assert np.all(values[:, 0] >= xyz[:, 2] - 1e-3)
    assert np.all(values[:, 1] <= xyz[:, 2] + 1e-3)
    assert np.all(values[:, 2] >= 1)


def test_overviews_for_large_rasters_only(tmp_path):
    frame = WorkFrame(None, np.zeros(3))
    top = np.arange(600 * 700, dtype=np.float32).reshape(600, 700)
    large = Bev(Grid(0.0, 0.0, 1.0, 700, 600), top, top, np.ones(top.shape, np.uint32))
    geotiff.write_bev(tmp_path / "large.tif", large, frame)
    geotiff.write_bev(tmp_path / "tiny.tif", tiny_bev(), frame)
    with rasterio.open(tmp_path / "large.tif") as file:
        assert file.overviews(1) == [2, 4]
        assert file.block_shapes[0] == (256, 256)
        assert file.crs is None
        assert tuple(file.transform)[:6] == (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    with rasterio.open(tmp_path / "tiny.tif") as file:
        assert file.overviews(1) == []


@pytest.mark.parametrize("shape", [(600, 700), (513, 389), (257, 3)])
def test_overviews_keep_highest_lowest_and_number(tmp_path, shape):
    rng = np.random.default_rng(2)
    count = rng.integers(0, 4, shape).astype(np.uint32)
    count[:8, :8] = 0  # nodata at the two finest overviews, and a block further on
    count[100:101, :1] = 7
    top = np.where(count > 0, rng.uniform(0, 9, shape), np.nan).astype(np.float32)
    bev = Bev(Grid(-10.0, 20.0, 0.5, shape[1], shape[0]), top, top - np.float32(2.0), count)
    geotiff.write_bev(tmp_path / "bev.tif", bev, WorkFrame(CRS("EPSG:25833"), ORIGIN))
    assert [file.name for file in tmp_path.iterdir()] == ["bev.tif"]
    with rasterio.open(tmp_path / "bev.tif") as file:
        whole = file.read()
        factors = file.overviews(1)
        assert factors[0] == 2
        assert factors == file.overviews(2) == file.overviews(3)
        assert file.tags()["AREA_OR_POINT"] == "Area"
        assert file.tags()["LEVELLED"] == "no"
        assert file.units == ("metre", "metre", "count")
        assert file.profile["compress"] == "deflate"
        bounds = file.bounds
    np.testing.assert_array_equal(whole[0], (top.astype(np.float64) + ORIGIN[2]).astype(np.float32))
    np.testing.assert_array_equal(whole[2], count)
    for level, factor in enumerate(factors):
        with rasterio.open(tmp_path / "bev.tif", overview_level=level) as file:
            reduced = file.read()
            assert file.bounds == bounds
            assert file.profile["compress"] == "deflate"
        rows, columns = -(-shape[0] // factor), -(-shape[1] // factor)
        assert reduced.shape == (3, rows, columns)
        places = [(0, 0), (1, 0), (rows - 1, columns - 1), (100 // factor, 0), (rows // 2, columns // 2)]
        for row, column in places:
            part = whole[:, row * factor : (row + 1) * factor, column * factor : (column + 1) * factor]
            seen = part[:, np.isfinite(part[0])]
            expected = [seen[0].max(), seen[1].min()] if seen.size else [np.nan, np.nan]
            np.testing.assert_array_equal(reduced[:, row, column], [*expected, part[2].sum()])
        assert reduced[2].sum() == count.sum()


def test_a_tilted_frame_is_no_crs_and_says_so(tmp_path):
    target, source = make_sides(3000, tilt=0.1)
    geotiff.write_bev(
        tmp_path / "s.tif",
        source.bev,
        WorkFrame(target.link.file_crs, ORIGIN),
        T_level_work=source.T_level_work,
    )
    with rasterio.open(tmp_path / "s.tif") as file:
        assert file.crs is None
        assert file.tags()["LEVELLED"] == "yes"
        numbers = np.array([float(text) for text in file.tags()["T_LEVEL_WORK"].split()])
        assert np.array_equal(numbers.reshape(4, 4), source.T_level_work)


def test_feet_are_never_called_metres(tmp_path):
    target, _ = make_sides(2000)
    feet = FrameLink(CRS("EPSG:2225"), ORIGIN, factor=np.full(3, 1200 / 3937))
    side = type(target)("target", target.cloud, feet, target.sample, bev=target.bev)
    geotiff.write_side_bev(tmp_path / "no.tif", side)
    geotiff.write_side_bev(tmp_path / "yes.tif", side, WorkFrame(CRS("EPSG:25833"), ORIGIN))
    with rasterio.open(tmp_path / "no.tif") as no, rasterio.open(tmp_path / "yes.tif") as yes:
        assert no.crs is None
        assert yes.crs.to_epsg() == 25833


def test_unwritable_raster_is_our_error(tmp_path):
    with pytest.raises(OutputError, match="cannot write the raster"):
        geotiff.write_bev(tmp_path / "no" / "t.tif", tiny_bev(), WorkFrame(None, np.zeros(3)))


@pytest.mark.parametrize("tilt", [0.0, 0.15])
def test_registered_source_lies_on_the_target(tmp_path, tilt):
    pair = make_pair(60_000, tilt=tilt)
    geotiff.write_registered_bev(tmp_path / "r.tif", pair)
    geotiff.write_side_bev(tmp_path / "t.tif", pair.target)
    rng = np.random.default_rng(3)
    xy = rng.uniform(-50, 50, (2000, 2)) + ORIGIN[:2]
    with rasterio.open(tmp_path / "r.tif") as moved, rasterio.open(tmp_path / "t.tif") as target:
        assert moved.crs == target.crs
        a = np.array(list(moved.sample(xy)))[:, 0]
        b = np.array(list(target.sample(xy)))[:, 0]
    both = np.isfinite(a) & np.isfinite(b)
    assert both.mean() > 0.95
    assert np.median(np.abs(a - b)[both]) < 0.15


def test_warp_by_whole_cells_is_exact():
    bev = tiny_bev()
    T = transforms.translation((2.0, -1.0, 3.0))
    grid = resample.grid_around(bev, T)
    moved = resample.warp_bev(bev, T, grid)
    column, row = np.rint(grid.to_pixel(np.array([[-9.75 + 2.0, 19.25 - 1.0]])))[0].astype(int)
    assert moved.top[row, column] == pytest.approx(7.5)
    assert moved.count.sum() == bev.count.sum()


def test_a_thin_scan_keeps_its_cells_under_a_tilt():
    """Lines of single cells at many heights, as of a spinning scanner, none of which a tilt may lose."""
    rng = np.random.default_rng(5)
    top = np.full((60, 80), np.nan, np.float32)
    top[::7] = rng.uniform(-20.0, 20.0, (9, 80))
    count = np.isfinite(top).astype(np.uint32)
    bev = Bev(Grid(-20.0, 15.0, 0.5, 80, 60), top, top, count)
    T = transforms.compose(transforms.tilt_matrix(0.7, 0.12), np.array([3.0, 1.0, 0.5]))
    moved = resample.warp_bev(bev, T, resample.grid_around(bev, T))
    row, column = np.nonzero(count)
    plan = bev.grid.to_metres(np.column_stack([column, row]).astype(float))
    xyz = transforms.apply(T, np.column_stack([plan, top[row, column]]))
    found_column, found_row = moved.grid.cells(xyz)
    assert np.all(moved.count[found_row, found_column] > 0)
    alone = (
        np.bincount(found_row * moved.grid.width + found_column)[found_row * moved.grid.width + found_column]
        == 1
    )
    height = moved.top[found_row, found_column]
    # some cells take a neighbour's, as the nearest
    assert np.mean(np.abs(height - xyz[:, 2])[alone] < 1e-3) > 0.6


def test_ties_open_in_gdal_where_they_belong(tmp_path):
    pyogrio = pytest.importorskip("pyogrio")
    pair = make_pair(3000)
    tie_points.write_tie_points(tmp_path / "t.gpkg", pair)
    layers = dict(pyogrio.list_layers(tmp_path / "t.gpkg"))
    assert layers["tie_points"] == "Point Z"
    assert layers["links"] == "LineString Z"
    assert layers["footprints"] == "Polygon"
    info, _, shapes, fields = pyogrio.raw.read(tmp_path / "t.gpkg", layer="tie_points")
    table = dict(zip(info["fields"], fields, strict=True))
    assert info["crs"] == "EPSG:25833"
    xyz = np.array([struct.unpack("<BI3d", shape)[2:] for shape in shapes])
    assert pair.tie_points is not None
    assert np.allclose(xyz, pair.tie_points.target + ORIGIN)
    assert table["held_out"].sum() == 16
    assert table["inlier"].dtype == bool
    source = np.column_stack([table["source_x"], table["source_y"], table["source_z"]])
    moved = transforms.apply(TransformChain.of(pair).T_file, source)
    assert np.allclose(np.linalg.norm(moved - xyz, axis=1), table["residual_m"])
    info, _, _, fields = pyogrio.raw.read(tmp_path / "t.gpkg", layer="footprints")
    assert info["crs"] == "EPSG:25833"
    assert sorted(fields[list(info["fields"]).index("role")]) == ["source", "target"]


def test_footprints_of_both_clouds_coincide():
    rings = tie_points.footprints(make_pair(20_000))
    for ring in rings.values():
        assert np.array_equal(ring[0], ring[-1])
        assert np.allclose(np.abs([ring.min(axis=0), ring.max(axis=0)]), 60.0, atol=0.5)


def test_hypotheses_are_the_middle_of_what_both_would_share(tmp_path):
    pair = make_pair(3000)
    tie_points.write_tie_points(tmp_path / "t.gpkg", pair)
    with closing(sqlite3.connect(tmp_path / "t.gpkg")) as base:
        rows = base.execute("SELECT rank, yaw_deg, shift_x_m, geom FROM hypotheses ORDER BY rank").fetchall()
    assert len(rows) == 5
    assert rows[0][1] == pytest.approx(np.rad2deg(YAW))
    assert rows[0][2] == pytest.approx(SHIFT[0])
    place = np.array(struct.unpack("<3d", rows[0][3][-24:]))
    bev = pair.target.bev
    assert bev is not None
    moved = transforms.apply(true_transform(), pair.source.sample)
    column, row = np.rint(bev.grid.to_pixel(moved[:, :2])).astype(int).T
    inside = (column >= 0) & (column < bev.grid.width) & (row >= 0) & (row < bev.grid.height)
    inside[inside] = bev.count[row[inside], column[inside]] > 0
    expected = moved[inside].mean(axis=0) + ORIGIN
    assert 100 < inside.sum() < len(inside)
    assert np.allclose(place[:2], expected[:2], atol=1e-6)


@pytest.mark.parametrize(("state", "layers"), [("levelled", 1), ("matched", 2), ("tied", 3), ("solved", 4)])
def test_ties_of_an_unfinished_run(tmp_path, state, layers):
    tie_points.write_tie_points(tmp_path / "t.gpkg", make_pair(1000, state=state))
    with closing(sqlite3.connect(tmp_path / "t.gpkg")) as base:
        (count,) = base.execute("SELECT count(*) FROM gpkg_contents WHERE data_type = 'features'").fetchone()
        assert count == layers
        if state == "tied":
            (missing,) = base.execute("SELECT count(*) FROM tie_points WHERE residual_m IS NULL").fetchone()
            assert missing == 80


def test_geopackage_says_what_it_is(tmp_path):
    path = tmp_path / "x.gpkg"
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 0]])
    write_geopackage(path, [Layer("a", "POLYGON", [square], {"n": np.array([1])}, style="<qgis/>")], None)
    assert [file.name for file in tmp_path.iterdir()] == ["x.gpkg"]
    with closing(sqlite3.connect(path)) as base:
        assert base.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert base.execute("PRAGMA foreign_key_check").fetchall() == []
        assert base.execute("SELECT srs_id FROM gpkg_contents WHERE table_name = 'a'").fetchone() == (-1,)
        assert base.execute("SELECT styleQML FROM layer_styles").fetchone() == ("<qgis/>",)


def test_geometry_bytes_by_hand():
    data = blob("POINT", np.array([[1.0, 2.0, 3.0]]), 4326)
    assert data == (
        b"GP\x00\x03" + struct.pack("<i4d", 4326, 1, 1, 2, 2) + struct.pack("<BI3d", 1, 1001, 1, 2, 3)
    )


def test_unwritable_ties_are_our_error(tmp_path):
    with pytest.raises(OutputError, match="cannot write"):
        tie_points.write_tie_points(tmp_path / "no" / "t.gpkg", make_pair(500))
