"""A pipeline of someone else: no code of its own, and nothing beyond this machine, while validated too."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from helpers_security import VRT, WMS
from pyproj import CRS
from typer.testing import CliRunner

import mtpcr_geo
from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import MtpcrError, OptionError, OutputError
from mtpcr_geo.pipeline.grammar import link, parse
from mtpcr_geo.pipeline.pdal import bindings
from mtpcr_geo.pipeline.pdal.allowed import ALLOWED
from mtpcr_geo.pipeline.pdal.switches import Access, environment
from mtpcr_geo.pipeline.safety import check

READER = {"type": "readers.las", "filename": "target.laz"}


CLOSED = Access()


def refuse(*stages, access=CLOSED):
    check(link(parse(json.dumps([READER, *stages]))), access)


@pytest.mark.parametrize(
    "kind", ["filters.info", "writers.text", "writers.gdal", "filters.range", "writers.null"]
)
def test_no_stage_takes_a_library(kind):
    with pytest.raises(OptionError, match=r"no option 'plugin'.*say --allow-code"):
        refuse({"type": kind, "filename": "x.txt", "plugin": "evil.so"} if "writers" in kind else
               {"type": kind, "plugin": "evil.so"})  # fmt: skip


@pytest.mark.parametrize("kind", ["filters.python", "filters.shell", "filters.julia", "filters.of_tomorrow"])
def test_stages_that_run_code_or_that_nobody_knows_are_refused(kind):
    with pytest.raises(OptionError, match="say --allow-code"):
        refuse({"type": kind})
    refuse({"type": kind, "anything": 1}, access=Access(code=True))


def test_a_filter_that_writes_files_of_its_own_is_refused():
    with pytest.raises(OptionError, match=r"leaves files of its own.*--allow-code"):
        refuse({"type": "filters.csf"})
    refuse({"type": "filters.csf"}, access=Access(code=True))


def test_every_option_that_pdal_lists_is_allowed_or_left_out_on_purpose(pdal):
    left_out = {
        "log", "option_file", "reader_args",
        # written beside the set of outputs
        "density", "dir", "bundledfile",
    }  # fmt: skip
    code = {"filters.shell", "filters.python", "readers.numpy"}
    beside = {"filters.csf"}
    refused = {"writers.ept_addon", "filters.streamcallback", "readers.memoryview"}
    for name, driver in bindings.drivers().items():
        if name in code | refused | beside:
            assert name not in ALLOWED
        else:
            assert set(driver.options) - left_out <= ALLOWED[name], name


REMOTE = {
    "readers.ept, ogr in a string": {
        "type": "readers.ept", "filename": "ept.json",
        "ogr": json.dumps({"drivers": ["GeoJSON"], "datasource": "http://127.0.0.1:9/a.json"}),
    },
    "escaped slashes": {"type": "readers.ept", "filename": "e", "ogr": '{"datasource": "http:\\/\\/x/a"}'},
    "addons": {"type": "readers.ept", "filename": "e", "addons": {"Z": "https://x/addon"}},
    "addons as keys": {"type": "readers.ept", "filename": "e", "addons": '{"https://x/addon": "Z"}'},
    "JSON in JSON": {"type": "readers.ept", "filename": "e", "ogr": json.dumps(json.dumps({"a": "s3://b"}))},
    "connection": {"type": "filters.overlay", "datasource": "PG:host=x", "dimension": "Z"},
    "inline XML": {"type": "filters.dem", "raster": "<GDAL_WMS></GDAL_WMS>"},
    "query": {"type": "filters.overlay", "datasource": "a.gpkg", "query": "select * from 'PG:host=x'.t"},
    "CRS by address": {"type": "filters.reprojection", "out_srs": "http://x/4326"},
    "virtual": {"type": "filters.colorization", "raster": "/vsicurl/http:x"},
    "grid by address": {"type": "filters.projpipeline", "coord_op": "+proj=vgridshift +grids=https://x/g.tif"},
}  # fmt: skip


@pytest.mark.parametrize("name", REMOTE)
def test_remote_names_are_found_wherever_they_stand(name):
    with pytest.raises(OptionError, match=r"remote or virtual.*say --allow-network"):
        refuse(REMOTE[name])
    refuse(REMOTE[name], access=Access(network=True))


@pytest.mark.parametrize("kind", ["filters.colorization", "filters.dem", "filters.hag_dem", "readers.gdal"])
@pytest.mark.parametrize("file", ["a.vrt", "b.vrt", "wms.xml", "dem.tif"])
def test_files_that_name_remote_ones_are_looked_into(kind, file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.vrt").write_text(VRT.format(url="/vsicurl/http://127.0.0.1/a.tif"))
    Path("b.vrt").write_text(VRT.format(url="sub/c.dat"))
    Path("sub").mkdir()
    Path("sub/c.dat").write_text(VRT.format(url="../wms.xml"))
    for name in ("wms.xml", "dem.tif"):
        Path(name).write_text("\ufeff  " + WMS.format(url="http://127.0.0.1"), encoding="utf-8")
    option = "filename" if kind == "readers.gdal" else "raster"
    with pytest.raises(OptionError, match="which names something remote or virtual"):
        refuse({"type": kind, option: file})


def test_a_local_vrt_is_no_matter_nor_one_that_names_itself(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.vrt").write_text(VRT.format(url="b.vrt"))
    Path("b.vrt").write_text(VRT.format(url="a.vrt"))
    refuse({"type": "filters.dem", "raster": "a.vrt"})


@pytest.mark.parametrize("name", ["scan_1:a.laz", "<b>.laz", "PG:x.laz"])
def test_a_colon_in_the_name_of_a_cloud_is_no_connection(name):
    check(link(parse(json.dumps([{"type": "readers.las", "filename": name}, "o.laz"]))), CLOSED)
    with pytest.raises(OptionError, match="remote or virtual"):
        check(link(parse(json.dumps([{"type": "readers.gdal", "filename": name}, "o.laz"]))), CLOSED)


@pytest.mark.parametrize("as_text", [True, False])
def test_a_crs_as_json_names_a_schema_that_nobody_fetches(as_text):
    srs = CRS.from_epsg(25833).to_json_dict()
    assert srs["$schema"].startswith("https://")
    refuse({"type": "filters.reprojection", "out_srs": json.dumps(srs) if as_text else srs})
    with pytest.raises(OptionError, match="remote or virtual"):
        refuse({"type": "filters.reprojection", "out_srs": srs | {"$schema": "https://x/proj.org/schemas/"}})


def test_writers_of_several_files_are_refused():
    for stage, words in (
        ({"type": "writers.ogr", "filename": "a.shp"}, "shapefile"),
        ({"type": "writers.ogr", "filename": "a", "ogrdriver": "ESRI Shapefile"}, "several files"),
        ({"type": "writers.gdal", "filename": "a.img", "gdaldriver": "ENVI"}, "several files"),
    ):
        with pytest.raises(OutputError, match=words):
            refuse(stage, access=Access(code=True, network=True))
    with pytest.raises(OptionError, match="is not run"):
        refuse({"type": "writers.ept_addon", "addons": {}}, access=Access(code=True))


def test_the_switches_are_those_of_the_process_alone(monkeypatch):
    monkeypatch.setenv("http_proxy", "http://mine")
    closed, network = environment(Access()), environment(Access(network=True))
    assert closed["http_proxy"] != "http://mine"
    assert network["http_proxy"] == "http://mine"
    assert closed["GDAL_VRT_ENABLE_PYTHON"] == network["GDAL_VRT_ENABLE_PYTHON"] == "NO"
    assert os.environ["http_proxy"] == "http://mine"
    assert "GDAL_VRT_ENABLE_PYTHON" not in environment(Access(code=True, network=True))


@pytest.mark.parametrize("arguments", [["--validate"], []])
def test_a_server_hears_nothing_even_of_what_the_text_does_not_show(
    arguments, hears, pdal, town_files, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    url, came = hears
    shutil.copy(town_files[1], "target.laz")
    monkeypatch.setattr("mtpcr_geo.pipeline.reach._named_by", lambda path, seen: None)
    Path("a.vrt").write_text(VRT.format(url=f"/vsicurl/{url}/a.tif"))
    Path("wms.xml").write_text(WMS.format(url=url + "/${z}/${x}/${y}"))
    for file in ("a.vrt", "wms.xml"):
        for kind in ("dem", "hag_dem", "colorization"):
            stage = {"type": f"filters.{kind}", "raster": file}
            stage |= {"limits": "Z[0:1]"} if kind == "dem" else {}
            Path("p.json").write_text(json.dumps([READER, stage]))
            result = CliRunner().invoke(app, ["pipeline", "p.json", *arguments])
            assert result.exception is None or isinstance(result.exception, SystemExit)
            assert came == [], (file, kind)


@pytest.mark.parametrize(("code", "network"), [(False, True), (False, False)])
def test_the_server_is_asked_only_where_the_network_is_allowed(
    code, network, hears, pdal, town_files, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("mtpcr_geo.pipeline.reach.check", lambda spec: None)
    url, came = hears
    Path("a.vrt").write_text(VRT.format(url=f"/vsicurl/{url}/a.tif"))
    colour = {"type": "filters.colorization", "raster": "a.vrt"}
    pipeline = mtpcr_geo.Pipeline([str(town_files[1]), colour], allow_code=code, allow_network=network)
    with pytest.raises(MtpcrError, match="PDAL says"):
        pipeline.execute()
    assert bool(came) == network
