"""The preflight: every finding by a small file made to have it, and the exit code that register has too."""

import io
import json
import struct
from functools import partial
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS
from rich.console import Console
from typer.testing import CliRunner

from mtpcr_geo.check import check_clouds
from mtpcr_geo.check.pair import in_feet, relate
from mtpcr_geo.check.place import code_of, within_area
from mtpcr_geo.check.points import Measured, height_findings, plan_findings
from mtpcr_geo.check.show import json_of, print_report
from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.crs import facts_of
from mtpcr_geo.io.sample import scan

UTM = CRS.from_epsg(25832)
PLACE = np.array([440_000.0, 5_400_000.0, 120.0])
KEYS = {"EPSG:25832": struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 25832)}


def hills(seed, n=20_000, place=PLACE, size=(200.0, 160.0)):
    """Ground with relief, and a few boxes on it, at random points of its own."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 1, (n, 2)) * size
    z = 6.0 * np.sin(xy[:, 0] / 40.0) + 4.0 * np.cos(xy[:, 1] / 30.0)
    z += np.where((np.mod(xy[:, 0], 50.0) < 12.0) & (np.mod(xy[:, 1], 40.0) < 10.0), 8.0, 0.0)
    return np.column_stack([xy, z]) + place


def write(
    path, xyz, crs=UTM, *, point_format=6, scale=0.001, offset=None, records=(), bit=None, **dimensions
):
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales = np.broadcast_to(scale, 3)
    header.offsets = np.floor(xyz.min(axis=0)) if offset is None else offset
    if crs is not None:
        wkt = crs if isinstance(crs, str) else crs.to_wkt()
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
    header.vlrs.extend(records)
    header.global_encoding.wkt = crs is not None if bit is None else bit
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.return_number[:] = 1
    las.number_of_returns[:] = 1
    for name, values in dimensions.items():
        las[name] = values
    las.write(path)
    return path


def patched(path, place, layout, *values):
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, place, *values)
    path.write_bytes(data)
    return path


def codes(report, severity=None):
    return [found.code for found in report.findings if severity in (None, found.severity)]


def only(report, code):
    (found,) = [found for found in report.findings if found.code == code]
    return found


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    source = hills(1, place=PLACE)
    source = source[source[:, 0] < PLACE[0] + 150.0]
    return write(folder / "source.laz", source), write(folder / "target.laz", hills(2))


def test_of_sound_clouds_it_is_said_what_is_taken_of_their_heights_and_nothing_else(good):
    report = check_clouds(*good)
    assert [(one.code, one.severity) for one in report.findings] == [("vertical-taken", "note")]
    known = check_clouds(*good, source_crs="EPSG:25832+7837", target_crs="EPSG:25832+7837")
    assert "vertical-taken" not in {one.code for one in known.findings}
    assert report.goes_on
    relation = report.relation
    assert relation is not None
    assert relation.name == "overlapping"
    assert relation.source_share is not None
    assert relation.source_share > 0.95
    assert relation.target_share is not None
    assert 0.65 < relation.target_share < 0.85
    facts = report.clouds["target"]
    assert facts.crs_code == "EPSG:25832"
    assert facts.horizontal_unit == facts.vertical_unit == "metre"
    assert facts.points == 20_000
    assert facts.density_per_m2 == pytest.approx(20_000 / (200 * 160), rel=0.15)
    assert facts.extent_m is not None
    assert facts.extent_m[:2] == pytest.approx([200, 160], abs=0.1)
    assert list(report.clouds) == ["source", "target"]


def test_the_time_type_is_judged_by_times_from_all_over_the_file(tmp_path):
    times = np.full(20_000, 3e8)
    times[:12_000] = 1000.0
    standard = write(tmp_path / "standard.laz", hills(1), gps_time=times)
    assert "gps-time" not in codes(check_clouds(standard))
    week = patched(write(tmp_path / "week.laz", hills(1), gps_time=times), 6, "<H", 16)
    assert "300000000.0" in only(check_clouds(week), "gps-time").what


def test_one_cloud_alone(good, tmp_path):
    report = check_clouds(good[0])
    assert (report.exit_code, report.findings, report.relation) == (0, (), None)
    bare = write(tmp_path / "bare.las", hills(1), None)
    assert check_clouds(bare).exit_code == 6
    for words in ({"source_crs": "EPSG:25832"}, {"target_crs": "EPSG:25832"}, {"local": True}):
        assert check_clouds(bare, **words).goes_on
    with pytest.raises(OptionError, match="target_crs"):
        check_clouds(bare, source_crs="local", target_crs="local")


# what is wrong with a file, by the file: (how to make it, finding, severity)
def _keys_vlr():
    return laspy.VLR("LASF_Projection", 34735, "", KEYS["EPSG:25832"])


def _noise(share):
    classes = np.full(20_000, 2, np.uint8)
    classes[: int(20_000 * share)] = 7
    return classes


def _with_stray(offset):
    xyz = hills(1)
    xyz[:3] += offset
    return xyz


FILES = {
    "bit unset": (lambda p: write(p, hills(1), bit=False), "wkt-bit-unset", "warning"),
    "bit set without WKT": (
        lambda p: write(p, hills(1), None, point_format=3, records=[_keys_vlr()], bit=True),
        "wkt-bit-wrong",
        "warning",
    ),
    "keys with format 6": (
        lambda p: write(p, hills(1), None, records=[_keys_vlr()], bit=True), "wkt-missing", "warning",
    ),
    "two CRSs": (
        lambda p: write(p, hills(1), CRS.from_epsg(25833), records=[_keys_vlr()]), "crs-twice", "warning",
    ),
    "bad WKT": (lambda p: write(p, hills(1), "PROJCS[oops"), "crs-missing", "error"),
    "no CRS": (lambda p: write(p, hills(1), None), "crs-missing", "error"),
    "bounds too narrow": (
        lambda p: patched(write(p, hills(1)), 179, "<d", PLACE[0] + 100.0), "bounds-wrong", "warning",
    ),
    "bounds a little wide": (
        lambda p: patched(write(p, hills(1)), 179, "<d", PLACE[0] + 210.0), "bounds-wide", "note",
    ),
    "bounds very wide": (
        lambda p: patched(write(p, hills(1)), 179, "<d", PLACE[0] + 5000.0), "bounds-wide", "warning",
    ),
    "legacy count wrong": (lambda p: patched(write(p, hills(1)), 107, "<I", 17), "legacy-count", "warning"),
    "legacy count nought": (
        lambda p: patched(write(p, hills(1), point_format=3), 107, "<I", 0), "legacy-count", "note",
    ),
    "count too small": (
        lambda p: patched(write(p, hills(1)), 247, "<Q", 19_000), "count-mismatch", "warning",
    ),
    "returns do not add up": (lambda p: patched(write(p, hills(1)), 255, "<Q", 5), "return-counts", "note"),
    "coarse": (lambda p: write(p, hills(1), scale=0.1), "scale-coarse", "warning"),
    "coarse in degrees": (
        lambda p: write(
            p, hills(1, place=(8.0, 49.0, 100.0), size=(0.01, 0.01)), CRS.from_epsg(4326), scale=1e-5,
        ),
        "scale-coarse",
        "warning",
    ),
    "fine": (lambda p: write(p, hills(1), scale=0.00001), "scale-fine", "note"),
    "near overflow": (
        lambda p: write(p, hills(1), scale=0.0005, offset=[PLACE[0], PLACE[1] - 800_000.0, 0.0]),
        "scale-overflow",
        "warning",
    ),
    "far offset": (lambda p: write(p, hills(1), scale=0.006, offset=[0.0] * 3), "offset-far", "note"),
    "times of a week": (
        lambda p: patched(write(p, hills(1), gps_time=np.arange(20_000) + 1000.0), 6, "<H", 16),
        "gps-time",
        "note",
    ),
    "week bit, standard times": (
        lambda p: patched(write(p, hills(1), gps_time=np.arange(20_000) + 3e8), 6, "<H", 16),
        "gps-time",
        "note",
    ),
    "standard bit, week times": (
        lambda p: write(p, hills(1), gps_time=np.arange(20_000) + 1000.0), "gps-time", "note",
    ),
    "noise": (lambda p: write(p, hills(1), classification=_noise(0.1)), "noise", "note"),
    "much noise": (lambda p: write(p, hills(1), classification=_noise(0.5)), "noise", "warning"),
    "x and y exchanged": (lambda p: write(p, hills(1)[:, [1, 0, 2]]), "axes-swapped", "warning"),
    "elsewhere": (
        lambda p: write(p, hills(1, place=(440_000.0, 100_000.0, 120.0))), "outside-area", "warning",
    ),
    "in the next zone": (
        lambda p: write(p, hills(1, place=(-800.0, 5_422_000.0, 120.0)), CRS.from_epsg(25833)),
        "outside-area",
        "note",
    ),
    "degrees in a metric CRS": (
        lambda p: write(p, hills(1, place=(8.0, 49.0, 120.0), size=(0.01, 0.01)), scale=1e-7),
        "outside-area",
        "warning",
    ),
    "stray in height": (lambda p: write(p, _with_stray([0, 0, 900.0])), "stray", "note"),
    "stray in plan": (lambda p: write(p, _with_stray([0, 3000.0, 0])), "stray", "note"),
    "tall": (lambda p: write(p, hills(1) * [1, 1, 60.0] - [0, 0, 6500.0]), "z-range", "warning"),
    "off the earth": (lambda p: write(p, hills(1) + [0, 0, 30_000.0]), "z-level", "warning"),
    "level as a table": (lambda p: write(p, hills(1) * [1, 1, 0]), "z-constant", "warning"),
    "sparse": (lambda p: write(p, hills(1, 2000, size=(700.0, 700.0))), "sparse", "warning"),
    "small": (lambda p: write(p, hills(1, 5000, size=(6.0, 5.0))), "cells-few", "warning"),
    "rather small": (lambda p: write(p, hills(1, 5000, size=(11.0, 9.0))), "cells-few", "note"),
    "thin on a small place": (lambda p: write(p, hills(1, 500, size=(28.0, 26.0))), "cells-few", "warning"),
    "flat as a field": (lambda p: write(p, hills(1) * [1, 1, 1e-3] + [0, 0, 120.0]), "flat", "warning"),
    "no returns": (
        lambda p: write(p, np.vstack([hills(1), np.tile(hills(1)[:1], (1000, 1))])), "no-returns", "note",
    ),
    "feet": (
        lambda p: write(p, hills(1, place=(4.2e6, 1.3e6, 400.0)), CRS.from_epsg(2994)),
        "z-unit-unsaid",
        "note",
    ),
    "moving datum": (
        lambda p: write(
            p, hills(1, place=(8.0, 49.0, 100.0), size=(0.01, 0.01)), CRS.from_epsg(9000), scale=1e-7,
        ),
        "epoch-missing",
        "note",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_findings_of_one_file(name, tmp_path):
    make, code, severity = FILES[name]
    path = make(tmp_path / "a.las")
    report = check_clouds(path)
    assert code in codes(report, severity), report.findings
    assert report.goes_on == (not codes(report, "error"))
    # what is expected stands nearly alone: no file is drowned in what it does not have
    assert len(codes(report, "warning")) <= 2, report.findings
    found = next(found for found in report.findings if found.code == code)
    assert found.what
    assert found.role == "source"
    json.loads(json_of(report))


@pytest.mark.parametrize(
    "name",
    ["bit unset", "keys with format 6", "bounds too narrow", "bounds very wide", "legacy count wrong",
     "legacy count nought", "returns do not add up", "near overflow", "fine"],
)  # fmt: skip
def test_the_fix_mends_it(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make, code, _ = FILES[name]
    make(Path("a.las"))
    before = only(check_clouds("a.las"), code)
    text = before.fix.partition("echo '")[2].partition("'")[0]
    result = CliRunner().invoke(app, ["pipeline", "-", "--quiet"], input=text.encode())
    assert result.exit_code == 0, result.output
    after = check_clouds("new.laz")
    assert after.findings == ()
    assert after.clouds["source"].crs_code == "EPSG:25832"


def test_epoch_of_the_coordinates(tmp_path):
    xyz = hills(1, place=(8.0, 49.0, 100.0), size=(0.01, 0.01))
    wkt = f"COORDINATEMETADATA[{CRS.from_epsg(9000).to_wkt()},EPOCH[2021.3]]"
    report = check_clouds(write(tmp_path / "a.las", xyz, wkt, scale=1e-7), source_crs="EPSG:9000")
    assert report.clouds["source"].epoch == 2021.3
    assert report.clouds["source"].datum_epoch == 2010
    assert "epoch-missing" not in codes(report)


def test_what_the_user_says_stands_over_the_file(good, tmp_path):
    report = check_clouds(good[0], source_crs="EPSG:25833")
    assert "ETRS89 / UTM zone 32N" in only(report, "crs-overridden").what
    assert report.clouds["source"].crs_by == "option"
    assert codes(check_clouds(good[0], source_crs="EPSG:25832")) == []
    assert codes(check_clouds(good[0], local=True), "warning") == []
    odd = write(tmp_path / "odd.las", hills(1), "PROJCS[oops")
    assert "cannot be understood" in only(check_clouds(odd), "crs-missing").what
    assert only(check_clouds(odd, source_crs="EPSG:25832"), "crs-unreadable").severity == "note"


@pytest.fixture(scope="module")
def pairs(good, tmp_path_factory):
    """Pairs with something wrong between them, by what it is."""
    folder = tmp_path_factory.mktemp("pairs")
    target = good[1]
    xyz = hills(1)
    plain = UTM.to_wkt("WKT1_GDAL").replace('"EPSG","25832"', '"OTHER","1"')
    las = laspy.read(target)
    crop = np.asarray(las.xyz)[::2]
    made = {
        "apart": write(folder / "apart.laz", xyz + [2500.0, 0, 0]),
        "far": write(folder / "far.laz", xyz + [0, 1.5e6, 0]),
        "swapped": write(folder / "swapped.laz", xyz[:, [1, 0, 2]], plain),
        "ellipsoidal": write(folder / "ellipsoidal.laz", xyz + [0.5, -0.3, 48.2]),
        "higher": write(folder / "higher.laz", xyz + [0, 0, 3.0]),
        "feet": write(folder / "feet.laz", xyz / [1, 1, 0.3048]),
        "datum": write(folder / "datum.laz", xyz, CRS.from_user_input("EPSG:25832+7837")),
        "zone": write(folder / "zone.laz", xyz, CRS.from_epsg(32632)),
        "crop": write(folder / "crop.las", crop, scale=0.01),
        "copy": folder / "copy.las",
        "bytes": folder / "bytes.laz",
        "bare": write(folder / "bare.laz", xyz, None),
        "sliver": write(folder / "sliver.laz", xyz + [199.0, 110.0, 0]),
        "huge": write(folder / "huge.laz", _with_stray([0, 90_000.0, 0]) + [0, -90_000.0, 0]),
    }
    las.write(made["copy"])
    made["bytes"].write_bytes(target.read_bytes())
    return made | {"target": target, "source": good[0]}


PAIRS = {
    "apart": ("apart", "warning", 0),
    "far": ("crs", "error", 6),
    "ellipsoidal": ("z-offset", "warning", 0),
    "higher": ("z-offset", "note", 0),
    "feet": ("z-feet", "warning", 0),
    "datum": ("crs", "error", 6),
    "crop": ("same-points", "warning", 0),
    "copy": ("same-points", "warning", 0),
    "bytes": ("same-cloud", "error", 5),
    "target": ("same-cloud", "error", 5),
    "bare": ("crs-missing", "error", 6),
    "swapped": ("axes-swapped", "warning", 6),
    "sliver": ("little-overlap", "warning", 0),
    "huge": ("stray", "note", 0),
}


@pytest.mark.parametrize("name", PAIRS)
def test_findings_between_two_files(name, pairs):
    code, severity, exit_code = PAIRS[name]
    report = check_clouds(pairs[name], pairs["target"])
    assert code in codes(report, severity), report.findings
    assert report.exit_code == exit_code
    assert bool(codes(report, "error")) == (exit_code != 0)
    json.loads(json_of(report))


def test_how_they_lie_to_each_other(pairs):
    def relation(name, **words):
        return check_clouds(pairs[name], pairs["target"], **words).relation

    assert relation("apart").distance_m == pytest.approx(2300, abs=5)
    assert relation("far").name == "apart"
    assert relation("far").distance_m == pytest.approx(1.5e6, rel=0.01)
    assert relation("datum").name == "overlapping"  # their plan agrees though their heights do not
    assert relation("bare").name == "unknown"
    assert "not known" in relation("bare").why
    assert relation("source", source_crs="local").name == "unknown"
    assert "source has local" in relation("source", source_crs="local").why
    assert "both have local" in relation("source", local=True).why


def test_offset_says_who_is_higher_and_by_how_much(pairs):
    found = only(check_clouds(pairs["ellipsoidal"], pairs["target"]), "z-offset")
    assert "source is 48.2 m higher" in found.what
    assert only(check_clouds(pairs["feet"], pairs["target"]), "z-feet").role == "source"
    assert only(check_clouds(pairs["target"], pairs["feet"]), "z-feet").role == "target"


def test_swapped_axes_name_the_cloud(pairs):
    assert only(check_clouds(pairs["swapped"], pairs["target"]), "axes-swapped").role == "source"
    assert only(check_clouds(pairs["target"], pairs["swapped"]), "axes-swapped").role == "target"


def test_different_systems_name_the_operation(pairs):
    report = check_clouds(pairs["zone"], pairs["target"])
    assert report.goes_on
    assert "accuracy" in only(report, "crs-different").what
    taken = check_clouds(pairs["datum"], pairs["target"], vertical="assume-same")
    assert taken.goes_on
    assert "taken as equal" in only(taken, "vertical-taken").what


def test_large_clouds_are_judged_by_a_sample(pairs, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.check.preflight.scan", partial(scan, budget=3000))
    report = check_clouds(pairs["crop"], pairs["target"])
    assert codes(report, "warning") == ["same-points"]
    share = int(only(report, "same-points").what.split()[1].rstrip("%"))
    assert 70 <= share <= 100  # the crop was rounded to a coarser scale, where halves go either way
    assert report.relation is not None
    assert report.relation.source_share is not None
    assert report.relation.source_share > 0.9
    assert report.clouds["target"].maximum == check_clouds(pairs["target"]).clouds["source"].maximum
    assert codes(check_clouds(pairs["source"], pairs["target"]), "warning") == []


def test_both_without_a_system_are_both_named(pairs):
    report = check_clouds(pairs["bare"], write(pairs["bare"].parent / "bare2.laz", hills(3), None))
    assert [found.role for found in report.findings if found.code == "crs-missing"] == ["source", "target"]
    assert codes(report, "error") == ["crs-missing", "crs-missing"]


def broken(folder, good):
    """Files that register refuses, and one that is not there."""
    xyz = hills(1)
    made = {
        "missing": folder / "missing.laz",
        "folder": folder,
        "empty": write(folder / "empty.las", xyz[:2]),
        "one": write(folder / "one.laz", xyz[:1]),
        "few": write(folder / "few.laz", xyz[:50]),
        "noise": write(folder / "noise.laz", xyz, classification=np.full(len(xyz), 7)),
        "nan": patched(write(folder / "nan.las", xyz), 131, "<d", float("nan")),
        "cut": folder / "cut.laz",
        "text": folder / "text.laz",
        "nowhere": write(folder / "nowhere.laz", xyz, CRS.from_epsg(4326)),
        "south": write(folder / "south.laz", xyz, CRS.from_epsg(2048)),
        "bare_nan": patched(write(folder / "bare_nan.las", xyz, None), 131, "<d", float("nan")),
        "vast": write(folder / "vast.laz", hills(1, 20_000, size=(90_000.0, 90_000.0)), scale=0.01),
    }
    patched(made["empty"], 247, "<Q", 0)
    made["empty"].write_bytes(made["empty"].read_bytes()[: -2 * 30])  # its points
    made["cut"].write_bytes(good[0].read_bytes()[:5000])
    made["text"].write_text("X Y Z")
    return made


REFUSED = ["missing", "folder", "empty", "one", "few", "noise", "nan", "cut", "text", "nowhere",
           "south", "bare_nan", "vast"]  # fmt: skip


@pytest.mark.parametrize("name", [*REFUSED, "bare", "far", "datum", "bytes", "target", "swapped"])
@pytest.mark.parametrize("as_source", [True, False])
def test_the_exit_code_is_that_of_register(name, as_source, good, pairs, tmp_path):
    files = pairs | broken(tmp_path, good)
    two = (files[name], good[1]) if as_source else (good[1], files[name])
    words = [str(path) for path in two]
    runner = CliRunner()
    checked = runner.invoke(app, ["check", *words, "--json"])
    registered = runner.invoke(app, ["register", *words, "-o", str(tmp_path / "out"), "--no-recording"])
    assert checked.exit_code == registered.exit_code != 0, (checked.output, registered.output)
    whole = json.loads(checked.stdout)
    assert whole["exit_code"] == checked.exit_code
    assert not whole["goes_on"]
    errors = [found for found in whole["findings"] if found["severity"] == "error"]
    assert errors
    assert all(found["what"] for found in errors)


def test_the_command_prints_a_table(pairs):
    result = CliRunner().invoke(app, ["check", str(pairs["ellipsoidal"]), str(pairs["target"])])
    assert result.exit_code == 0
    for words in ("ETRS89", "EPSG:25832", "source", "target", "warning", "ellipsoidal", "overlap", "go on"):
        assert words in result.stdout
    assert result.stderr == ""
    refused = CliRunner().invoke(app, ["check", str(pairs["bare"])])
    assert refused.exit_code == 6
    assert "--source-crs" in refused.stdout
    quiet = CliRunner().invoke(app, ["check", str(pairs["bare"]), "--quiet"])
    assert (quiet.exit_code, quiet.output) == (6, "")


def test_names_with_brackets_are_printed_as_they_are(tmp_path):
    report = check_clouds(write(tmp_path / "a[bold].las", hills(1), None))
    text = io.StringIO()
    print_report(Console(width=400, file=text), report)
    assert "a[bold].las" in text.getvalue()


def test_codes_of_systems():
    assert code_of(CRS.from_user_input("EPSG:25832+7837")) == "EPSG:25832+7837"
    assert code_of(CRS.from_epsg(7415)) == "EPSG:7415"
    assert code_of(CRS.from_proj4("+proj=tmerc +lat_0=50 +lon_0=8 +datum=WGS84")) == ""
    assert code_of(None) == ""


def test_area_of_use_across_the_date_line():
    facts = facts_of(CRS.from_epsg(3832))  # Pacific, 98 degrees east to 68 degrees west
    here = np.array([[4_000_000.0, 0.0, 0.0], [4_000_100.0, 100.0, 10.0]])
    assert within_area(facts, here)
    assert within_area(facts_of(None), here) is None


def test_feet_need_level_and_relief():
    rng = np.random.default_rng(0)
    metres = 120.0 + rng.uniform(0, 20, 500)
    assert in_feet(metres / 0.3048, metres) == (pytest.approx(3.2808, rel=1e-3), "source")
    assert in_feet(metres, metres / 0.3048) == (pytest.approx(3.2808, rel=1e-3), "target")
    assert in_feet(metres, metres) is None
    assert in_feet(metres + 273.0, metres) is None  # only higher
    assert in_feet(120.0 + (metres - 120.0) * 3.28, metres) is None  # only rougher


def test_relation_of_clouds_that_interlock():
    square = np.random.default_rng(0).uniform(0, 100, (5000, 3))
    ring = square[(np.abs(square[:, :2] - 50) > 30).any(axis=1)]
    inner = square[(np.abs(square[:, :2] - 50) < 15).all(axis=1)]
    relation, _ = relate(inner, ring)
    assert relation.name == "apart"
    assert relation.distance_m == pytest.approx(15, abs=2)


def test_pure_findings_of_points():
    xyz = hills(1, 2000) - PLACE
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    flat = Measured(xyz, low, high, 120.0, 5.0, 1000.0)
    assert list(height_findings(flat, "metre", True, "source")) == []
    assert list(plan_findings(flat, "source")) == []
    missed = Measured(xyz, low, high + [4000.0, 0.0, 900.0], 120.0, 5.0, 1000.0)  # not in the sample
    assert [found.code for found in height_findings(missed, "metre", True, "source")] == ["z-stray"]
    assert [found.code for found in plan_findings(missed, "source")] == ["plan-stray"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("autzen_line_in_block", {}),
        ("coast_town_sparse_ign382", {}),
        ("delft_urban_ahn3", {"source_crs": "EPSG:28992", "target_crs": "EPSG:28992"}),
        ("park_two_epochs_ttp", {}),
        ("suburb_sparse_ign292", {}),
    ],
)
def test_real_pairs_are_sound(name, words, shared_data):
    folder = shared_data / name
    report = check_clouds(folder / "source.laz", folder / "target.laz", **words)
    assert report.goes_on
    assert codes(report, "error") == codes(report, "warning") == []
    assert report.relation is not None
    assert report.relation.name == "overlapping"


def test_a_plot_may_be_narrower_than_its_trees_are_high():
    rng = np.random.default_rng(3)
    trees = rng.uniform([0.0, 0.0, 0.0], [25.0, 25.0, 40.0], (20_000, 3))
    low, high = trees.min(axis=0), trees.max(axis=0)
    assert (
        list(height_findings(Measured(trees, low, high, 300.0, 30.0, 625.0), "metre", True, "source")) == []
    )
    tower = trees * [1, 1, 4.0]
    low, high = tower.min(axis=0), tower.max(axis=0)
    (found,) = height_findings(Measured(tower, low, high, 300.0, 30.0, 625.0), "metre", True, "source")
    assert found.code == "z-range"


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((-164.0, -60.0, 2.0), "look local"),
        ((1000.0, 5000.0, 2.0), "look local"),
        ((84_808.0, 447_412.0, 0.0), "look like a national grid or UTM"),
        ((440_000.0, 5_400_000.0, 0.0), "look like a national grid or UTM"),
        ((-73_000.0, 214_000.0, 0.0), "look like a national grid or UTM"),
    ],
)
def test_what_coordinates_without_a_crs_look_like(place, words, tmp_path):
    report = check_clouds(
        write(tmp_path / "a.las", hills(1, place=np.array(place), size=(228.0, 120.0)), None)
    )
    (found,) = [found for found in report.findings if found.code == "crs-missing"]
    assert words in found.what


def leaning(xyz, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    middle = xyz.mean(axis=0)
    return (xyz - middle) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + middle


def test_the_vertical_of_a_local_cloud_is_looked_for(tmp_path):
    flat = hills(1, 60_000, place=np.zeros(3)) * [1, 1, 0.05]
    tilted, upright = (
        write(tmp_path / "t.las", leaning(flat, 6.0), None),
        write(tmp_path / "u.las", flat, None),
    )
    report = check_clouds(tilted, upright, local=True)
    assert [found.role for found in report.findings if found.code == "leans"] == ["source"]
    (found,) = [found for found in report.findings if found.code == "leans"]
    assert "leans by 5.9 degrees" in found.what or "leans by 6.0 degrees" in found.what
    lumps = np.random.default_rng(5).uniform([0, 0, 0], [60, 60, 40], (30_000, 3))
    unknown = check_clouds(write(tmp_path / "l.las", lumps, None), source_crs="local")
    assert "vertical-unknown" in codes(unknown, "note")
    # a CRS tells the vertical
    stated = check_clouds(write(tmp_path / "s.las", leaning(flat, 6.0) + PLACE))
    assert not {"leans", "vertical-unknown"} & set(codes(stated, "note"))


def test_ground_that_one_of_them_does_not_see_is_named(tmp_path):
    rng = np.random.default_rng(9)
    target = write(tmp_path / "t.las", hills(1, 60_000))
    bits = hills(2, 60_000)
    bits = bits[(np.mod(bits[:, 0], 50.0) < 4.0) & (np.mod(bits[:, 1], 40.0) < 4.0)]
    sees_little = check_clouds(write(tmp_path / "s.las", bits[rng.permutation(len(bits))[:400]]), target)
    assert "ground-unseen" in codes(sees_little, "note")
    sees_much = check_clouds(write(tmp_path / "m.las", hills(2, 60_000)), target)
    assert "ground-unseen" not in codes(sees_much, "note")


def test_a_local_target_gives_a_result_without_a_crs(tmp_path):
    source, target = (
        write(tmp_path / "s.las", hills(1)),
        write(tmp_path / "t.las", hills(2, place=np.zeros(3)), None),
    )
    assert "target-local" in codes(check_clouds(source, target, target_crs="local"), "note")
    assert "target-local" not in codes(check_clouds(target, source, source_crs="local"), "note")


@pytest.mark.parametrize(
    ("name", "words", "roles"),
    [
        ("forest_plot_mls_uas", {"source_crs": "local"}, {"leans", "vertical-unknown"}),
        ("forest_plot_mls_uas", {"source_crs": "EPSG:6341+5703"}, set()),
        ("robot_scans", {"local": True}, {"leans", "stray"}),
        ("suburb_dense_ign770", {}, {"vertical-taken"}),
        ("bcts_forest_strips", {}, set()),
    ],
)
def test_small_and_wooded_real_pairs_raise_no_false_alarm(name, words, roles, shared_data):
    folder = shared_data / name
    report = check_clouds(folder / "source.laz", folder / "target.laz", **words)
    about_files = {"gps-time", "wkt-bit-unset"}
    assert codes(report, "error") == codes(report, "warning") == []
    assert set(codes(report, "note")) - about_files <= roles


def test_points_where_nothing_returned_are_found(shared_data):
    folder = shared_data / "robot_scans"
    report = check_clouds(folder / "source.laz", folder / "target_with_zero_returns.laz", local=True)
    assert codes(report, "warning") == []
    assert "no-returns" in codes(report, "note")
