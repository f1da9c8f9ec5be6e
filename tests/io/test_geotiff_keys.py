"""GeoTIFF keys as they are met: padded, unsorted, contradictory, with vertical codes of every kind."""

from __future__ import annotations

import struct

import pytest
from helpers_las import geokeys, write_raw

from mtpcr_geo.crs import facts_of
from mtpcr_geo.io.geotiff_keys import crs_of_geokeys
from mtpcr_geo.io.las import open_cloud

UTM = ((1024, 1), (1025, 1), (3072, 26910))
NAVD88 = "North American Vertical Datum 1988"


def read(*entries: tuple[int, int], head: int | None = None):
    return crs_of_geokeys(geokeys(*entries, head=head)[2], b"", b"")


PLAN = {
    "as it should be": UTM,
    "padded with zeros": (*UTM, *[(0, 0)] * 4),
    "zeros before": ((0, 0), (0, 0), *UTM),
    "unsorted": UTM[::-1],
    "no model": UTM[1:],
    "model zero": ((1024, 0), *UTM[1:]),
    "model of another kind": ((1024, 2), *UTM[1:]),
    "a key twice, the last counts": ((3072, 32633), *UTM),
}


@pytest.mark.parametrize("name", PLAN)
def test_the_horizontal_system_is_read(name):
    crs, problem = read(*PLAN[name])
    assert crs is not None
    assert crs.to_epsg() == 26910
    assert problem == ""


def test_the_count_in_the_head_of_the_directory_is_a_hint(tmp_path):
    for head in (0, 2, 9, 60_000):
        crs, _ = read(*UTM, head=head)
        assert crs is not None
        assert crs.to_epsg() == 26910
    record = geokeys(*UTM)
    cut = (record[0], record[1], record[2] + b"\1\2\3", record[3])
    cloud = open_cloud(write_raw(tmp_path / "in.las", point_format=1, minor=2, records=[cut], encoding=0))
    assert cloud.crs is not None
    assert cloud.crs.to_epsg() == 26910


def test_geographic_without_a_model():
    crs, _ = read((2048, 4326))
    assert crs is not None
    assert crs.to_epsg() == 4326


NOTHING = {
    "units": ((1024, 1), (1025, 1), (3076, 9001), (4099, 9001)),
    "a model": ((1024, 1), (1025, 1)),
    "a user-defined system of nothing": ((1024, 1), (3072, 32767), (3076, 9001)),
    "a code that is none": ((1024, 1), (3072, 999), (3076, 9001)),
    "vertical only": ((1024, 1), (4096, 5703), (4099, 9001)),
}


@pytest.mark.parametrize("name", NOTHING)
def test_keys_that_name_no_system_give_none(name, tmp_path):
    record = geokeys(*NOTHING[name])
    cloud = open_cloud(write_raw(tmp_path / "in.las", point_format=1, minor=2, records=[record], encoding=0))
    assert cloud.crs is None
    assert "name no coordinate reference system" in cloud.crs_problem


def test_a_citation_alone_is_no_system():
    text = b"Local site grid|\0"
    entries = [(1024, 0, 1, 1), (1026, 34737, 16, 0), (3073, 34737, 16, 0), (3076, 0, 1, 9001)]
    directory = b"".join(struct.pack("<4H", *entry) for entry in [(1, 1, 0, len(entries)), *entries])
    assert crs_of_geokeys(directory, b"", text) == (None, "")


@pytest.mark.parametrize(
    "keys",
    [
        ((1024, 1), (3072, 32767), (3074, 16010), (3076, 9001)),
        ((1024, 2),),
        ((1024, 3),),
        ((1024, 2), (2048, 26910)),
    ],
)
def test_no_datum_is_made_up(keys):
    with pytest.raises(ValueError, match="no geodetic datum"):
        read(*keys)


HEIGHTS = {
    "a system": ([(4096, 5703), (4099, 9001)], NAVD88, 1.0, False),
    "a system in feet": ([(4096, 6360), (4099, 9003)], NAVD88, 1200 / 3937, False),
    "system and datum exchanged": ([(4096, 5103), (4098, 5703), (4099, 9001)], NAVD88, 1.0, False),
    "the system under the datum's key": ([(4098, 5703)], NAVD88, 1.0, False),
    "a datum": ([(4098, 5103)], NAVD88, 1.0, False),
    "a datum under the system's key": ([(4096, 5103), (4099, 9003)], NAVD88, 1200 / 3937, False),
    "contradiction": ([(4096, 1234), (4098, 5703)], None, 1.0, True),
    "other codes exchanged": (
        [(4096, 5102), (4098, 5703)],
        "National Geodetic Vertical Datum 1929",
        1.0,
        False,
    ),
    "a horizontal code": ([(4096, 26910), (4099, 9003)], None, 1200 / 3937, True),
    "a code that is none": ([(4096, 9999)], None, 1.0, True),
    "a unit alone": ([(4099, 9001)], None, 1.0, False),
    "another unit alone": ([(4099, 9002)], None, 0.3048, False),
    "user-defined": ([(4096, 32767), (4098, 32767), (4099, 9001)], None, 1.0, False),
    "nothing": ([], None, 1.0, False),
}


@pytest.mark.parametrize("name", HEIGHTS)
def test_heights(name):
    keys, datum, unit, said = HEIGHTS[name]
    crs, problem = read(*UTM, *keys)
    facts = facts_of(crs)
    assert facts.horizontal is not None
    assert facts.horizontal.to_epsg() == 26910
    assert facts.height_unit == pytest.approx(unit)
    assert bool(problem) == said
    if datum is None:
        assert facts.height == "unsaid"
        assert facts.vertical is None
    else:
        assert facts.vertical is not None
        assert facts.vertical.datum is not None
        assert facts.vertical.datum.name.startswith(datum)


STATED_UNITS = {
    "US survey feet": ([(4096, 5703), (4099, 9003)], 6360, 1200 / 3937),
    "feet": ([(4096, 5703), (4099, 9002)], 8228, 0.3048),
    "US survey feet, under the datum's key": ([(4098, 5703), (4099, 9003)], 6360, 1200 / 3937),
    "metres of a system in feet": ([(4096, 6360), (4099, 9001)], 5703, 1.0),
    "a unit that EPSG has not with this datum": ([(4096, 5783), (4099, 9003)], None, 1200 / 3937),
    "its own": ([(4096, 5703), (4099, 9001)], 5703, 1.0),
    "none": ([(4096, 5703)], 5703, 1.0),
}


@pytest.mark.parametrize("name", STATED_UNITS)
def test_heights_are_in_the_unit_that_is_stated_beside_the_code_of_a_system(name):
    keys, code, unit = STATED_UNITS[name]
    crs, problem = read((1024, 1), (3072, 2263), (3076, 9003), *keys)
    facts = facts_of(crs)
    assert facts.height_unit == pytest.approx(unit, rel=1e-9)
    assert facts.unit == pytest.approx(1200 / 3937)
    assert facts.height == "datum"
    assert facts.vertical is not None
    assert facts.vertical.to_epsg() == code
    stated = dict(keys)
    differs = name not in ("its own", "none")
    assert bool(problem) == differs
    if differs:
        assert str(stated.get(4096, stated.get(4098))) in problem
        assert "which is taken" in problem


def test_ellipsoidal_heights_of_the_own_ellipsoid():
    crs, problem = read(*UTM, (4096, 5019))
    assert facts_of(crs).height == "ellipsoidal"
    assert problem == ""
    crs, problem = read(*UTM, (4096, 5030))  # WGS 84's, under NAD83
    assert facts_of(crs).height == "unsaid"
    assert "ellipsoid" in problem


def test_what_cannot_be_used_of_a_crs_is_said(tmp_path):
    from mtpcr_geo.check import check_clouds

    record = geokeys(*UTM, (4096, 9999))
    path = write_raw(tmp_path / "in.las", point_format=1, minor=2, records=[record], encoding=0)
    found = {finding.code: finding for finding in check_clouds(path).findings}
    assert "9999" in found["crs-partly"].what
    assert "crs-missing" not in found


def test_a_unit_is_no_datum(tmp_path):
    from mtpcr_geo.check import check_clouds

    files = []
    for name, keys in (("source", [(4099, 9001)]), ("target", [(4096, 5703), (4099, 9001)])):
        record = geokeys(*UTM, *keys)
        path = tmp_path / f"{name}.las"
        count = 300 if name == "source" else 301
        files.append(write_raw(path, point_format=1, minor=2, records=[record], encoding=0, count=count))
    report = check_clouds(*files)
    assert report.exit_code == 6
    assert any('vertical="assume-same"' in finding.fix for finding in report.findings)
    assert check_clouds(*files, vertical="assume-same").exit_code == 0
