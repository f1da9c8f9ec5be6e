"""Other formats are written: another reader finds every value, and a cloud comes back from each."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_scene import town
from pyproj import CRS
from typer.testing import CliRunner

import mtpcr_geo as mg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.cli.app import app
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError, OptionError, OutputError
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.formats.text_layout import TextLayout
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.io.write_any import write_any
from mtpcr_geo.pipeline.stages.steps import also_of, further_files

UTM = CRS.from_epsg(25832)
N = 700
RNG = np.random.default_rng(11)
XYZ = np.round(RNG.uniform(-50, 50, (N, 3)) + [500_000.0, 5_200_000.0, 100.0], 3)
TABLE: dict[str, np.ndarray] = {
    "Intensity": RNG.integers(0, 65536, N).astype(np.uint16),
    "Classification": RNG.integers(0, 19, N).astype(np.uint8),
    "GpsTime": RNG.uniform(0, 6e5, N),
    **{one: RNG.integers(0, 256, N).astype(np.uint8) for one in ("Red", "Green", "Blue")},
    "quality": RNG.uniform(0, 1, N).astype(np.float32),
    "ring": RNG.integers(-5, 5, N).astype(np.int16),
}
MOVE = np.array([10.5, -3.25, 1.125])
WRITTEN = ["ply", "pcd", "xyz", "txt", "asc", "csv", "npy"]


def cloud() -> ArrayCloud:
    return ArrayCloud(XYZ, UTM, "made", dict(TABLE))


def columns(path: Path) -> dict[str, np.ndarray]:
    """Every column of a file, by a reader that is not ours."""
    ending = path.suffix
    if ending == ".npy":
        array = np.load(path)
    elif ending == ".csv":
        array = np.genfromtxt(path, delimiter=",", names=True)
    elif ending in (".xyz", ".txt", ".asc"):
        names = path.read_text().splitlines()[0].lstrip("# ").split()
        array = np.genfromtxt(path, names=names, comments="#")
    elif ending == ".pcd":
        pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is not installed")
        array = pypcd4.PointCloud.from_path(path).pc_data
    else:
        array = ply_by_struct(path)
    return {name: np.asarray(array[name]) for name in array.dtype.names}


def ply_by_struct(path: Path) -> np.ndarray:
    """A binary PLY, value by value, by its specification."""
    codes = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f"}
    head, _, body = path.read_bytes().partition(b"end_header\n")
    words = [line.split() for line in head.decode().splitlines()]
    fields = [(word[2], {**codes, "double": "d"}[word[1]]) for word in words if word[0] == "property"]
    assert ["format", "binary_little_endian", "1.0"] in words
    layout = struct.Struct("<" + "".join(code for _, code in fields))
    rows = list(layout.iter_unpack(body))
    return np.array(rows, [(name, "f8") for name, _ in fields])


@pytest.mark.parametrize("ending", WRITTEN)
def test_another_reader_finds_every_value(ending, tmp_path):
    path = tmp_path / f"out.{ending}"
    assert write_any(path, cloud(), lambda xyz: xyz + MOVE, UTM).sentences("out") == []
    found = columns(path)
    for i, axis in enumerate("xyz"):
        assert np.abs(found[axis] - (XYZ + MOVE)[:, i]).max() < 1e-6
    if ending == "pcd":
        packed = found.pop("rgb").view(np.uint32)
        shifts = {"red": 16, "green": 8, "blue": 0}
        found |= {one: packed >> shift & 255 for one, shift in shifts.items()}
    names = {name: name.lower() for name in TABLE} | {"GpsTime": "gps_time"}
    for name, own in names.items():
        assert np.array_equal(found[own].astype(TABLE[name].dtype), TABLE[name]), name


@pytest.mark.parametrize("ending", [*WRITTEN, "e57", "las", "laz", "copc.laz"])
def test_a_cloud_comes_back_from_each_format(ending, tmp_path):
    if ending == "e57":
        pytest.importorskip("pye57", reason="pye57 is not installed")
    path = tmp_path / f"out.{ending}"
    left_out = write_any(path, cloud(), None, UTM)
    assert bool(left_out.dimensions) == (ending == "e57")
    back = open_any(path)
    assert back.count == N
    table = next(iter(back.table_chunks()))
    order = np.lexsort(XYZ.T)
    again = np.lexsort(np.round(np.column_stack([table[axis] for axis in "XYZ"]), 3).T)
    # E57 has float32 about the middle of each scan
    limit = 1e-5 if ending == "e57" else 1e-6
    for i, axis in enumerate("XYZ"):
        assert np.abs(table[axis][again] - XYZ[order, i]).max() < limit
    kept = ("Red", "Green", "Blue") if ending == "e57" else tuple(TABLE)
    for name in kept:
        assert np.array_equal(np.asarray(table[name][again], TABLE[name].dtype), TABLE[name][order]), name


def test_scans_of_e57_stay_scans(tmp_path):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
    scans = np.repeat([3, 9], N // 2).astype(np.uint16)
    write_any(tmp_path / "a.e57", ArrayCloud(XYZ, UTM, "made", {"PointSourceId": scans}), None, UTM)
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        assert file.scan_count == 2
        first = file.read_scan(0, ignore_missing_fields=True)
    assert np.abs(first["cartesianX"] - XYZ[: N // 2, 0]).max() < 1e-5


@pytest.mark.parametrize("ending", [*WRITTEN, "laz", "e57"])
def test_invalid_points_of_e57_are_no_points(ending, tmp_path):
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
    invalid = np.zeros(N, np.int8)
    invalid[::10] = 1
    invalid[5] = 2
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        for some in (invalid, None):
            data = {f"cartesian{axis}": XYZ[:, i] - XYZ[0, i] for i, axis in enumerate("XYZ")}
            if some is not None:
                data["cartesianInvalidState"] = some
            file.write_scan_raw(data)
    cloud = open_any(tmp_path / "a.e57", UTM)
    expected = np.concatenate([XYZ[invalid == 0], XYZ]) - XYZ[0]
    assert cloud.count == len(expected)
    write_any(tmp_path / f"out.{ending}", cloud, None, UTM)
    back = open_any(tmp_path / f"out.{ending}")
    assert back.count == len(expected)
    assert np.abs(back.to_array() - expected).max() < 0.001


def test_sixteen_bit_colours_and_wide_integers_are_kept(tmp_path):
    colours: dict[str, np.ndarray] = {
        one: RNG.integers(0, 65536, N).astype(np.uint16) for one in ("Red", "Green", "Blue")
    }
    wide: dict[str, np.ndarray] = {"id": RNG.integers(-(2**40), 2**40, N)}
    for ending in ("ply", "pcd", "npy", "csv"):
        path = tmp_path / f"a.{ending}"
        write_any(path, ArrayCloud(XYZ, UTM, "made", {**colours, **wide}), None, UTM)
        table = next(iter(open_any(path).table_chunks()))
        for name, values in {**colours, **wide}.items():
            assert np.array_equal(table[name].astype(np.int64), values.astype(np.int64)), (ending, name)


def test_degrees_keep_their_digits_in_text(tmp_path):
    degrees = np.column_stack([RNG.uniform(9, 9.001, N), RNG.uniform(47, 47.001, N), XYZ[:, 2]])
    write_any(tmp_path / "a.xyz", ArrayCloud(degrees), None, CRS.from_epsg(4326))
    assert np.abs(open_any(tmp_path / "a.xyz").to_array() - degrees).max() < 1e-6
    assert np.abs(open_any(tmp_path / "a.xyz").to_array() - degrees)[:, :2].max() < 1e-11


def test_what_cannot_be_written_is_said(tmp_path):
    with pytest.raises(OutputError, match="formats written"):
        write_any(tmp_path / "a.pts", cloud(), None, UTM)
    with pytest.raises(InputError, match="empty"):
        write_any(tmp_path / "a.ply", ArrayCloud(np.empty((0, 3))), None, UTM)
    with pytest.raises(OutputError, match="cannot write"):
        write_any(tmp_path / "none" / "a.ply", cloud(), None, UTM)


LAYOUTS = {
    "x y z": TextLayout(("x", "y", "z")),
    "x,y,-,z separator=; decimal=, skip=2": TextLayout(("x", "y", "-", "z"), ";", ",", 2),
    "separator=tab": TextLayout((), "\t"),
    "columns=z,y,x separator=space": TextLayout(("z", "y", "x"), ""),
}


@pytest.mark.parametrize("text", LAYOUTS)
def test_layouts_are_read_and_written_again(text):
    layout = TextLayout.read(text)
    assert layout == LAYOUTS[text]
    assert TextLayout.read(str(layout)) == layout
    assert TextLayout.read({"columns": "x y z", "skip": 1}) == TextLayout(("x", "y", "z"), skip=1)


@pytest.mark.parametrize(
    "text",
    ["x y", "x y z z", "x y z separator=ab", "x y z decimal=;", "skip=-1", "x y z colour=3",
     "x y z separator=, decimal=,"],
)  # fmt: skip
def test_layouts_that_say_nothing_are_refused(text):
    with pytest.raises(ValueError, match=r"columns|separator|decimal|skip|none of"):
        TextLayout.read(text)


TEXTS = {
    "order": ("{2} {0} {1}", ".", "z x y", ""),
    "semicolons": ("{0};{1};{2};{3}", ".", "x y z intensity separator=;", ""),
    "names among numbers": ("tree oak;{0};{1};{2}", ".", "- x y z separator=;", ""),
    "decimal commas": ("{0};{1};{2};{3}", ",", "x y z intensity separator=; decimal=,", ""),
    "decimal commas and blanks": ("{0} {1} {2}", ",", "x y z decimal=,", ""),
    "lines skipped": ("{0},{1},{2}", ".", "y x z skip=3", "1 2 3\n4 5 6\n7 8 9\n"),
    "a title": ("{0}\t{1}\t{2}", ".", "x y z separator=tab", "made\tby\ta scanner\n\n"),
    "empty fields": ("{0};;{1};{2};", ".", "x quality y z - separator=;", ""),
    "numbers as head, skipped": ("{0} {1} {2}", ".", "skip=1", "12 13 14 15\n"),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_columns_that_are_declared(kind, tmp_path):
    line, decimal, layout, head = TEXTS[kind]
    rows = [
        line.format(*(f"{value:.3f}".replace(".", decimal) for value in row), i % 200)
        for i, row in enumerate(XYZ)
    ]
    path = tmp_path / "scan.dat"
    path.write_text(head + "\n".join(rows) + "\n")
    found = open_any(path, text=layout)
    expected = XYZ[:, [1, 0, 2]] if layout.startswith("y x") else XYZ
    assert np.array_equal(found.to_array(), expected)
    if "intensity" in layout:
        table = next(iter(found.table_chunks()))
        assert np.array_equal(table["Intensity"], np.arange(N) % 200)


def test_layouts_that_do_not_suit_are_one_line_errors(tmp_path):
    path = tmp_path / "scan.txt"
    np.savetxt(path, XYZ)
    with pytest.raises(InputError, match="3 columns, and 4 are named"):
        open_any(path, text="x y z intensity")
    write_any(tmp_path / "a.las", cloud(), None, UTM)
    with pytest.raises(InputError, match="is no text"):
        open_any(tmp_path / "a.las", text="x y z")
    with pytest.raises(InputError, match="say its columns"):
        open_any(path.rename(tmp_path / "scan.dat"))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    rng = np.random.default_rng(2)
    both = [town(rng, 30_000), town(rng, 30_000)]
    target = folder / "target.laz"
    write_cloud(target, ArrayCloud(np.round(both[0], 3) + [500_000.0, 5_200_000.0, 100.0]), None, UTM)
    source = folder / "source.dat"
    rows = np.round(both[1], 3)[:, [1, 0, 2]]
    source.write_text("scan of a town\n" + "\n".join(f"7;{y:.3f};{x:.3f};{z:.3f}" for y, x, z in rows) + "\n")
    return source, target


@pytest.mark.slow
def test_the_command_takes_layout_format_and_scale(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source, target = map(str, scene)
    layout = "intensity y x z separator=; skip=1"
    local = ["--source-crs", "local", "--source-text", layout]
    run = CliRunner().invoke
    checked = run(app, ["check", source, target, *local, "--scale", "0.01"])
    assert checked.exit_code == 0, checked.output
    too_fine = run(app, ["check", source, target, *local, "--scale", "1e-9"])
    assert too_fine.exit_code == 7
    assert "--scale 1e-07" in too_fine.output
    words = [*local, "--scale", "0.01", "--also", "ply", "--no-recording"]
    done = run(app, ["register", source, target, "-o", "out", *words])
    assert done.exit_code in (0, 3), done.output
    assert laspy.read("out/registered.laz").header.scales.tolist() == [0.01] * 3
    moved = open_any("out/registered.ply").to_array()
    assert np.abs(moved - laspy.read("out/registered.laz").xyz).max() < 0.00501
    # the same from the pipeline that it prints
    dumped = run(app, ["register", source, target, "-o", "again", *words, "--dump-pipeline"])
    Path("p.json").write_text(dumped.output)
    assert run(app, ["pipeline", "p.json", "-q"]).exit_code in (0, 3)
    assert Path("again/registered.ply").read_bytes() == Path("out/registered.ply").read_bytes()
    # apply, in the format of its own, and back
    there = ["apply", "out/transform.json", source, "moved.csv", "--text", layout]
    assert run(app, there).exit_code == 0
    assert run(app, ["apply", "out/transform.json", "moved.csv", "back.npy", "--inverse"]).exit_code == 0
    assert np.abs(open_any("back.npy").to_array() - open_any(source, text=layout).to_array()).max() < 2e-6
    # what an earlier run left in another format does not stay
    done = run(app, ["register", source, target, "-o", "out", *local, "--overwrite", "--no-recording"])
    assert done.exit_code in (0, 3)
    assert not Path("out/registered.ply").exists()


def test_check_and_pipelines_take_layout_and_scale(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source, target = map(str, scene)
    layout = "intensity y x z separator=; skip=1"
    report = check_clouds(source, target, source_crs="local", source_text=layout, scale=0.01)
    assert report.goes_on
    report = check_clouds(source, target, source_crs="local", source_text=layout, scale=1e-9)
    assert report.exit_code == 7
    assert any("scale=1e-07" in one.fix for one in report.findings)
    # both are shown, where one cannot be opened
    report = check_clouds(source, target, source_crs="local", source_text="x y z")
    assert report.exit_code == 5
    assert report.files == {"source": source, "target": target}
    read = {"type": "mtpcr.read", "filename": source, "text": layout}
    mg.Pipeline([read, {"type": "mtpcr.write", "filename": "a.ply"}]).execute()
    assert np.array_equal(open_any("a.ply").to_array(), open_any(source, text=layout).to_array())
    mg.Pipeline([read, {"type": "mtpcr.write", "filename": "a.laz", "scale": 0.05}]).execute()
    assert laspy.read("a.laz").header.scales.tolist() == [0.05] * 3
    with pytest.raises(OptionError, match="formats written"):
        mg.Pipeline([read, {"type": "mtpcr.write", "filename": "a.pts"}]).validate()


def test_the_further_format_is_that_of_the_input(tmp_path):
    assert also_of(tmp_path / "a.PLY", "input") == "ply"
    assert also_of(tmp_path / "a.copc.laz", "input") == "copc.laz"
    assert also_of(tmp_path / "a.laz", "input") is None
    assert also_of(tmp_path / "a.laz", "pcd") == "pcd"
    for other in (tmp_path / "a.ptx", np.zeros((3, 3)), None):
        with pytest.raises(OptionError, match="--also input"):
            also_of(other, "input")
    left = {path.name for path in further_files(tmp_path)}
    assert {"registered.ply", "registered.e57", "registered.copc.laz", "audit.rrd"} <= left


@pytest.mark.slow
def test_formats_of_many_files(scene, tmp_path):
    source, target = scene
    lines = source.read_text().splitlines()[1:]
    folder = tmp_path / "scans"
    folder.mkdir()
    for i in range(3):
        rows = [line.split(";") for line in lines[i::3]]
        (folder / f"s{i}.xyz").write_text("\n".join(" ".join([r[2], r[1], r[3]]) for r in rows))
    found = mg.register(folder, target, tmp_path / "out", source_crs="local", also="input", recording=False)
    assert found.verdict.name in ("accepted", "doubtful")
    names = sorted(path.name for path in (tmp_path / "out" / "registered").iterdir())
    assert names == [f"s{i}.{ending}" for i in range(3) for ending in ("laz", "xyz")]


@pytest.mark.parametrize("ending", ["ply", "pcd", "npy"])
@pytest.mark.parametrize(("place", "severity"), [(5.2e6, "warning"), (9e4, "note"), (100.0, None)])
def test_single_precision_is_said_where_it_is_coarse(ending, place, severity, tmp_path):
    xyz = (town(np.random.default_rng(5), 4_000) + [0.0, place, 0.0]).astype(np.float32)
    path = tmp_path / f"a.{ending}"
    if ending == "npy":
        np.save(path, xyz)
    elif ending == "pcd":
        pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is not installed")
        pypcd4.PointCloud.from_xyz_points(xyz).save(path)
    else:
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n"
        head += "property float x\nproperty float y\nproperty float z\nend_header\n"
        path.write_bytes(head.encode() + xyz.tobytes())
    found = [one for one in check_clouds(path, local=True).findings if one.code == "single-precision"]
    assert [one.severity for one in found] == ([] if severity is None else [severity])
    # the same in double precision is no matter
    np.save(tmp_path / "b.npy", xyz.astype(np.float64) + 0.0001234)
    report = check_clouds(tmp_path / "b.npy", local=True)
    assert "single-precision" not in {one.code for one in report.findings}
