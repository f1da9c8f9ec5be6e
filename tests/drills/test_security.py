"""Pipelines of somebody who means harm: a library that must never run, a server that must hear nothing.

Every case is tried while only validated, too. What each switch is there for works with it.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from helpers_security import OGR_VRT, VRT, WMS, build_library, write_ept
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.pipeline.pdal import process
from mtpcr_geo.pipeline.pdal.allowed import ALLOWED

CLOUD = {"type": "readers.las", "filename": "target.laz"}
BOTH = pytest.mark.parametrize("how", ["validate", "run"])


def pipeline(stages: Any, how: str, *more: str) -> tuple[int, str]:
    """Run or validate a pipeline in the current folder; return the exit code, and what is said."""
    Path("p.json").write_text(json.dumps(stages))
    arguments = ["pipeline", "p.json", *more, *(["--validate"] if how == "validate" else [])]
    result = CliRunner().invoke(app, arguments)
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    return result.exit_code, result.stderr


@pytest.fixture
def place(pdal, town_files, tmp_path, monkeypatch) -> Path:
    """A folder with a cloud in it, which is the current one."""
    shutil.copy(town_files[1], tmp_path / "target.laz")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PDAL_DRIVER_PATH", raising=False)
    return tmp_path


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> tuple[Path, Path]:
    """A shared library, and the file that its constructor makes."""
    folder = tmp_path_factory.mktemp("library")
    mark = folder / "ran"
    # by this name PDAL would take it for a plugin, in any folder where it looks for them
    return build_library(folder / "libpdal_plugin_filter_evil.so", mark), mark


def code_cases(library: str) -> dict[str, Any]:
    """Return stages that would load a library or run a command, beside a reader."""
    touch = "touch ran-by-command"
    return {
        **{f"plugin of {kind}": {"type": kind, "plugin": library, "filename": "o.txt"} for kind in (
            "writers.text", "writers.gdal", "writers.null", "writers.ogr", "writers.las", "writers.raster")},
        **{f"plugin of {kind}": {"type": kind, "plugin": library} for kind in (
            "filters.info", "filters.merge", "filters.delaunay", "filters.range", "mtpcr.bev")},
        "plugin of a reader": {"type": "readers.las", "filename": "target.laz", "plugin": library},
        "plugin of a guessed reader": {"filename": "target.laz", "plugin": library},
        "plugin of another PDAL's stage": {"type": "filters.h3", "resolution": 3, "plugin": library},
        "a stage of its name": {"type": "filters.evil"},
        "a command": {"type": "filters.shell", "command": touch},
        "Python": {"type": "filters.python", "source": f"import os; os.system('{touch}')", "function": "f",
                   "module": "m"},
        "a reader by a script": {"type": "readers.numpy", "filename": "a.py", "function": "load"},
        "Julia": {"type": "filters.julia", "source": f"run(`{touch}`)", "module": "m", "function": "f"},
        "MATLAB": {"type": "filters.matlab", "source": f"system('{touch}')", "struct": "a"},
        "options in a file": {"type": "filters.info", "option_file": "options.json"},
        "arguments for other readers": {
            "type": "readers.stac", "filename": "a.json",
            "reader_args": [{"type": "readers.las", "plugin": library}],
        },
    }  # fmt: skip


CODE = sorted(code_cases(""))


@BOTH
@pytest.mark.parametrize("name", CODE)
def test_no_code_of_a_pipeline_runs(name, how, place, library):
    path, mark = library
    shutil.copy(path, place)
    Path("options.json").write_text(json.dumps({"plugin": str(path)}))
    Path("a.py").write_text("open('ran-by-command', 'w')\n")
    stage = code_cases(str(path))[name]
    stages = [stage] if "reader" in name and "stac" not in str(stage) else [CLOUD, stage]
    # the network is no matter here
    code, said = pipeline(stages, how, "--allow-network")
    assert code == OptionError.exit_code, said
    assert not mark.exists()
    assert not Path("ran-by-command").exists()


@BOTH
@pytest.mark.parametrize("override", ["--filters.info.plugin={}", "--one.plugin={}"])
def test_no_library_by_an_override_of_a_pipeline(override, how, place, library):
    path, mark = library
    code, said = pipeline([CLOUD, {"type": "filters.info", "tag": "one"}], how, override.format(path))
    assert code == OptionError.exit_code
    assert "no option 'plugin'" in said
    assert not mark.exists()


def test_no_stage_at_all_takes_a_library():
    """Whatever stage is allowed: none takes the option that loads one, however it is spelt."""
    assert len(ALLOWED) > 100
    assert not any("plugin" in option.lower() for options in ALLOWED.values() for option in options)


@BOTH
def test_no_library_beside_a_pipeline_runs(how, place, library):
    """PDAL by itself loads every plugin of the current folder as soon as it is asked for its stages."""
    path, mark = library
    shutil.copy(path, place)
    process.end_waiting()
    assert pipeline([CLOUD, {"type": "filters.range", "limits": "Z[0:1000]"}], how)[0] == 0
    process.end_waiting()
    assert not mark.exists()


@BOTH
def test_no_library_by_a_query(how, place, library):
    path, mark = library
    with sqlite3.connect("shapes.sqlite") as base:
        base.execute("create table t (c integer)")
    base.close()
    query = f"select load_extension('{path}')"
    stage = {"type": "filters.overlay", "dimension": "Classification", "datasource": "shapes.sqlite"}
    pipeline([CLOUD, {**stage, "query": query, "column": "c"}], how)
    assert not mark.exists()


@BOTH
def test_no_python_within_a_raster_runs(how, place):
    """GDAL runs the Python of a derived band where its configuration lets it."""
    code = "def f(*args, **named):\n    open('ran', 'w')"
    Path("a.vrt").write_text(
        "<VRTDataset rasterXSize='9' rasterYSize='9'><GeoTransform>0,1,0,9,0,-1</GeoTransform>"
        "<VRTRasterBand dataType='Byte' band='1' subClass='VRTDerivedRasterBand'>"
        f"<PixelFunctionLanguage>Python</PixelFunctionLanguage><PixelFunctionType>f</PixelFunctionType>"
        f"<PixelFunctionCode><![CDATA[{code}]]></PixelFunctionCode></VRTRasterBand></VRTDataset>"
    )
    pipeline([{"type": "readers.gdal", "filename": "a.vrt"}], how)
    pipeline([CLOUD, {"type": "filters.hag_dem", "raster": "a.vrt"}], how)
    assert not Path("ran").exists()


@pytest.mark.skipif(os.name == "nt", reason="needs a shell")
def test_a_command_runs_where_code_is_allowed(place):
    stages = [CLOUD, {"type": "filters.shell", "command": "touch ran-by-command"}]
    assert pipeline(stages, "validate", "--allow-code")[0] == 0
    assert not Path("ran-by-command").exists()
    assert pipeline(stages, "run", "--allow-code")[0] == 0
    assert Path("ran-by-command").exists()


def test_a_library_runs_where_code_is_allowed(place, library, tmp_path):
    """The drill's library does run where it may: what the other tests miss is not there by accident."""
    mark = tmp_path / "mine"
    path = build_library(tmp_path / "libpdal_plugin_filter_mine.so", mark)
    process.end_waiting()
    stages = [CLOUD, {"type": "filters.info", "plugin": str(path)}]
    code, said = pipeline(stages, "run", "--allow-code")
    process.end_waiting()
    assert mark.exists(), said
    assert code in (0, InputError.exit_code, OptionError.exit_code), "no plugin after all is an error"


GEOJSON = {"drivers": ["GeoJSON"], "datasource": "{url}/a.geojson"}
# stages that would reach beyond this machine; those with a file take what it holds
FILES = {
    "a.vrt": VRT.format(url="/vsicurl/{url}/a.tif"),
    "deep.vrt": VRT.format(url="a.vrt"),
    "wms.xml": WMS,
    "dem.tif": WMS,
    "shapes.vrt": OGR_VRT.format(url="{url}/a.geojson"),
    "database.vrt": OGR_VRT.format(url="PG:host={host} port={port}"),
    "service.json": '{{"href": "{url}/tiles"}}',
}
OVERLAY = {"type": "filters.overlay", "dimension": "Classification", "column": "c"}
DEM = {"type": "filters.dem", "limits": "Z[0:1]"}
REACHING: dict[str, Any] = {
    **{f"{kind}, {file}": {"type": kind, option: file}
       for kind, option in (("readers.gdal", "filename"), ("filters.colorization", "raster"),
                            ("filters.hag_dem", "raster"))
       for file in ("a.vrt", "deep.vrt", "wms.xml", "dem.tif", "/vsicurl/{url}/a.tif", "{url}/a.tif")},
    **{f"filters.dem, {file}": {**DEM, "raster": file} for file in ("a.vrt", "wms.xml", "{url}/a.tif")},
    **{f"filters.overlay, {file}": {**OVERLAY, "datasource": file} for file in (
        "a.vrt", "wms.xml", "shapes.vrt", "database.vrt", "service.json", "{url}/a.geojson",
        "/vsicurl/{url}/a.geojson", "PG:host={host} port={port}", "WFS:{url}")},
    "readers.ept, ogr": {"type": "readers.ept", "filename": "ept/ept.json", "ogr": GEOJSON},
    "readers.ept, ogr in a string": {
        "type": "readers.ept", "filename": "ept/ept.json", "ogr": json.dumps(GEOJSON)},
    "readers.ept, ogr twice in a string": {
        "type": "readers.ept", "filename": "ept/ept.json", "ogr": json.dumps(json.dumps(GEOJSON))},
    "readers.ept, addons": {"type": "readers.ept", "filename": "ept/ept.json", "addons": {"R": "{url}/a"}},
    "readers.ept, addons in a string": {
        "type": "readers.ept", "filename": "ept/ept.json", "addons": json.dumps({"R": "{url}/a"})},
    "readers.ept, a file of ogr": {"type": "readers.ept", "filename": "ept/ept.json",
                                   "ogr": {"datasource": "shapes.vrt"}},
    "readers.ept": {"type": "readers.ept", "filename": "{url}/ept.json"},
    "readers.ept by prefix": {"type": "readers.ept", "filename": "ept://{url}"},
    "readers.las": {"type": "readers.las", "filename": "{url}/a.laz"},
    "readers.text": {"type": "readers.text", "filename": "{url}/a.txt"},
    "a bare name": "{url}/a.laz",
    "filters.crop": {"type": "filters.crop", "ogr": GEOJSON},
    "filters.crop in a string": {"type": "filters.crop", "ogr": json.dumps(GEOJSON)},
    "filters.colorinterp": {"type": "filters.colorinterp", "ramp": "/vsicurl/{url}/a.png"},
    "a CRS": {"type": "filters.reprojection", "out_srs": "{url}/crs/4326"},
    "a grid": {"type": "filters.projpipeline", "coord_op": "+proj=vgridshift +grids={url}/g.tif"},
    "writers.las": {"type": "writers.las", "filename": "{url}/o.laz"},
    "writers.gdal": {"type": "writers.gdal", "filename": "/vsis3/bucket/o.tif", "resolution": 1},
    "an index of tiles": {"type": "readers.tindex", "filename": "{url}/index.geojson"},
}  # fmt: skip


def filled(value: Any, url: str) -> Any:
    """Put an address into every text of an option."""
    host, port = url.removeprefix("http://").split(":")
    if isinstance(value, dict):
        return {key: filled(one, url) for key, one in value.items()}
    if isinstance(value, str):
        return value.replace("{url}", url).replace("{host}", host).replace("{port}", port)
    return value


def write_files(url: str) -> None:
    for name, text in FILES.items():
        Path(name).write_text(filled(text.replace("{{", "{").replace("}}", "}"), url))
    write_ept(Path("ept"))


def stages_of(name: str, url: str) -> list[Any]:
    stage = filled(REACHING[name], url)
    reads = isinstance(stage, str) or stage["type"].startswith("readers.")
    return [stage] if reads else [CLOUD, stage]


@BOTH
@pytest.mark.parametrize("name", REACHING)
def test_nothing_reaches_beyond_this_machine(name, how, hears, place):
    url, came = hears
    write_files(url)
    code, said = pipeline(stages_of(name, url), how)
    assert code == OptionError.exit_code, said
    assert "--allow-network" in said
    assert came == []


# what the text and the files do not show, or what is let through for the sake of the drill
BEHIND = [
    "readers.gdal, a.vrt", "readers.gdal, wms.xml", "filters.colorization, {url}/a.tif",
    "filters.hag_dem, /vsicurl/{url}/a.tif", "filters.overlay, shapes.vrt", "filters.overlay, database.vrt",
    "filters.overlay, {url}/a.geojson", "filters.overlay, WFS:{url}", "a CRS", "a grid",
]  # fmt: skip


@BOTH
@pytest.mark.parametrize("name", BEHIND)
def test_the_libraries_own_switches_hold_by_themselves(name, how, hears, place, monkeypatch):
    url, came = hears
    write_files(url)
    monkeypatch.setattr("mtpcr_geo.pipeline.reach.check", lambda spec: None)
    pipeline(stages_of(name, url), how)
    assert came == []


@BOTH
def test_sidecar_files_reach_nothing(how, hears, place):
    """GDAL looks for overviews and masks where the file beside a raster says they are."""
    import numpy as np
    import rasterio

    url, came = hears
    with rasterio.open("dem.tif", "w", driver="GTiff", width=8, height=8, count=1, dtype="float32",
                       transform=rasterio.Affine(1, 0, 0, 0, -1, 8)) as raster:  # fmt: skip
        raster.write(np.zeros((1, 8, 8), np.float32))
    Path("dem.tif.aux.xml").write_text(
        f"<PAMDataset><Metadata domain='OVERVIEWS'><MDI key='OVERVIEW_FILE'>/vsicurl/{url}/a.ovr</MDI>"
        f"</Metadata></PAMDataset>"
    )
    for sidecar in ("dem.tif.ovr", "dem.tif.msk"):
        Path(sidecar).write_text(VRT.format(url=f"/vsicurl/{url}/a.tif"))
    for stage in ({"type": "filters.hag_dem", "raster": "dem.tif"},
                  {"type": "filters.colorization", "raster": "dem.tif"}):  # fmt: skip
        pipeline([CLOUD, stage], how)
    pipeline([{"type": "readers.gdal", "filename": "dem.tif"}], how)
    assert came == []


@pytest.mark.parametrize(
    "name", ["filters.colorization, a.vrt", "readers.las", "filters.overlay, {url}/a.geojson"]
)
def test_the_network_is_there_where_it_is_allowed(name, hears, place):
    url, came = hears
    write_files(url)
    code, said = pipeline(stages_of(name, url), "run", "--allow-network")
    assert code == InputError.exit_code, said
    assert came
