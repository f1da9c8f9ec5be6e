"""The files for QGIS, without QGIS: rasters, styles, tie points, the project."""

from __future__ import annotations

import csv
import sqlite3
import zipfile
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from helpers_scene import ORIGIN, make_pair, make_sides
from pyproj import CRS
from rasterio.enums import ColorInterp

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.types import Hypothesis, Pair, Rival, Verdict
from mtpcr_geo.export import difference, georeferencer, geotiff, raster_styles, resample, styles, tie_points
from mtpcr_geo.export.qgis.layers import LayerFile
from mtpcr_geo.export.qgis.project import About, write_project
from mtpcr_geo.pipeline.runner import RunResult
from mtpcr_geo.registration import Registration


def saved(pair: Pair, out: Path, failure: str | None = None) -> Path:
    Registration(RunResult({"assess": pair}, (), (), failure)).save(out)
    return out


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The files of an accepted registration."""
    return saved(make_pair(20_000), tmp_path_factory.mktemp("qgis") / "out")


def moved_by(pair: Pair, *shift: float) -> Pair:
    """Return a pair whose transform puts the source somewhere else, metres."""
    assert pair.T_target_source is not None
    return pair.with_(T_target_source=transforms.translation(np.array(shift)) @ pair.T_target_source)


def project_of(out: Path) -> ElementTree.Element:
    with zipfile.ZipFile(out / "project.qgz") as archive:
        assert archive.namelist() == ["project.qgs"]
        return ElementTree.fromstring(archive.read("project.qgs"))


def layers_of(project: ElementTree.Element) -> dict[str, ElementTree.Element]:
    return {layer.findtext("id", ""): layer for layer in project.iter("maplayer")}


def names_of(project: ElementTree.Element) -> list[str | None]:
    tree = project.find("layer-tree-group")
    assert tree is not None
    return [group.get("name") for group in tree.findall("layer-tree-group")]


def test_rasters_are_cloud_optimized_and_begin_with_heights(run):
    for role in ("source", "target", "registered", "difference"):
        with rasterio.open(run / "bev" / f"{role}.tif") as file:
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert file.colorinterp[0] == ColorInterp.gray
            assert set(file.colorinterp[1:]) == {ColorInterp.undefined}
            assert file.units[0] == "metre"
            assert all(file.descriptions)
            assert ("highest" if role != "difference" else "registered minus target") in file.descriptions[0]


def test_a_large_raster_is_laid_out_from_coarse_to_fine(tmp_path):
    target, _ = make_sides(4000, cell=0.2)
    geotiff.write_side_bev(tmp_path / "t.tif", target)
    data = (tmp_path / "t.tif").read_bytes()
    with rasterio.open(tmp_path / "t.tif") as file:
        assert file.overviews(1) == [2, 4]
    # the directories of all overviews stand before the values
    assert b"LAYOUT=IFDS_BEFORE_DATA" in data[:400]


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_the_difference_is_registered_minus_target(tmp_path, tilt):
    pair = make_pair(60_000, tilt=tilt)
    raised = moved_by(pair, 0.0, 0.0, 0.4)
    for one, expected in ((pair, 0.0), (raised, 0.4)):
        found = difference.height_difference(one)
        assert found is not None
        difference.write_difference(tmp_path / "d.tif", found, one)
        with rasterio.open(tmp_path / "d.tif") as file:
            assert file.crs.to_epsg() == 25833
            low, top = file.read()
            assert np.isnan(file.nodata)
        known = low[np.isfinite(low)]
        assert known.size > 8000
        assert np.median(known) == pytest.approx(expected, abs=0.05)
        assert np.nanmedian(top) == pytest.approx(expected, abs=0.05)
    # each cell is the one of the registered raster less that of the target
    if tilt == 0.0:
        moved = resample.registered_bev(pair)
        found = difference.height_difference(pair)
        assert found is not None
        row, column = np.argwhere(np.isfinite(found.low))[0]
        xy = found.grid.to_metres(np.array([[column, row]], np.float64))
        values = []
        for bev in (moved, pair.target.bev):
            assert bev is not None
            (c, r) = np.rint(bev.grid.to_pixel(xy)).astype(int)[0]
            values.append(float(bev.low[r, c]))
        assert found.low[row, column] == pytest.approx(values[0] - values[1], abs=1e-5)


def test_clouds_side_by_side_have_no_difference(tmp_path):
    pair = make_pair(3000)
    apart = moved_by(pair, 500.0, 0.0, 0.0)
    assert difference.height_difference(apart) is None
    out = saved(apart.with_(verdict=Verdict("accepted", ("fits",), {})), tmp_path / "out")
    assert not (out / "bev" / "difference.tif").exists()
    assert "evidence_tie_points" in layers_of(project_of(out))


def test_a_levelled_target_is_laid_upright_beside_the_registered_source(tmp_path):
    pair = make_pair(20_000, crs=None, tilt=0.0)
    turned = transforms.compose(transforms.tilt_matrix(0.3, 0.1), np.zeros(3))
    levelled = transforms.apply(turned, pair.target.sample)
    from dataclasses import replace

    from helpers_scene import rasterise

    from mtpcr_geo.core.types import Levelling

    target = replace(pair.target, levelling=Levelling(turned, "plane"), bev=rasterise(levelled))
    out = saved(pair.with_(target=target), tmp_path / "out")
    layers = layers_of(project_of(out))
    assert layers["after_target_colours"].findtext("datasource") == "./bev/target_upright.tif"
    with rasterio.open(out / "bev" / "difference.tif") as file:
        assert abs(float(np.nanmedian(file.read(1)))) < 0.1
    assert not (saved(pair, tmp_path / "flat") / "bev" / "target_upright.tif").exists()


def test_every_raster_has_a_style_for_its_first_band(run):
    limits = {}
    for path in sorted((run / "bev").glob("*.tif")):
        root = ElementTree.parse(path.with_suffix(".qml")).getroot()
        (renderer,) = root.iter("rasterrenderer")
        assert (renderer.get("type"), renderer.get("band")) == ("singlebandpseudocolor", "1")
        low, high = (float(renderer.get(f"classification{end}", "nan")) for end in ("Min", "Max"))
        limits[path.stem] = (low, high)
        values = [float(item.get("value", "nan")) for item in root.iter("item")]
        assert values == sorted(values)
        assert (values[0], values[-1]) == pytest.approx((low, high))
        with rasterio.open(path) as file:
            heights = file.read(1)
        share = np.nanmean((heights >= low) & (heights <= high) | np.isnan(heights))
        assert share > 0.6
    # the same colours for the same heights, where one lies over the other
    assert limits["registered"] != limits["source"]
    low, high = limits["difference"]
    assert low == -high


@pytest.mark.parametrize("spread", [0.0, 0.01, 0.1, 30.0])
def test_limits_follow_the_data_between_bounds(spread):
    rng = np.random.default_rng(1)
    values = rng.normal(0.0, 1.0, (80, 80)).astype(np.float32) * np.float32(spread)
    values[:5] = np.nan
    limit = raster_styles.difference_limit(values)
    assert limit == pytest.approx(np.clip(np.ceil(spread * 50) / 10, 0.2, 1.0), abs=0.101)
    low, high = raster_styles.height_limits([values, values[:2]])
    assert high - low >= raster_styles.SMALLEST_RANGE_M
    nothing = np.full((3, 3), np.nan, np.float32)
    assert raster_styles.height_limits([nothing]) == (0.0, raster_styles.SMALLEST_RANGE_M)
    assert raster_styles.difference_limit(nothing) == raster_styles.LARGEST_DIFFERENCE_M


def test_every_layer_of_the_geopackage_has_style_and_names(run):
    with closing(sqlite3.connect(run / "ties.gpkg")) as base:
        query = "SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault = 1"
        rows = base.execute(query).fetchall()
        tables = base.execute("SELECT table_name FROM gpkg_contents WHERE data_type = 'features'").fetchall()
        assert sorted(name for name, _ in rows) == sorted(name for (name,) in tables)
        for name, text in rows:
            root = ElementTree.fromstring(text)
            assert root.find("renderer-v2") is not None, name
            fields = [row[1] for row in base.execute(f"PRAGMA table_info({name})")][2:]
            named = {one.get("field"): one.get("name") for one in root.iter("alias")}
            assert list(named) == fields
            assert all(named.values())
            assert "(m)" in str(named.get("plan_m", "(m)"))


def test_tie_points_thin_out(run):
    """Those drawn at a scale are as far apart as the style says, and stand for those that are not."""
    with closing(sqlite3.connect(run / "ties.gpkg")) as base:
        spacing, inlier = np.array(base.execute("SELECT spacing_m, inlier FROM tie_points").fetchall()).T
    pair = make_pair(20_000)
    assert pair.tie_points is not None
    plan = tie_points.tie_positions(pair)[0][:, :2]
    shown_before = len(spacing) + 1
    for scale in (500.0, 5_000.0, 50_000.0, 5_000_000.0):
        least = styles.LEAST_SPACING_MM / 1000.0 * scale
        for kind in (True, False):
            of_kind = inlier.astype(bool) == kind
            shown = of_kind & ((spacing >= least) | (spacing == spacing[of_kind].max()))
            apart = np.linalg.norm(plan[shown][:, None] - plan[shown][None], axis=2)
            apart[np.eye(len(apart), dtype=bool)] = np.inf
            assert apart.min(initial=np.inf) >= least or shown.sum() == 1
            hidden = np.linalg.norm(plan[of_kind & ~shown][:, None] - plan[shown][None], axis=2)
            # each hidden one is hidden by one less than twice the spacing away at most
            assert not hidden.size or hidden.min(axis=1).max() < max(2 * least, 130.0)
        number = int((spacing >= least).sum())
        assert number <= shown_before
        shown_before = number


def test_hypotheses_stay_inside_the_target(tmp_path):
    pair = make_pair(3000)
    assert pair.matches is not None
    from dataclasses import replace

    far = tuple(Hypothesis(0.3 * k, (70.0 * k, -55.0 * k), 10.0 - k, 900) for k in range(5))
    pair = pair.with_(matches=replace(pair.matches, hypotheses=far))
    tie_points.write_tie_points(tmp_path / "t.gpkg", pair)
    with closing(sqlite3.connect(tmp_path / "t.gpkg")) as base:
        extent = base.execute(
            "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = 'hypotheses'"
        ).fetchone()
    low, high = transforms.bounds(pair.target.sample)
    assert np.all(np.array(extent[:2]) >= low[:2] + ORIGIN[:2] - 1e-6)
    assert np.all(np.array(extent[2:]) <= high[:2] + ORIGIN[:2] + 1e-6)


def test_points_take_the_sources_raster_to_the_target(run):
    lines = (run / "bev" / "source.tif.points").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("#CRS: ")
    assert CRS.from_wkt(lines[0].removeprefix("#CRS: ")).to_epsg() == 25833
    rows = list(csv.DictReader(lines[1:]))
    pair = make_pair(20_000)
    assert pair.tie_points is not None
    assert [row["enable"] == "1" for row in rows] == pair.tie_points.inlier.tolist()
    used = np.array([[float(row[key]) for key in ("sourceX", "sourceY", "mapX", "mapY")] for row in rows])
    used = used[pair.tie_points.inlier]
    # a Helmert transform, as the Georeferencer fits it: source to map, complex numbers for plan coordinates
    source, target = (used[:, k] + 1j * used[:, k + 1] for k in (0, 2))
    a = np.column_stack([source - source.mean(), np.ones(len(source))])
    (factor, _), *_ = np.linalg.lstsq(a, target - target.mean(), rcond=None)
    T = pair.T_level_target_source
    assert abs(factor) == pytest.approx(1.0, abs=2e-3)
    assert np.angle(factor) == pytest.approx(transforms.yaw_of(T[:3, :3]), abs=2e-3)
    with rasterio.open(run / "bev" / "source.tif") as file:
        box = file.bounds
    inside = (used[:, 0] > box.left) & (used[:, 0] < box.right) & (used[:, 1] > box.bottom)
    assert np.all(inside & (used[:, 1] < box.top))
    with pytest.raises(OutputError, match="cannot write"):
        georeferencer.write_points(run / "no" / "s.points", pair)


def test_the_project_names_files_that_are_there(run):
    project = project_of(run)
    assert names_of(project) == ["Evidence", "After", "Before"]
    layers = layers_of(project)
    assert len(layers) == 14
    for key, layer in layers.items():
        # QGIS makes up ids of its own for shorter ones
        assert len(key) > 10
        file, _, table = layer.findtext("datasource", "").partition("|layername=")
        assert file.startswith("./")
        assert (run / file).is_file(), file
        assert (layer.get("type") == "vector") == bool(table)
        style = layer.find("renderer-v2" if table else "pipe")
        assert style is not None, key
        if key != "before_source_colours" and key != "before_source_shading":
            assert layer.findtext("srs/spatialrefsys/authid") == "EPSG:25833", key
    tree_ids = {one.get("id") for one in project.findall("./layer-tree-group//layer-tree-layer")}
    assert tree_ids == set(layers)
    themes = {one.get("name"): one for one in project.iter("visibility-preset")}
    assert set(themes) == {"Before", "After", "Evidence"}
    for theme in themes.values():
        assert {one.get("id") for one in theme.findall("layer")} <= set(layers)
    items = {one.get("id") for one in project.iter("LayoutItem")}
    assert {"page", "title", "verdict", "After", "Evidence", "north"} <= items
    assert "\\" not in ElementTree.tostring(project, encoding="unicode")
    assert str(run) not in ElementTree.tostring(project, encoding="unicode")


def test_the_project_opens_at_the_overlap(run):
    project = project_of(run)
    ends = ("xmin", "ymin", "xmax", "ymax")
    view = [float(project.findtext(f"mapcanvas/extent/{end}", "")) for end in ends]
    with rasterio.open(run / "bev" / "difference.tif") as file:
        box = file.bounds
    assert view[0] < box.left < box.right < view[2]
    assert view[1] < box.bottom < box.top < view[3]
    assert view[2] - view[0] < 1.2 * max(box.right - box.left, box.top - box.bottom)
    groups = {one.get("name"): one.get("checked") for one in project.findall("layer-tree-group/*")}
    assert groups == {"Evidence": "Qt::Unchecked", "After": "Qt::Checked", "Before": "Qt::Unchecked"}


def test_a_refused_run_shows_what_there_is(tmp_path):
    refused = make_pair(3000).with_(verdict=Verdict("refused", ("no",), {}))
    out = saved(refused, tmp_path / "out")
    project = project_of(out)
    assert names_of(project) == ["Evidence", "Before"]
    assert not any("registered.tif" in layer.findtext("datasource", "") for layer in project.iter("maplayer"))
    checked = {one.get("name"): one.get("checked") for one in project.findall("layer-tree-group/*")}
    assert checked["Before"] == "Qt::Checked"
    assert "Refused" in project.findtext("projectMetadata/abstract", "")


def test_a_pair_without_a_transform_has_a_project(tmp_path):
    out = saved(make_pair(1000, state="matched"), tmp_path / "out", "nothing agrees")
    assert "Before" in names_of(project_of(out))
    assert not (out / "bev" / "source.tif.points").exists()


def test_names_are_data_and_no_expressions(tmp_path):
    pair = make_pair(1000).with_(verdict=Verdict("doubtful", ("x",), {}, (Rival(1.0, 0.0, 0.0, 1.1, False),)))
    out = saved(pair, tmp_path / "out")
    files = {
        role: LayerFile(f"./bev/{role}.tif", out / "bev" / f"{role}.tif")
        for role in ("source", "target", "registered", "difference")
    }
    hostile = About("a[% env('HOME') %]<b>\x1b[2J&\u202e.laz", "\udc80.laz", "so [%1+1%] <&> \x00")
    write_project(tmp_path / "p.qgz", files, LayerFile("./ties.gpkg", out / "ties.gpkg"), hostile)
    with zipfile.ZipFile(tmp_path / "p.qgz") as archive:
        text = archive.read("project.qgs").decode("ascii")
    root = ElementTree.fromstring(text)
    labels = [one.get("labelText", "") for one in root.iter("LayoutItem")]
    assert not any("[% env" in label or "[%1+1" in label for label in labels)
    assert "\x1b" not in text
    with pytest.raises(OutputError, match="cannot write the project"):
        write_project(tmp_path / "no" / "p.qgz", files, None, hostile)


def test_the_same_files_make_the_same_project(run, tmp_path):
    files = {"target": LayerFile("./bev/target.tif", run / "bev" / "target.tif")}
    for name in ("a.qgz", "b.qgz"):
        write_project(tmp_path / name, files, None, About("s", "t", "x"))
    assert (tmp_path / "a.qgz").read_bytes() == (tmp_path / "b.qgz").read_bytes()


def test_ramps_rise():
    for ramp in (raster_styles.RELIEF, raster_styles.DIFFERENCE):
        places = [place for place, _ in ramp]
        assert (places[0], places[-1]) == (0.0, 1.0)
        assert all(one < other for one, other in pairwise(places))
