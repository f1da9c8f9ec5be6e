"""Many files as one cloud: a folder, a pattern, a list, a .vpc."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_scene import ORIGIN, town
from pyproj import CRS
from typer.testing import CliRunner

import mtpcr_geo as mg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.export.apply import write_moved
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.many import ManyFiles, files_of, output_names, placed, uncommon_of
from mtpcr_geo.io.sample import scan
from mtpcr_geo.io.views import Moved
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.io.write_any import LeftOut, write_any

UTM = CRS.from_epsg(25833)


def save(path: Path, xyz: np.ndarray, crs: CRS | None = UTM, count: int = 1) -> list[Path]:
    """Write a cloud as so many files, all with one scale and offset, in the order of its points."""
    files = []
    for i, part in enumerate(np.array_split(xyz, count)):
        file = path if count == 1 else path / f"tile_{i:02d}.laz"
        file.parent.mkdir(exist_ok=True)
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = np.full(3, 0.001), np.floor(ORIGIN)
        if crs is not None:
            header.add_crs(crs)
        las = laspy.LasData(header)
        las.xyz = part
        las.intensity = np.arange(len(part)) % 65536
        las.write(file)
        files.append(file)
    return files


@pytest.fixture(scope="module")
def clouds(tmp_path_factory) -> tuple[Path, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    folder = tmp_path_factory.mktemp("many")
    turn = transforms.compose(transforms.yaw_matrix(np.deg2rad(40.0)), np.array([8.0, -5.0, 1.0]))
    source = town(rng, 30_000)
    source = transforms.apply(turn, source[source[:, 0] > -30]) + ORIGIN
    target = town(rng, 40_000)
    # by place, as tiles are
    target = target[np.lexsort((target[:, 1] // 30, target[:, 0] // 40))] + ORIGIN
    save(folder / "source.laz", source)
    save(folder / "sources", source, count=5)
    save(folder / "target.laz", target)
    save(folder / "tiles", target, count=12)
    return folder, source, target


def ways(folder: Path, tiles: Path) -> list[str | Path]:
    files = sorted(tiles.iterdir())
    (folder / "list.txt").write_text(
        "# tiles\n" + "\n".join(str(file.relative_to(folder)) for file in files) + "\n"
    )
    features = [
        {"type": "Feature", "assets": {"data": {"href": f"./{file.relative_to(folder)}"}}} for file in files
    ]
    (folder / "tiles.vpc").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return [tiles, str(tiles / "*.laz"), f"@{folder / 'list.txt'}", folder / "tiles.vpc"]


def test_every_way_of_naming_them_gives_the_one_cloud(clouds):
    folder, _, _ = clouds
    one = open_cloud(folder / "target.laz")
    for way in ways(folder, folder / "tiles"):
        many = open_any(way)
        assert isinstance(many, ManyFiles)
        assert many.count == one.count
        assert len(many.parts) == 12
        assert many.crs is not None
        assert np.array_equal(many.to_array(), one.to_array())
        assert np.array_equal(many.minimum, one.minimum)
        table = {
            name: np.concatenate([t[name] for t in many.table_chunks(700)]) for name in ("X", "Intensity")
        }
        assert np.array_equal(table["X"], one.to_array()[:, 0])


@pytest.mark.parametrize("size", [1, 999, 3_333, 3_334, 100_000])
def test_chunks_are_those_of_one_file(clouds, size):
    folder, _, _ = clouds
    one, many = (open_any(folder / name) for name in ("target.laz", "tiles"))
    if size == 1:
        one, many = (open_any(folder / name) for name in ("source.laz", "sources"))
        size = 7_777
    for a, b in zip(one.noise_chunks(size), many.noise_chunks(size), strict=True):
        assert np.array_equal(a[0], b[0])
        assert np.array_equal(a[1], b[1])
    for x, y in zip(one.xyz_chunks(size), many.xyz_chunks(size), strict=True):
        assert np.array_equal(x, y)
    assert np.array_equal(scan(one, budget=5_000).sample, scan(many, budget=5_000).sample)


@pytest.mark.slow
def test_tiles_give_the_same_transform_to_the_bit_and_a_source_of_five_comes_back_as_five(clouds, tmp_path):
    folder, source, _ = clouds
    one = mg.register(folder / "source.laz", folder / "target.laz", tmp_path / "one", recording=False)
    many = mg.register(folder / "sources", folder / "tiles", tmp_path / "many", recording=False)
    assert one.verdict.name == many.verdict.name == "accepted"
    assert one.T_target_source is not None
    assert many.T_target_source is not None
    assert np.array_equal(one.T_target_source, many.T_target_source)
    assert many.outputs["registered"] == tmp_path / "many" / "registered"
    documents = [json.loads((tmp_path / name / "transform.json").read_text()) for name in ("one", "many")]
    for document in documents:
        document.pop("files")
    assert documents[0] == documents[1]
    names = [f"tile_{i:02d}.laz" for i in range(5)]
    assert sorted(file.name for file in (tmp_path / "many" / "registered").iterdir()) == names
    whole = laspy.read(tmp_path / "one" / "registered.laz")
    parts = [laspy.read(tmp_path / "many" / "registered" / name) for name in names]
    assert np.allclose(np.concatenate([part.xyz for part in parts]), whole.xyz, rtol=0, atol=0.00101)
    assert np.array_equal(
        np.concatenate([np.asarray(part.intensity) for part in parts])[:100], np.arange(100)
    )
    run = json.loads((tmp_path / "many" / "run.json").read_text())
    assert len(run["inputs"]) == 17
    # and they follow the transform, there and back
    transform = tmp_path / "many" / "transform.json"
    mg.apply(transform, folder / "sources", tmp_path / "there")
    mg.apply(transform, tmp_path / "there", tmp_path / "back", inverse=True)
    back = open_any(tmp_path / "back")
    assert np.abs(back.to_array() - source).max() <= 0.0011
    # saving writes the same files
    again = mg.register(folder / "sources", folder / "tiles")
    again.save(tmp_path / "saved")
    assert sorted(file.name for file in (tmp_path / "saved" / "registered").iterdir()) == names


def test_different_systems_are_refused(clouds, tmp_path):
    _, source, _ = clouds
    save(tmp_path / "a.laz", source)
    save(tmp_path / "b.laz", source, CRS.from_epsg(25832))
    with pytest.raises(CrsError, match="bring them to one system"):
        open_any(tmp_path)
    # of some that state none the system is not known, until an option names it
    save(tmp_path / "b.laz", source, None)
    many = open_any(tmp_path)
    assert many.crs is None
    assert "b.laz states none" in many.crs_problem
    assert open_any(tmp_path, UTM).crs == UTM
    assert check_clouds(tmp_path).exit_code == 6
    assert check_clouds(tmp_path, source_crs="EPSG:25833").exit_code == 0


@pytest.fixture
def tiles(tmp_path):
    """Two tiles, one without points, and what lies in folders beside clouds."""
    xyz = np.round(np.random.default_rng(1).uniform(0, 50, (600, 3)) + ORIGIN, 3)
    folder = tmp_path / "tiles"
    save(folder, xyz, count=2)
    save(folder / "empty.las", np.empty((0, 3)))
    (folder / "notes.txt").write_text("flown in May\nno rain\n")
    (folder / "table.csv").write_text("tile,points\n0,300\n")
    (folder / "readme.md").write_text("tiles")
    return folder


@pytest.mark.parametrize("way", ["", "/*", "/*.l*"])
def test_what_lies_beside_clouds_is_left_out(tiles, way):
    many = open_any(f"{tiles}{way}")
    assert isinstance(many, ManyFiles)
    assert [Path(part.name).name for part in many.parts] == ["empty.las", "tile_00.laz", "tile_01.laz"]
    assert many.count == 600
    # the empty one tells nothing of the bounds
    assert (many.minimum > ORIGIN - 1.0).all()
    assert {found.code for found in check_clouds(f"{tiles}{way}").findings}.isdisjoint({"outside-area"})


def test_texts_alone_are_clouds(tmp_path):
    for i in range(2):
        np.savetxt(tmp_path / f"s{i}.txt", np.random.default_rng(i).uniform(0, 9, (50, 3)))
    assert open_any(tmp_path).count == 100
    assert open_any(f"{tmp_path}/*.txt", text="x y z").count == 100


def test_lists_and_virtual_clouds_as_programs_write_them(tiles, tmp_path):
    first = tiles / "tile_00.laz"
    (tmp_path / "list.txt").write_text(f'# tiles\n\n  "tiles/{first.name}"  \n  # none\n')
    assert open_any(f"@{tmp_path / 'list.txt'}").count == 300
    assets = {
        "thumbnail first": {"thumbnail": {"href": "a.png"}, "data": {"href": f"./tiles/{first.name}"}},
        "by its role": {"a": {"href": "a.png"}, "cloud": {"href": str(first), "roles": ["data"]}},
        "an address": {"data": {"href": first.as_uri()}},
    }
    for name, asset in assets.items():
        (tmp_path / "one.vpc").write_text(json.dumps({"features": [{"assets": asset}]}))
        assert open_any(tmp_path / "one.vpc").count == 300, name


def test_many_files_are_moved_to_a_folder(tiles, tmp_path):
    with pytest.raises(InputError, match="name one"):
        write_moved(tmp_path / "out.laz", Moved(open_any(tiles), lambda xyz: xyz + 1.0, UTM))
    write_moved(tmp_path / "out", Moved(open_any(tiles), lambda xyz: xyz + 1.0, UTM))
    assert {one.name: open_cloud(one).count for one in (tmp_path / "out").iterdir()} == {
        "empty.las": 0, "tile_00.laz": 300, "tile_01.laz": 300,
    }  # fmt: skip


def test_formats_and_scales_may_differ(tmp_path):
    xyz = np.round(np.random.default_rng(1).uniform(0, 50, (900, 3)), 2)
    write_cloud(tmp_path / "a.las", ArrayCloud(xyz[:300]), None, None, 0.01)
    write_cloud(tmp_path / "b.copc.laz", ArrayCloud(xyz[300:600]), None, None)
    np.save(tmp_path / "c.npy", xyz[600:])
    (tmp_path / "readme.md").write_text("not a cloud")
    many = open_any(tmp_path)
    assert many.count == 900
    assert np.allclose(np.sort(many.to_array(), axis=0), np.sort(xyz, axis=0), rtol=0, atol=0.0006)
    assert output_names([Path("a.las"), Path("x/A.las"), Path("c.npy"), Path("b.copc.laz")]) == [
        "a.las", "A_2.las", "c.laz", "b.copc.laz",
    ]  # fmt: skip


def test_a_file_without_points_takes_no_dimension_from_the_others(tmp_path):
    folder = tmp_path / "tiles"
    save(folder, np.random.default_rng(6).uniform(0, 20, (400, 3)) + ORIGIN, count=2)
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(folder / "tile_00a.las")
    whole = open_any(folder, CRS.from_epsg(25833))
    assert uncommon_of(whole) == ()
    for name in ("whole.laz", "whole.ply"):
        assert write_any(tmp_path / name, whole, None, UTM) == LeftOut()
        table = next(open_any(tmp_path / name).table_chunks())
        assert (table["Intensity"] == [*range(200), *range(200)]).all()


def test_dimensions_that_not_all_files_have_are_left_out_and_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(7)
    for name, point_format in (("a", 7), ("b", 6)):
        header = laspy.LasHeader(version="1.4", point_format=point_format)
        header.scales = np.full(3, 0.001)
        if name == "a":
            header.add_extra_dim(laspy.ExtraBytesParams("amplitude", "f4"))
        las = laspy.LasData(header)
        las.xyz = rng.uniform(0, 20, (300, 3))
        las.intensity = np.full(300, 9)
        las.write(f"{name}.laz")
    parts = [open_any("a.laz"), open_any("b.laz")]
    left_out = write_any(Path("whole.csv"), ManyFiles(Path("both"), UTM, parts), None, UTM)
    assert left_out == LeftOut(0, (), ("Red", "Green", "Blue", "amplitude"))
    assert LeftOut.read(left_out.as_dict()) == left_out
    (said,) = left_out.sentences("whole.csv")
    assert said == "Red, Green, Blue, amplitude left out of whole.csv: not all of the files joined have them"
    both = {"type": "mtpcr.read", "filename": "[ab].laz"}
    ran = mg.Pipeline([both, {"type": "mtpcr.write", "filename": "whole.laz"}])
    ran.execute()
    assert "amplitude" in str(ran.metadata)


def test_columns_in_another_order_stay_themselves(tmp_path):
    one = ArrayCloud(np.zeros((3, 3)), UTM, extra={"first": np.full(3, 1.0), "second": np.full(3, 2.0)})
    other = ArrayCloud(np.ones((3, 3)), UTM, extra={"second": np.full(3, 2.0), "first": np.full(3, 1.0)})
    whole = ManyFiles(tmp_path, UTM, [one, other])
    write_any(tmp_path / "whole.ply", whole, None, UTM)
    table = next(open_any(tmp_path / "whole.ply").table_chunks())
    assert (table["first"] == 1).all()
    assert (table["second"] == 2).all()


def test_what_names_nothing_is_said(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "list.txt").write_text("missing.laz\n")
    (tmp_path / "bad.vpc").write_text("{}")
    (tmp_path / "far.vpc").write_text('{"features": [{"assets": {"data": {"href": "https://x/a.laz"}}}]}')
    for name, words in {
        "empty": "names no cloud",
        "*.laz": "names no cloud",
        "bad.vpc": "no virtual point cloud",
        "far.vpc": "only files on this machine",
    }.items():
        with pytest.raises(InputError, match=words):
            open_any(str(tmp_path / name))
    for name, words in {"list.txt": "which is not there", "none.txt": "cannot read the list"}.items():
        with pytest.raises(InputError, match=words):
            open_any(f"@{tmp_path / name}")


def test_check_and_the_command_take_them(clouds, tmp_path):
    folder, _, _ = clouds
    report = check_clouds(folder / "sources", folder / "tiles")
    assert report.exit_code == 0
    assert report.clouds["target"].format == "12 files"
    assert report.relation is not None
    assert report.relation.name == "overlapping"
    shutil.copytree(folder / "tiles", tmp_path / "tiles")
    shutil.copy(folder / "source.laz", tmp_path / "tiles")
    same = check_clouds(tmp_path / "tiles" / "source.laz", tmp_path / "tiles")
    assert same.exit_code == 5
    files = [str(file) for file in sorted((folder / "tiles").iterdir())]
    found = CliRunner().invoke(app, ["register", *files, "-o", str(tmp_path / "out")])
    assert found.exit_code == 2
    assert "a pattern in quotes" in found.output


def test_what_a_folder_is_called_is_no_part_of_a_pattern(tmp_path, monkeypatch):
    folder = tmp_path / "p [1] q"
    (folder / "scans").mkdir(parents=True)
    for name in ("a.xyz", "b.xyz"):
        (folder / "scans" / name).write_text("1 2 3\n4 5 6\n")
    monkeypatch.chdir(folder)
    found = files_of(placed("scans/*.xyz"), lambda path: True)
    assert [path.name for path in found] == ["a.xyz", "b.xyz"]
    monkeypatch.chdir(tmp_path)
    found = files_of(placed("scans/*.xyz", folder), lambda path: True)
    assert [path.name for path in found] == ["a.xyz", "b.xyz"]
    # a file whose name looks like a pattern is that file
    (folder / "x[1].xyz").write_text("1 2 3\n")
    assert placed("x[1].xyz", folder) == folder / "x[1].xyz"
