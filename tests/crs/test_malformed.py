"""CRSs that PROJ reads and cannot work with, or cannot read: each is an error of ours, wherever it stands."""

from __future__ import annotations

import json
import re
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_fuzz import write_still
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import CrsError, InputError, MtpcrError
from mtpcr_geo.crs import facts_of, parse_crs, resolve_frames
from mtpcr_geo.export.transform import read_transform
from mtpcr_geo.io.las import open_cloud

UTM = CRS.from_epsg(25833)
PLACE = np.array([[400_000.0, 5_800_000.0, 30.0], [400_100.0, 5_800_100.0, 40.0]])
WKT1, WKT2 = UTM.to_wkt("WKT1_GDAL"), UTM.to_wkt("WKT2_2019")
PROJJSON = UTM.to_json()
GEOGRAPHIC = CRS.from_epsg(4326).to_wkt("WKT1_GDAL")
POLAR = CRS.from_epsg(3031).to_wkt("WKT1_GDAL")
FEET = CRS.from_epsg(2236).to_wkt("WKT1_GDAL")


def put(text: str, name: str, value: str) -> str:
    """Replace the number behind a name."""
    found = re.search(rf'"{name}"[,:]\s*(?:"value":)?\s*(-?[\d.]+)', text)
    assert found is not None, name
    return text[: found.start(1)] + value + text[found.end(1) :]


NUMBERS = ("1000", "-1e300", "nan", "inf", "1e999", "0", "x", "")
MALFORMED: dict[str, str] = {
    **{f"latitude {n}": put(WKT1, "latitude_of_origin", n) for n in NUMBERS},
    **{f"latitude in feet {n}": put(FEET, "latitude_of_origin", n) for n in NUMBERS},
    **{f"scale {n}": put(WKT1, "scale_factor", n) for n in NUMBERS},
    **{f"easting {n}": put(WKT1, "false_easting", n) for n in NUMBERS},
    **{f"unit {n}": put(WKT1, "metre", n) for n in NUMBERS},
    **{f"foot {n}": put(FEET, "US survey foot", n) for n in NUMBERS},
    **{f"degree {n}": put(GEOGRAPHIC, "degree", n) for n in NUMBERS},
    **{f"axis of the ellipsoid {n}": put(WKT1, "GRS 1980", n) for n in NUMBERS},
    **{f"latitude of WKT 2 {n}": put(WKT2, "Latitude of natural origin", n) for n in NUMBERS},
    "no name of a parameter": POLAR.replace('PARAMETER["latitude_of', 'Antarctic["latitude_of'),
    "no projection": WKT1.replace("PROJECTION", "OBJECTION"),
    "no datum": WKT1.replace("DATUM", "MATUM"),
    "ends too soon": WKT1[:200],
    "ends much too soon": WKT1[:7],
    "one bracket too few": WKT1[:-1],
    "JSON that is no CRS": '{"type": "ProjectedCRS"}',
    "JSON in a list": "[1, 2]",
    "JSON with a latitude of 1000": PROJJSON.replace('"value":0', '"value":1000'),
    "a text that is none": '"\ud800"',
    "a name that is none": WKT1.replace("ETRS89", "\ud800"),
    "NUL": WKT1.replace("ETRS89", "\0"),
    "nothing": "",
    "a PROJ string of nonsense": "+proj=utm +zone=99",
    "a pipeline": "+proj=pipeline +step +proj=utm +zone=33",
    "a number": "25833",
    "a huge number": "EPSG:" + "9" * 400,
    "a vertical system": CRS.from_epsg(7837).to_wkt(),
    "brackets": "[" * 5000,
}  # fmt: skip
# the fast suite takes some of each kind
MORE = {"-1e300", "inf", "1e999", "x", ""}
ALL = [
    pytest.param(name, marks=[pytest.mark.slow] if name.rpartition(" ")[2] in MORE else [])
    for name in MALFORMED
]
BYTES = [one for one in ALL if "\ud800" not in MALFORMED[str(one.values[0])]]


@pytest.mark.parametrize("name", ALL)
def test_the_text_of_a_crs(name):
    """Each is refused, or taken for what it says; nothing else comes of it, and no warning."""
    utm = ArrayCloud(PLACE, UTM, "utm")
    other = ArrayCloud(PLACE, None, "other")
    for options in ({"source_crs": MALFORMED[name]}, {"out_crs": MALFORMED[name], "source_crs": UTM}):
        try:
            _, _, source = resolve_frames(utm, other, vertical="assume-same", **options)
            assert np.isfinite(source.to_work(PLACE)).all()
        except MtpcrError as error:
            assert isinstance(error, CrsError), error  # noqa: PT017
            assert len(str(error)) < 1000  # noqa: PT017


@pytest.mark.parametrize("name", ["latitude 1000", "foot nan", "foot 0", "no name of a parameter"])
def test_what_cannot_be_worked_with_is_refused(name):
    utm, other = ArrayCloud(PLACE, UTM, "utm"), ArrayCloud(PLACE, None, "other")
    with pytest.raises(CrsError):
        resolve_frames(utm, other, source_crs=MALFORMED[name])


def test_an_older_way_to_write_a_code_is_taken_without_a_warning():
    crs = parse_crs("+init=epsg:25833")
    assert crs is not None
    assert crs.to_epsg() in (25833, None)


def write_with(path: Path, wkt: str) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(PLACE[0])
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = PLACE.T
    las.write(path)
    return path


@pytest.mark.parametrize("name", BYTES)
def test_the_record_of_a_cloud(name, tmp_path):
    cloud = open_cloud(write_with(tmp_path / "a.las", MALFORMED[name]))
    try:
        facts_of(cloud.crs)
    except CrsError:
        return
    assert cloud.crs is not None or cloud.crs_problem or not MALFORMED[name]


@pytest.mark.parametrize("name", ["latitude 1000", "scale nan", "foot 0", "ends too soon", "NUL"])
def test_the_verbs(name, tmp_path):
    path = write_with(tmp_path / "a.las", MALFORMED[name])
    good = write_with(tmp_path / "b.las", WKT1)
    for arguments in (
        ["check", path], ["check", path, good], ["check", good, "--source-crs", MALFORMED[name]],
        ["register", path, good, "-o", tmp_path / "o"],
        ["register", good, good, "-o", tmp_path / "o", "--source-crs", MALFORMED[name]],
    ):  # fmt: skip
        result = CliRunner().invoke(app, [str(one) for one in arguments])
        assert result.exception is None or isinstance(result.exception, SystemExit)
        assert result.exit_code in {0, 2, 4, 5, 6}, result.output


@pytest.mark.parametrize("name", ALL)
def test_the_crs_of_a_transform(name, tmp_path):
    path = tmp_path / "t.json"
    write_still(path)
    document = json.loads(path.read_text())
    for side in ("source", "target"):
        document["chain"][side]["crs"] = {"name": "x", "authority": None, "wkt": MALFORMED[name]}
    path.write_text(json.dumps(document))
    try:
        read_transform(path)
    except MtpcrError as error:
        assert isinstance(error, (InputError, CrsError))  # noqa: PT017
