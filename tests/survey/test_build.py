from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
import rasterio
import rasterio.shutil
from helpers_survey import digests, tiles_of, town_target, write_tile
from pyproj import CRS

from mtpcr_geo.core.errors import CrsError, InputError, OptionError, OutputError
from mtpcr_geo.core.types import Bev
from mtpcr_geo.crs.facts import facts_of, same_place
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.method.bev import coarsen, rasterise
from mtpcr_geo.survey.build import build_survey
from mtpcr_geo.survey.cut import cut_out
from mtpcr_geo.survey.index import Survey
from mtpcr_geo.survey.mosaic import BLOCK_CELLS, FACTORS, Frame, Mosaic
from mtpcr_geo.survey.options import BuildOptions
from mtpcr_geo.survey.vrt import write_virtual

HERE = BuildOptions(workers=1, cell=0.25)


@pytest.fixture(scope="module")
def tiles(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return tiles_of(tmp_path_factory.mktemp("tiles"), town_target(points=20_000))


@pytest.fixture(scope="module")
def built(tiles: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Survey:
    return build_survey(tiles, tmp_path_factory.mktemp("survey"), HERE).survey


def points_of(tiles: list[Path]) -> np.ndarray:
    return np.concatenate([open_any(tile).to_array() for tile in tiles])


def test_neighbouring_tiles_merge_as_one_cloud(built: Survey, tiles: list[Path]) -> None:
    assert len(built.mosaic.places()) > 1
    xyz = points_of(tiles)
    bounds = np.stack([xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)])
    fine = rasterise([np.round(xyz, 5)], built.mosaic.read(bounds, 1).grid)
    for factor in FACTORS:
        read = built.mosaic.read(bounds, factor)
        whole = coarsen(fine, factor)
        assert (read.count.sum(), read.grid) == (len(xyz), whole.grid)
        np.testing.assert_array_equal(read.count, whole.count)
        np.testing.assert_array_equal(read.top, whole.top)
        np.testing.assert_array_equal(read.low, whole.low)


def test_a_window_is_a_part_of_the_whole(built: Survey) -> None:
    box = built.bounds[:, :2]
    whole = built.mosaic.read(box, 4)
    inner = np.stack([box[0] + [31.3, 17.9], box[1] - [22.1, 40.6]])
    part = built.mosaic.read(inner, 4)
    column = round((part.grid.west - whole.grid.west) / part.grid.cell)
    row = round((whole.grid.north - part.grid.north) / part.grid.cell)
    cut = (slice(row, row + part.grid.height), slice(column, column + part.grid.width))
    np.testing.assert_array_equal(part.top, whole.top[cut])
    # beyond the survey there is nothing
    far = built.mosaic.read(box + 10_000.0, 1)
    assert not far.count.any()
    assert np.isnan(far.top).all()


def test_virtual_rasters_are_the_mosaic(built: Survey) -> None:
    for number, (band, factor) in enumerate((("top", 1), ("low", 4), ("count", 32))):
        with rasterio.open(built.folder / f"{band}_{0.25 * factor:g}m.vrt") as opened:
            assert opened.crs.to_epsg() == 25833
            west, south, east, north = opened.bounds
            seen = opened.read(1)
        bev = built.mosaic.read(np.array([[west, south], [east, north]]) + [[0.01], [-0.01]], factor)
        expected = (bev.top, bev.low, bev.count.astype(np.float32))[number]
        assert seen.shape == expected.shape
        # where there is no block at all, counts are empty too
        held = ~np.isnan(seen)
        np.testing.assert_array_equal(seen[held], expected[held])
        assert not bev.count[~held].any()


@pytest.mark.parametrize(
    "name",
    ["EPSG:25832", "EPSG:2180", "EPSG:2193", "EPSG:3006", "EPSG:31467", "EPSG:3031", "EPSG:32661",
     "EPSG:32761", "EPSG:5042", "EPSG:2225", "EPSG:25832+7837", "EPSG:2180+9651"],
)  # fmt: skip
def test_virtual_rasters_have_the_axes_that_gdal_gives_them(name: str, tmp_path: Path) -> None:
    crs = CRS.from_user_input(name)
    mosaic = Mosaic(tmp_path, Frame(crs.to_wkt(), 1.0))
    grid = mosaic.frame.grid_of((1000, 2000))
    filled = np.zeros(grid.shape, np.float32)
    mosaic.write((1000, 2000), Bev(grid, filled, filled, np.ones(grid.shape, np.uint32)), "")
    write_virtual(mosaic, [(1000, 2000)])
    by_gdal = tmp_path / "by_gdal.vrt"
    rasterio.shutil.copy(mosaic.path_of((1000, 2000)), by_gdal, driver="VRT")
    ours, theirs = (ElementTree.parse(path).find("SRS") for path in (tmp_path / "top_1m.vrt", by_gdal))
    assert ours is not None
    assert theirs is not None
    assert ours.attrib == theirs.attrib
    with rasterio.open(tmp_path / "top_1m.vrt") as one, rasterio.open(by_gdal) as other:
        assert one.crs == other.crs
        assert one.transform == other.transform
        assert one.bounds == other.bounds


def test_blocks_are_cloud_optimised(built: Survey) -> None:
    with rasterio.open(built.mosaic.path_of(built.mosaic.places()[0])) as opened:
        assert opened.overviews(1) == list(FACTORS[1:])
        assert opened.shape == (BLOCK_CELLS, BLOCK_CELLS)
        assert opened.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"


def test_the_index_is_a_virtual_point_cloud(built: Survey, tiles: list[Path]) -> None:
    cloud = open_any(built.folder / "index.vpc")
    assert cloud.count == len(points_of(tiles))
    again = Survey.open(built.folder)
    assert again == built
    assert all(tile.unchanged() for tile in again.tiles)
    assert all(tile.date for tile in again.tiles)


def test_the_index_is_what_qgis_and_pdal_wrench_read(built: Survey, tiles: list[Path]) -> None:
    index = json.loads((built.folder / "index.vpc").read_text(encoding="utf-8"))
    for feature, tile in zip(index["features"], built.tiles, strict=True):
        href = feature["assets"]["data"]["href"]
        # nothing else is resolved against the folder of the index
        assert href.startswith("./")
        assert (built.folder / href).resolve() == tile.path
        about = feature["properties"]
        west, south, _, east, north, _ = about["proj:bbox"]
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        assert about["proj:geometry"] == {"type": "Polygon", "coordinates": [ring]}
        schemas = {one["name"]: (one["type"], one["size"]) for one in about["pc:schemas"]}
        assert schemas["X"] == schemas["Z"] == schemas["GpsTime"] == ("floating", 8)
        assert schemas["Intensity"] == schemas["PointSourceId"] == ("unsigned", 2)
        assert schemas["Classification"] == schemas["ReturnNumber"] == ("unsigned", 1)
        assert schemas["ScanAngleRank"] == ("floating", 4)
        table = next(iter(open_any(tile.path).table_chunks(10)))
        assert list(schemas) == list(table)


def test_indices_of_earlier_builds_are_read(built: Survey, tiles: list[Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(built.folder, tmp_path / "survey"))
    index = json.loads((folder / "index.vpc").read_text(encoding="utf-8"))
    for feature, tile in zip(index["features"], built.tiles, strict=True):
        feature["assets"]["data"]["href"] = os.path.relpath(tile.path, folder)
        del feature["properties"]["pc:schemas"], feature["properties"]["proj:geometry"]
    (folder / "index.vpc").write_text(json.dumps(index), encoding="utf-8")
    assert open_any(folder / "index.vpc").count == len(points_of(tiles))
    assert [tile.path for tile in Survey.open(folder).tiles] == [tile.path for tile in built.tiles]
    # they are told more of a tile where it was kept, and nothing is read again for it
    again = build_survey(tiles, folder, HERE)
    assert again.read == 0
    assert again.survey.tiles == built.tiles


def test_the_dimensions_of_points_are_those_of_their_files(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).uniform([0, 0, 0], [50, 50, 9], (100, 3))
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.add_extra_dim(laspy.ExtraBytesParams("height", "3f4"))
    las = laspy.LasData(header)
    las.xyz = xyz
    las.write(tmp_path / "extra.las")
    np.save(tmp_path / "plain.npy", xyz)
    options = BuildOptions(workers=1, cell=1.0, crs="EPSG:25832")
    tiles = [tmp_path / "extra.las", tmp_path / "plain.npy"]
    extra, plain = build_survey(tiles, tmp_path / "survey", options).survey.tiles
    assert plain.dimensions == (("X", "floating", 8), ("Y", "floating", 8), ("Z", "floating", 8))
    assert {("Red", "unsigned", 2), ("height0", "floating", 4), ("height2", "floating", 4)} <= {
        *extra.dimensions
    }


def test_only_what_is_new_or_changed_is_read(tiles: list[Path], tmp_path: Path) -> None:
    own = [Path(shutil.copy2(tile, tmp_path)) for tile in tiles]
    first = build_survey(own[:3], tmp_path / "survey", HERE)
    assert first.read == 3
    second = build_survey([own[3]], tmp_path / "survey", HERE)
    assert (second.read, len(second.survey.tiles)) == (1, 4)
    assert 0 < second.merged <= len(second.survey.tiles[-1].blocks)
    nothing = build_survey(own, tmp_path / "survey", HERE)
    assert (nothing.read, nothing.merged) == (0, 0)
    fresh = build_survey(own, tmp_path / "fresh", HERE)
    assert digests(tmp_path / "survey") == digests(tmp_path / "fresh")
    # a tile that has changed is read again, and its old points are gone from the blocks
    write_tile(own[0], open_any(own[0]).to_array()[:1000])
    changed = build_survey(own, tmp_path / "survey", HERE)
    assert changed.read == 1
    counts = changed.survey.mosaic.read(changed.survey.bounds[:, :2], 1).count
    assert (
        counts.sum()
        == len(points_of(own))
        < fresh.survey.mosaic.read(fresh.survey.bounds[:, :2], 1).count.sum()
    )
    pruned = build_survey(own[:1], tmp_path / "survey", HERE.model_copy(update={"prune": True}))
    assert [tile.path.name for tile in pruned.survey.tiles] == ["tile0.laz"]
    assert len(pruned.survey.mosaic.places()) == len(pruned.survey.tiles[0].blocks)


def test_a_tile_that_is_gone_is_named_and_pruned(tiles: list[Path], tmp_path: Path) -> None:
    own = [Path(shutil.copy2(tile, tmp_path)) for tile in tiles]
    survey = build_survey(own, tmp_path / "survey", HERE).survey
    box = survey.bounds[:, :2]
    own[0].rename(tmp_path / "moved.laz")
    write_tile(own[1], points_of(own[1:2])[:1000])
    with pytest.raises(InputError, match=r"tile0\.laz .* is no longer there; .* --prune"):
        cut_out(survey, box)
    # what has changed is read again though it is not named; what is gone stays, and is said
    again = build_survey(own[2:], tmp_path / "survey", HERE)
    assert (again.read, again.gone, len(again.survey.tiles)) == (1, (own[0],), 4)
    named = [*own[1:], tmp_path / "moved.laz"]
    pruned = build_survey(named, tmp_path / "survey", HERE.model_copy(update={"prune": True}))
    assert (pruned.read, pruned.gone) == (1, ())
    assert cut_out(pruned.survey, box).count == len(points_of(named))


def test_a_build_that_was_stopped_goes_on_to_the_same_bits(
    built: Survey, tiles: list[Path], tmp_path: Path
) -> None:
    folder = tmp_path / "survey"
    shutil.copytree(built.folder, folder)
    # as if it had been killed: no index, some tiles and blocks not done, one half written
    (folder / "index.vpc").unlink()
    for path in (*sorted(folder.glob("tiles/*.npz"))[:2], *sorted(folder.glob("bev/*/*.tif"))[1:]):
        path.unlink()
    for path in folder.glob("*.vrt"):
        path.unlink()
    block = next(iter(folder.glob("bev/*/*.tif")))
    block.with_name(".y0.part-1.tif").write_bytes(b"half")
    with pytest.raises(InputError, match="not built to its end"):
        Survey.open(folder)
    again = build_survey(tiles, folder, HERE)
    assert again.read == 2
    # the index names tiles relative to the survey, which is elsewhere
    moved = {name: value for name, value in digests(folder).items() if name != "index.vpc"}
    assert moved == {name: value for name, value in digests(built.folder).items() if name != "index.vpc"}


def test_a_tile_that_cannot_be_used_is_named_and_the_others_are(tiles: list[Path], tmp_path: Path) -> None:
    broken = tmp_path / "broken.laz"
    broken.write_bytes(tiles[0].read_bytes()[:-2000])
    elsewhere = write_tile(tmp_path / "elsewhere.laz", points_of(tiles[:1]), CRS.from_epsg(25832))
    found = build_survey([tiles[0], broken, elsewhere], tmp_path / "survey", HERE)
    assert set(found.failed) == {broken, elsewhere}
    assert "the survey in ETRS89 / UTM zone 33N" in found.failed[elsewhere]
    assert [tile.path for tile in Survey.open(tmp_path / "survey").tiles] == [tiles[0]]


def test_what_cannot_be_a_survey_is_refused(tiles: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the tile"):
        build_survey([tmp_path / "none.laz"], tmp_path / "survey", HERE)
    degrees = write_tile(
        tmp_path / "degrees.laz", np.random.default_rng(0).random((500, 3)), CRS.from_epsg(4979)
    )
    with pytest.raises(CrsError, match="projected CRS"):
        build_survey([degrees], tmp_path / "survey", HERE)
    bare = write_tile(tmp_path / "bare.laz", np.random.default_rng(0).random((500, 3)) * 50, None)
    with pytest.raises(CrsError, match="--crs"):
        build_survey([bare], tmp_path / "survey", HERE)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="is no survey"):
        build_survey(tiles, tmp_path / "full", HERE)
    assert os.listdir(tmp_path / "full") == ["notes.txt"]


def test_a_survey_keeps_its_cells_and_crs(built: Survey, tiles: list[Path]) -> None:
    with pytest.raises(OptionError, match="leave --cell out"):
        build_survey(tiles, built.folder, BuildOptions(workers=1, cell=1.0))
    with pytest.raises(CrsError, match="reproject"):
        build_survey(tiles, built.folder, BuildOptions(workers=1, crs="EPSG:25832"))


def test_feet_are_told_by_the_crs(tmp_path: Path) -> None:
    feet = CRS.from_epsg(2225)  # California zone 1, US survey feet
    unit = 1200 / 3937
    metres = np.random.default_rng(0).uniform([0, 0, 10], [60, 60, 20], (5000, 3)) + [600_000, 700_000, 0]
    tile = write_tile(tmp_path / "feet.laz", metres / unit, feet)
    survey = build_survey([tile], tmp_path / "survey", BuildOptions(workers=1, cell=1.0)).survey
    assert survey.frame.unit_m == pytest.approx(unit)
    bev = survey.mosaic.read(survey.bounds[:, :2] * unit, 1)
    assert bev.count.sum() == 5000
    assert np.nanmax(bev.top) == pytest.approx(20.0, abs=0.01)
    with rasterio.open(survey.folder / "top_1m.vrt") as opened:
        assert opened.res[0] == pytest.approx(1 / unit)
        west, south, east, north = opened.bounds
    low, high = survey.bounds[:, :2]
    assert west <= low[0] <= high[0] <= east
    assert south <= low[1] <= high[1] <= north


UTM32 = CRS.from_epsg(25832)
COMPOUND = 'COMPD_CS["{0}",{1},VERT_CS["{0}",VERT_DATUM["{0}",{2}],UNIT["{3}",{4}],AXIS["Up",UP]]]'
PLAN = UTM32.to_wkt("WKT1_GDAL")
FOOT = 1200 / 3937
ELLIPSOIDAL = CRS.from_wkt(COMPOUND.format("Ellipsoid (metre)", PLAN, 2002, "metre", 1))
UNNAMED_FEET = CRS.from_wkt(COMPOUND.format("unknown", PLAN, 2005, "US survey foot", FOOT))
UNNAMED = CRS.from_wkt(COMPOUND.format("unknown", PLAN, 2005, "metre", 1))
DHHN = CRS.from_user_input("EPSG:25832+7837")


def flat_tile(path: Path, crs: CRS, east: float = 0.0) -> Path:
    xyz = np.random.default_rng(0).uniform([0, 0, 10], [60, 60, 20], (3000, 3))
    return write_tile(path, xyz + [500_000.0 + east, 5_800_000.0, 0.0], crs)


@pytest.mark.parametrize(
    ("crs", "height", "unit"),
    [
        (UTM32, "unsaid", 1.0),
        (UTM32.to_3d(), "ellipsoidal", 1.0),
        (ELLIPSOIDAL, "ellipsoidal", 1.0),
        (UNNAMED_FEET, "unsaid", FOOT),
        (UNNAMED, "unsaid", 1.0),
        (DHHN, "datum", 1.0),
    ],
    ids=["plan", "3D", "ellipsoidal", "unnamed, feet", "unnamed", "named"],
)
def test_heights_are_what_the_tiles_say_of_them(crs: CRS, height: str, unit: float, tmp_path: Path) -> None:
    tiles = [flat_tile(tmp_path / f"{east}.laz", crs, east) for east in (0, 50)]
    first = build_survey(tiles[:1], tmp_path / "survey", BuildOptions(workers=1, cell=1.0))
    # what the survey keeps is what the next tiles are held to
    both = build_survey(tiles[1:], tmp_path / "survey", BuildOptions(workers=1))
    assert not first.failed
    assert not both.failed
    survey = Survey.open(tmp_path / "survey")
    cut = cut_out(survey, survey.bounds[:, :2])
    facts = facts_of(cut.crs)
    assert (facts.height, facts.height_unit) == (height, pytest.approx(unit))
    assert cut.count == 6000
    tops = survey.mosaic.read(survey.bounds[:, :2], 1).top
    assert np.nanmax(tops) == pytest.approx(20.0 * unit, abs=0.02)
    with rasterio.open(survey.folder / "top_1m.vrt") as opened:
        assert np.nanmax(opened.read(1)) == np.nanmax(tops)
        # the rasters' heights are metres, whatever the tiles' are
        assert "foot" not in opened.crs.to_wkt()
    with rasterio.open(survey.mosaic.path_of(survey.mosaic.places()[0])) as opened:
        plan = facts_of(CRS.from_wkt(opened.crs.to_wkt())).horizontal
        assert plan is not None
        assert same_place(plan, UTM32)
        assert "foot" not in opened.crs.to_wkt()


def test_tiles_that_differ_in_heights_are_told_so(tmp_path: Path) -> None:
    plain, solid, feet = (
        flat_tile(tmp_path / f"{name}.laz", crs)
        for name, crs in (("plain", DHHN), ("solid", UTM32.to_3d()), ("feet", UNNAMED_FEET))
    )
    built = build_survey([plain, solid, feet], tmp_path / "survey", BuildOptions(workers=1, cell=1.0))
    own = "the survey in ETRS89 / UTM zone 32N with DHHN2016 height in metre"
    for tile, says in (
        (solid, "ellipsoidal height in metre"),
        (feet, "heights of no stated datum in US survey"),
    ):
        assert f"ETRS89 / UTM zone 32N with {says}" in built.failed[tile]
        assert own in built.failed[tile]
    with pytest.raises(CrsError, match=r"--crs EPSG:25832 is .* with heights of no stated datum"):
        build_survey([plain], tmp_path / "survey", BuildOptions(workers=1, crs="EPSG:25832"))
