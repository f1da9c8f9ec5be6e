"""Formats other than LAS: what another library writes is read, value by value."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_scene import town
from pyproj import CRS

import mtpcr_geo as mg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.core.cloud import ArrayCloud, Cloud
from mtpcr_geo.core.errors import InputError, MissingPartError
from mtpcr_geo.io.formats import MODULES, open_any
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud

N = 1_000
RNG = np.random.default_rng(4)
XYZ = np.round(RNG.uniform(-50, 50, (N, 3)) + [500_000.0, 5_200_000.0, 100.0], 3)
INTENSITY = RNG.integers(0, 65536, N).astype(np.uint16)
RGB = RNG.integers(0, 256, (N, 3)).astype(np.uint8)
QUALITY = RNG.uniform(0, 1, N).astype(np.float32)


def ply(path: Path, order: str) -> Path:
    kinds = {"x": "double", "y": "double", "z": "double", "intensity": "ushort", "red": "uchar",
             "green": "uchar", "blue": "uchar", "quality": "float"}  # fmt: skip
    columns = [*XYZ.T, INTENSITY, *RGB.T, QUALITY]
    head = [f"ply\nformat {order} 1.0\ncomment made for a test\nelement vertex {N}"]
    head += [f"property {kind} {name}" for name, kind in kinds.items()]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header\n"]
    if order == "ascii":
        rows = "\n".join(" ".join(repr(one.item()) for one in row) for row in zip(*columns, strict=True))
        path.write_text("\n".join(head) + rows + "\n3 0 1 2\n")
        return path
    sign = "<" if "little" in order else ">"
    types = ("f8", "f8", "f8", "u2", "u1", "u1", "u1", "f4")
    records = np.zeros(N, [(name, sign + kind) for name, kind in zip(kinds, types, strict=True)])
    for name, column in zip(kinds, columns, strict=True):
        records[name] = column
    path.write_bytes("\n".join(head).encode() + records.tobytes() + b"\3\0\0\0\0\1\0\0\0\2\0\0\0")
    return path


def pcd(path: Path, encoding: str) -> Path:
    pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is not installed")
    fields = ("x", "y", "z", "intensity", "rgb", "quality")
    # in text as a whole number, else within a float, as the Point Cloud Library has both
    colour = np.uint32 if encoding == "ascii" else np.float32
    packed = (RGB.astype(np.uint32) << [16, 8, 0]).sum(axis=1).astype(np.uint32).view(colour)
    types = (np.float64, np.float64, np.float64, np.uint16, colour, np.float32)
    made = pypcd4.PointCloud.from_points([*XYZ.T, INTENSITY, packed, QUALITY], fields, types)
    made.save(path, encoding=pypcd4.Encoding(encoding))
    return path


def e57(path: Path) -> Path:
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
    file = pye57.E57(str(path), mode="w")
    turn = np.array([np.cos(0.2), 0, 0, np.sin(0.2)])  # a quaternion about z
    R = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    for part in (slice(0, N // 2), slice(N // 2, N)):
        place = XYZ[part].mean(axis=0)
        own = (XYZ[part] - place) @ R
        data = {f"cartesian{axis}": np.ascontiguousarray(own[:, i]) for i, axis in enumerate("XYZ")}
        data["intensity"] = QUALITY[part]
        data |= {f"color{one}": RGB[part, i].copy() for i, one in enumerate(("Red", "Green", "Blue"))}
        file.write_scan_raw(data, rotation=turn, translation=place)
    file.close()
    return path


def ptx(path: Path) -> Path:
    text = ""
    for part in (slice(0, N // 2), slice(N // 2, N)):
        place = np.round(XYZ[part].mean(axis=0), 1)
        own = XYZ[part] - place
        text += f"{N // 20}\n10\n{place[0]} {place[1]} {place[2]}\n1 0 0\n0 1 0\n0 0 1\n"
        text += f"1 0 0 0\n0 1 0 0\n0 0 1 0\n{place[0]} {place[1]} {place[2]} 1\n"
        for row, quality, colour in zip(own, QUALITY[part], RGB[part], strict=True):
            numbers = [*row, quality, *colour]
            text += " ".join(repr(one.item()) for one in numbers) + "\n"
    path.write_text(text)
    return path


def lines(path: Path, between: str, head: str, columns=None) -> Path:
    columns = [*XYZ.T, INTENSITY, *RGB.T, QUALITY] if columns is None else columns
    rows = [between.join(repr(one.item()) for one in row) for row in zip(*columns, strict=True)]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


def structured(path: Path) -> Path:
    records = np.zeros(N, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("intensity", "u2"), ("quality", "f4")])
    for i, axis in enumerate("xyz"):
        records[axis] = XYZ[:, i]
    records["intensity"], records["quality"] = INTENSITY, QUALITY
    np.save(path, records)
    return path


def plain(path: Path) -> Path:
    np.save(path, XYZ)
    return path


ALL = {"Intensity", "Red", "Green", "Blue", "quality"}
FILES = {
    "ply binary": (lambda p: ply(p / "a.ply", "binary_little_endian"), ALL),
    "ply big endian": (lambda p: ply(p / "a.ply", "binary_big_endian"), ALL),
    "ply text": (lambda p: ply(p / "a.PLY", "ascii"), ALL),
    "pcd text": (lambda p: pcd(p / "a.pcd", "ascii"), ALL),
    "pcd binary": (lambda p: pcd(p / "a.pcd", "binary"), ALL),
    "pcd compressed": (lambda p: pcd(p / "a.pcd", "binary_compressed"), ALL),
    "e57": (lambda p: e57(p / "a.e57"), {"Red", "Green", "Blue", "intensity_value", "PointSourceId"}),
    "ptx": (lambda p: ptx(p / "a.ptx"), {"Red", "Green", "Blue", "intensity_value", "PointSourceId"}),
    "csv": (lambda p: lines(p / "a.csv", ",", "X,Y,Z,Intensity,Red,Green,Blue,quality\n"), ALL),
    "csv of semicolons": (lambda p: lines(p / "a.csv", ";", "x; y; z; i; r; g; b; quality\n"), ALL),
    "txt with comments": (
        lambda p: lines(p / "a.txt", " ", "# a scan\n\n# x y z intensity red green blue quality\n"),
        ALL,
    ),
    "xyz": (lambda p: lines(p / "a.xyz", " ", "", [*XYZ.T]), set()),
    "asc of tabs": (lambda p: lines(p / "a.asc", "\t", "", [*XYZ.T, INTENSITY]), {"Intensity"}),
    "txt with colours": (lambda p: lines(p / "a.txt", "  ", "", [*XYZ.T, *RGB.T]), {"Red", "Green", "Blue"}),
    "pts": (
        lambda p: lines(p / "a.pts", " ", f"{N}\n", [*XYZ.T, INTENSITY, *RGB.T]),
        {"Intensity", "Red", "Green", "Blue"},
    ),
    "npy": (lambda p: plain(p / "a.npy"), set()),
    "structured npy": (lambda p: structured(p / "a.npy"), {"Intensity", "quality"}),
}
VALUES: dict[str, np.ndarray] = {"Intensity": INTENSITY, "quality": QUALITY, "intensity_value": QUALITY}
VALUES.update((colour, RGB[:, i]) for i, colour in enumerate(("Red", "Green", "Blue")))


def table(cloud: Cloud) -> dict[str, np.ndarray]:
    chunks = list(cloud.table_chunks(300))
    assert all(len(chunk["X"]) <= 300 for chunk in chunks)
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


@pytest.mark.parametrize("name", FILES)
def test_what_others_write_is_read_and_written_as_las(name, tmp_path):
    make, names = FILES[name]
    cloud = open_any(make(tmp_path))
    assert cloud.count == N
    found = table(cloud)
    assert set(found) - {"X", "Y", "Z"} == names
    posed = name in ("e57", "ptx")
    # pye57 writes single precision within a scan
    tolerance = 1e-5 if posed else 0.0
    assert np.allclose(np.column_stack([found[a] for a in "XYZ"]), XYZ, rtol=0, atol=tolerance)
    for one in names & set(VALUES):
        # pypcd4 writes ten digits of text
        assert np.allclose(found[one], np.asarray(VALUES[one]), rtol=1e-6, atol=1e-8), one
    if posed:
        assert found["PointSourceId"].tolist() == [1] * (N // 2) + [2] * (N // 2)
    write_cloud(tmp_path / "out.laz", cloud, None, CRS.from_epsg(25832))
    written = laspy.read(tmp_path / "out.laz")
    assert np.allclose(written.xyz, XYZ, rtol=0, atol=0.00051)
    if "Red" in names:
        assert np.array_equal(written.red, RGB[:, 0])
    if "quality" in names:
        assert np.allclose(written["quality"], QUALITY, rtol=1e-6, atol=1e-8)
    report = check_clouds(cloud.path, source_crs="EPSG:25832")
    assert report.exit_code == 0
    assert report.clouds["source"].points == N


def test_open3d_and_pdal_agree(tmp_path, pdal):
    path = ply(tmp_path / "a.ply", "binary_little_endian")
    reader = pdal.Reader(str(path), type="readers.ply").pipeline()
    reader.execute()
    assert np.array_equal(
        np.column_stack([reader.arrays[0][axis] for axis in "XYZ"]), open_any(path).to_array()
    )


def test_colours_of_decimals_are_no_colours(tmp_path):
    path = lines(tmp_path / "a.xyz", " ", "", [*XYZ.T, *RNG.uniform(-1, 1, (3, N))])
    assert set(table(open_any(path))) == {"X", "Y", "Z", "column_4", "column_5", "column_6"}


CUT_PLY = b"""ply
format binary_little_endian 1.0
element vertex 9
property float x
property float y
property float z
end_header
abc"""
BAD = {
    "no x": ("a.csv", b"a,b,c\n1,2,3\n", "no columns x, y and z"),
    "two columns": ("a.xyz", b"1 2\n3 4\n", "x, y and z are wanted"),
    "words": ("a.xyz", b"1 2 3\n4 five 6\n", "truncated or damaged"),
    "rows that differ": ("a.xyz", b"1 2 3\n4 5 6 7\n", "truncated or damaged"),
    "nothing": ("a.txt", b"", "holds no points"),
    "cut ply": ("a.ply", CUT_PLY, "truncated or damaged"),
    "ply of nothing": ("a.ply", b"ply\n", "truncated or damaged"),
    "ply without vertices": (
        "a.ply",
        b"ply\nformat ascii 1.0\nelement face 0\nend_header\n",
        "stands before",
    ),
    "cut ptx": ("a.ptx", b"10\n10\n0 0 0\n1 0 0\n", "truncated or damaged"),
    "npy of words": ("a.npy", b"\x93NUMPY nonsense", "truncated or damaged"),
    "another ending": ("a.obj", b"v 1 2 3", "ends in .obj, which says no format"),
    "no ending": ("a", b"v 1 2 3", "ends in nothing"),
    "pcd": ("a.pcd", b"nonsense", "truncated or damaged"),
    "e57": ("a.e57", b"nonsense", "truncated or damaged"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_one_line_errors(name, tmp_path):
    file, content, words = BAD[name]
    if name in ("pcd", "e57"):
        pytest.importorskip({"pcd": "pypcd4", "e57": "pye57"}[name])
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=words) as found:
        open_any(tmp_path / file).to_array()
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(("ending", "module"), [(".pcd", "pypcd4"), (".e57", "pye57")])
def test_a_missing_library_is_named(ending, module, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, module, None)
    (tmp_path / f"a{ending}").write_bytes(b"x")
    with pytest.raises(MissingPartError, match=r"mtpcr-geo\[formats\]"):
        open_any(tmp_path / f"a{ending}")


def test_a_las_file_of_any_ending_is_read(tmp_path):
    write_cloud(tmp_path / "a.laz", ArrayCloud(XYZ), None, None)
    (tmp_path / "a.txt").write_bytes((tmp_path / "a.laz").read_bytes())
    assert np.array_equal(open_any(tmp_path / "a.txt").to_array(), open_cloud(tmp_path / "a.laz").to_array())


def test_every_ending_has_its_module():
    from importlib import import_module

    for name in set(MODULES.values()):
        assert callable(import_module(f"mtpcr_geo.io.formats.{name}").open_file)


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> tuple[Path, np.ndarray, Path]:
    from mtpcr_geo.core import transforms

    rng = np.random.default_rng(3)
    folder = tmp_path_factory.mktemp("pair")
    turn = transforms.compose(transforms.yaw_matrix(np.deg2rad(40.0)), np.array([8.0, -5.0, 1.0]))
    source = town(rng, 30_000)
    write_cloud(
        folder / "source.laz", ArrayCloud(transforms.apply(turn, source[source[:, 0] > -30])), None, None
    )
    write_cloud(folder / "target.laz", ArrayCloud(town(rng, 40_000)), None, None)
    return folder, open_cloud(folder / "source.laz").to_array(), folder / "target.laz"


@pytest.mark.slow
def test_a_registration_from_any_format_is_that_of_the_laz(pair, tmp_path, monkeypatch):
    folder, xyz, target = pair
    plain = mg.register(folder / "source.laz", target, local=True)
    assert plain.verdict.name == "accepted"
    assert plain.T_target_source is not None
    monkeypatch.setitem(globals(), "XYZ", xyz)
    monkeypatch.setitem(globals(), "N", len(xyz))
    count = len(xyz)
    monkeypatch.setitem(globals(), "INTENSITY", np.resize(INTENSITY, count))
    monkeypatch.setitem(globals(), "RGB", np.resize(RGB, (count, 3)))
    monkeypatch.setitem(globals(), "QUALITY", np.resize(QUALITY, count))
    files = [
        ply(tmp_path / "s.ply", "binary_little_endian"),
        pcd(tmp_path / "s.pcd", "binary"),
        e57(tmp_path / "s.e57"),
        lines(tmp_path / "s.xyz", " ", "", [*xyz.T]),
    ]
    for file in files:
        found = mg.register(file, target, local=True)
        assert found.verdict.name == "accepted"
        assert found.T_target_source is not None
        assert np.allclose(found.T_target_source, plain.T_target_source, rtol=0, atol=1e-6), file.suffix
    out = mg.register(files[0], target, tmp_path / "out", local=True, recording=False)
    written = open_cloud(out.outputs["registered"])
    assert np.allclose(written.to_array(), plain.apply(xyz), rtol=0, atol=0.00051)
    moved = mg.apply(tmp_path / "out" / "transform.json", files[1], tmp_path / "moved.laz")
    assert isinstance(moved, Path)
    assert np.allclose(open_cloud(moved).to_array(), plain.apply(xyz), rtol=0, atol=0.00051)
