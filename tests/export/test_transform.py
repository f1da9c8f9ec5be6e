"""Transform files, and applying them."""

import json
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pyproj import CRS, Transformer

import mtpcr_geo as mg
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import CrsError, InputError, OutputError
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.crs import TransformChain, resolve_frames
from mtpcr_geo.export.apply import apply_transform, far_text, heights_text, moved_by
from mtpcr_geo.export.descriptions import shift_text, transform_rows
from mtpcr_geo.export.pdal_file import write_pdal_pipeline
from mtpcr_geo.export.prior_file import read_pose
from mtpcr_geo.export.transform import (
    dumps,
    read_transform,
    write_cloudcompare_matrix,
    write_transform_json,
)
from mtpcr_geo.io import ArrayCloud
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.io.write_any import write_any

UTM, FEET = CRS.from_epsg(2993), CRS.from_epsg(2994)
GEOGRAPHIC = CRS.from_epsg(4152)  # the datum of both
PLACE = np.array([194_000.0, 258_800.0, 120.0])
T_WORK = transforms.compose(
    transforms.yaw_matrix(0.7) @ transforms.tilt_matrix(0.3, 0.05), np.array([12.5, -7.25, 1.5])
)


def written_in(crs, xyz):
    """Coordinates of the metric test system in another one, feet up where it is in feet."""
    columns = Transformer.from_crs(UTM, crs, always_xy=True).transform(*xyz.T)
    result = np.column_stack(columns)
    if crs == FEET:
        result[:, 2] /= 0.3048
    return result


def site(n=600, seed=0, decimals=3):
    rng = np.random.default_rng(seed)
    return np.round(PLACE + rng.uniform(0, [300, 200, 30], (n, 3)), decimals)


def a_pair(target_crs=UTM, source_crs=UTM, source_path=None, scale=0.001, **options):
    target = ArrayCloud(written_in(target_crs, site(seed=1)), target_crs, name="target.laz")
    source: Cloud = ArrayCloud(
        written_in(source_crs, site()) if source_crs is not None else site() - PLACE,
        source_crs,
        name="source.laz",
    )
    if source_path is not None:
        write_cloud(source_path, source, None, source_crs, scale=scale)
        source = open_cloud(source_path)
    frame, target_link, source_link = resolve_frames(target, source, **options)
    sides = [
        Side("target", target, target_link, target_link.to_work(file_xyz(target))),
        Side("source", source, source_link, source_link.to_work(file_xyz(source))),
    ]
    return Pair(target=sides[0], source=sides[1], frame=frame, T_target_source=T_WORK)


def file_xyz(cloud):
    return np.concatenate(list(cloud.xyz_chunks()))


KINDS: dict[str, dict[str, Any]] = {
    "metres": {},
    "feet to metres": {"source_crs": FEET},
    "metres to feet": {"target_crs": FEET},
    "feet": {"target_crs": FEET, "source_crs": FEET},
    "degrees to metres": {"source_crs": GEOGRAPHIC},
    "metres to degrees": {"target_crs": GEOGRAPHIC},
    "local to metres": {"source_crs": None, "source_crs_said": "local"},
    "metres, out in feet": {"out_crs": FEET},
}


def pair_of(kind, **more):
    options = dict(KINDS[kind])
    if "source_crs_said" in options:
        said = options.pop("source_crs_said")
        source_crs = options.pop("source_crs")
        return a_pair_local(said, source_crs, **options, **more)
    return a_pair(**options, **more)


def a_pair_local(said, source_crs, source_path=None, scale=0.001):
    pair = a_pair()
    source: Cloud = ArrayCloud(site() - PLACE, source_crs, name="source.laz")
    if source_path is not None:
        write_cloud(source_path, source, None, None, scale=scale)
        source = open_cloud(source_path)
    frame, target_link, link = resolve_frames(pair.target.cloud, source, source_crs=said)
    side = Side("source", source, link, link.to_work(file_xyz(source)))
    return Pair(
        target=Side("target", pair.target.cloud, target_link, pair.target.sample),
        source=side,
        frame=frame,
        T_target_source=T_WORK,
    )


def test_the_shift_of_local_clouds_is_in_metres():
    feet = CRS.from_wkt('LOCAL_CS["site grid",UNIT["foot",0.3048],AXIS["X",EAST],AXIS["Y",NORTH]]')
    xyz = site() - PLACE
    target, source = (ArrayCloud(xyz / 0.3048, feet, name=f"{role}.laz") for role in ("target", "source"))
    frame, target_link, source_link = resolve_frames(target, source)
    T = transforms.translation(np.array([1.0, -2.0, 0.5]))
    sides = [
        Side("target", target, target_link, target_link.to_work(target.xyz)),
        Side("source", source, source_link, source_link.to_work(source.xyz)),
    ]
    pair = Pair(target=sides[0], source=sides[1], frame=frame, T_target_source=T)
    assert shift_text(pair) == "+1.000, -2.000, +0.500 m (x, y, z)"


@pytest.mark.parametrize("kind", KINDS)
def test_everything_comes_back_from_the_file(tmp_path, kind):
    pair = pair_of(kind)
    write_transform_json(tmp_path / "t.json", pair)
    chain, again = TransformChain.of(pair), read_transform(tmp_path / "t.json")
    xyz = file_xyz(pair.source.cloud)
    assert np.array_equal(again.forward(xyz), chain.forward(xyz))
    assert np.array_equal(again.T_target_source, T_WORK)
    for link, link_again in ((chain.source, again.source), (chain.target, again.target)):
        assert link_again.report.as_dict() == link.report.as_dict()
        assert link_again.georeferenced is link.georeferenced
    back = again.inverse(again.forward(xyz))
    assert np.allclose(back, xyz, rtol=0, atol=1e-10 if "degrees to" in kind else 1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_the_matrix_says_the_same_or_how_far_it_is_off(tmp_path, kind):
    pair = pair_of(kind)
    write_transform_json(tmp_path / "t.json", pair)
    data = json.loads((tmp_path / "t.json").read_text())
    T, xyz = np.array(data["T_target_source"]), file_xyz(pair.source.cloud)
    chain = TransformChain.of(pair)
    off = chain.target.to_work(transforms.apply(T, xyz)) - chain.target.to_work(chain.forward(xyz))
    worst = np.linalg.norm(off, axis=1).max()
    assert data["exactness"]["exact"] == ("degrees" not in kind)
    assert worst <= max(1e-6, data["exactness"]["departure_m"] * 1.05)
    assert data["exactness"]["departure_m"] < 0.05
    assert np.allclose(np.array(data["T_source_target"]) @ T, np.eye(4), atol=1e-6)
    pivot = data["pivot"]
    turned = (xyz - pivot["source"]) @ np.array(pivot["linear"]).T + pivot["target"]
    assert np.allclose(turned, transforms.apply(T, xyz), rtol=0, atol=0.05 if "degrees" in kind else 1e-6)
    example = data["example"]
    assert np.allclose(chain.forward(np.array([example["source"]]))[0], example["target"], rtol=0, atol=1e-9)
    assert np.allclose(example["source_again"], example["source"], rtol=0, atol=1e-6)


def test_the_file_says_its_frames_and_units(tmp_path):
    write_transform_json(tmp_path / "t.json", a_pair(source_crs=FEET))
    data = json.loads((tmp_path / "t.json").read_text())
    assert data["units"] == {"source": ["foot"] * 3, "target": ["metre"] * 3}
    assert data["chain"]["source"]["crs"]["authority"] == "EPSG:2994"
    assert data["work"]["crs"]["authority"] == "EPSG:2993"
    assert data["motion"]["yaw_deg"] == pytest.approx(np.degrees(transforms.yaw_of(T_WORK[:3, :3])))
    assert data["files"] == {"source": "source.laz", "target": "target.laz"}
    text = (tmp_path / "t.json").read_text()
    assert f"{T_WORK[0, 0]:.17g}" in text


def test_an_estimated_height_offset_is_reported(tmp_path):
    target = CRS.from_user_input("EPSG:2993+5703")
    xyz = site()
    clouds = ArrayCloud(site(seed=1), target, name="t"), ArrayCloud(xyz, UTM, name="s")
    frame, target_link, link = resolve_frames(*clouds, vertical="estimate")
    pair = Pair(
        target=Side("target", clouds[0], target_link, target_link.to_work(clouds[0].xyz)),
        source=Side("source", clouds[1], link, link.to_work(xyz)),
        frame=frame,
        T_target_source=transforms.translation(link.origin - target_link.origin + np.array([0, 0, -1.25])),
    )
    write_transform_json(tmp_path / "t.json", pair)
    motion = json.loads((tmp_path / "t.json").read_text())["motion"]
    assert motion["vertical_offset_m"] == pytest.approx(-1.25)
    assert np.allclose(motion["shift_of_pivot_m"], [0, 0, -1.25], atol=1e-9)


@pytest.mark.parametrize("kind", ["metres", "feet to metres", "local to metres", "metres to feet"])
def test_cloudcompare_matrix_on_shifted_coordinates(tmp_path, kind):
    pair = pair_of(kind)
    write_cloudcompare_matrix(tmp_path / "cc.txt", pair)
    write_transform_json(tmp_path / "t.json", pair)
    lines = (tmp_path / "cc.txt").read_text().splitlines()
    # CloudCompare reads the first four
    rows = [line.split() for line in lines[:4]]
    assert [len(row) for row in rows] == [4, 4, 4, 4]
    assert all(line.startswith("# ") for line in lines[4:])
    matrix = np.array(rows, float)
    said = json.loads((tmp_path / "t.json").read_text())["cloudcompare"]
    xyz = file_xyz(pair.source.cloud)
    # as CloudCompare does: points in single precision, less the shift
    local = (xyz + said["source_global_shift"]).astype(np.float32).astype(float)
    placed = transforms.apply(matrix, local) - said["target_global_shift"]
    assert np.allclose(placed, TransformChain.of(pair).forward(xyz), rtol=0, atol=5e-4)
    assert np.abs(matrix[:3, 3]).max() < 5000
    shift = next(line for line in lines if line.startswith("# source global shift: "))
    assert [float(word) for word in shift.split(": ")[1].split()] == said["source_global_shift"]
    # the file says enough to be a prior
    pose = read_pose(tmp_path / "cc.txt")
    assert isinstance(pose, np.ndarray)
    # sums far from the origin cost digits
    assert np.allclose(transforms.apply(pose, xyz), TransformChain.of(pair).forward(xyz), rtol=0, atol=1e-6)
    assert (
        ", ".join(f"{v:.10g}" for v in said["source_global_shift"])
        in dict(transform_rows(pair))["in CloudCompare"]
    )


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "local to metres"])
def test_pdal_does_the_same(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    pdal = pytest.importorskip("pdal", reason="PDAL is not installed")
    pair = pair_of(
        kind,
        source_path=tmp_path / "source.las",
        scale=(1e-9, 1e-9, 0.001) if "degrees to" in kind else 0.001,
    )
    write_pdal_pipeline(tmp_path / "p.pdal.json", pair)
    stages = json.loads((tmp_path / "p.pdal.json").read_text())["pipeline"]
    pipeline = pdal.Pipeline(json.dumps(stages[:-1]))
    pipeline.execute()
    placed = np.column_stack([pipeline.arrays[0][axis] for axis in "XYZ"])
    expected = TransformChain.of(pair).forward(file_xyz(pair.source.cloud))
    assert np.allclose(placed, expected, rtol=0, atol=1e-9 if kind.endswith("degrees") else 1e-6)


def test_pdal_writes_the_whole_pipeline(tmp_path, monkeypatch):
    pdal = pytest.importorskip("pdal", reason="PDAL is not installed")
    pair = a_pair(source_path=tmp_path / "source.laz")
    write_pdal_pipeline(tmp_path / "p.pdal.json", pair)
    monkeypatch.chdir(tmp_path)
    pdal.Pipeline((tmp_path / "p.pdal.json").read_text()).execute()
    result = open_cloud(tmp_path / "source_registered.las")
    expected = TransformChain.of(pair).forward(file_xyz(pair.source.cloud))
    assert np.allclose(file_xyz(result), expected, rtol=0, atol=0.00051)
    assert result.crs is not None
    assert result.crs.to_epsg() == 2993


@pytest.mark.parametrize("kind", KINDS)
def test_apply_there_and_back_returns_every_point(tmp_path, kind):
    in_scale = 1e-8 if "degrees to" in kind else 0.001
    pair = pair_of(kind, source_path=tmp_path / "source.laz", scale=(in_scale, in_scale, 0.001))
    write_transform_json(tmp_path / "t.json", pair)
    apply_transform(tmp_path / "t.json", tmp_path / "source.laz", tmp_path / "there.laz")
    apply_transform(tmp_path / "t.json", tmp_path / "there.laz", tmp_path / "back.laz", inverse=True)
    there, back = open_cloud(tmp_path / "there.laz"), open_cloud(tmp_path / "back.laz")
    xyz = file_xyz(pair.source.cloud)
    chain = TransformChain.of(pair)
    assert np.all(np.abs(file_xyz(there) - chain.forward(xyz)) <= there.header.scales * 0.51)
    assert np.all(np.abs(file_xyz(back) - xyz) <= pair.source.cloud.header.scales / 2)
    wanted = chain.target.file_crs
    assert there.crs is not None
    assert wanted is not None
    assert there.crs.to_epsg() == wanted.to_epsg()
    assert (back.crs is None) == (pair.source.cloud.crs is None)


@settings(max_examples=15)
@given(
    yaw=st.floats(-np.pi, np.pi),
    tilt=st.floats(-0.2, 0.2),
    move=st.tuples(*[st.floats(-500, 500)] * 3),
    scale=st.sampled_from([0.01, 0.001, 0.0001]),
)
def test_apply_there_and_back_whatever_the_transform(tmp_path_factory, yaw, tilt, move, scale):
    folder = tmp_path_factory.mktemp("apply")
    T = transforms.compose(transforms.yaw_matrix(yaw) @ transforms.tilt_matrix(yaw, tilt), np.array(move))
    pair = a_pair(source_path=folder / "source.laz", scale=scale).with_(T_target_source=T)
    write_transform_json(folder / "t.json", pair)
    apply_transform(folder / "t.json", folder / "source.laz", folder / "there.laz")
    apply_transform(folder / "t.json", folder / "there.laz", folder / "back.laz", inverse=True)
    xyz = file_xyz(pair.source.cloud)
    assert np.abs(file_xyz(open_cloud(folder / "back.laz")) - xyz).max() <= scale / 2


def test_apply_keeps_dimensions(tmp_path):
    pair = a_pair()
    extra: dict[str, NDArray[np.generic]] = {
        "Intensity": np.arange(600, dtype=np.uint16),
        "Height": np.linspace(0, 1, 600),
    }
    write_cloud(tmp_path / "in.laz", ArrayCloud(site(), UTM, extra=extra), None, UTM)
    write_transform_json(tmp_path / "t.json", pair)
    apply_transform(tmp_path / "t.json", tmp_path / "in.laz", tmp_path / "out.copc.laz")
    las = laspy.read(tmp_path / "out.copc.laz")
    order = np.argsort(las.intensity)
    assert np.array_equal(np.asarray(las["Height"])[order], extra["Height"])


def test_apply_refuses_what_it_must(tmp_path):
    pair = a_pair(source_path=tmp_path / "source.laz")
    write_transform_json(tmp_path / "t.json", pair)
    write_cloud(tmp_path / "feet.laz", ArrayCloud(written_in(FEET, site()), FEET), None, FEET)
    with pytest.raises(CrsError, match="starts from"):
        apply_transform(tmp_path / "t.json", tmp_path / "feet.laz", tmp_path / "out.laz")
    with pytest.raises(InputError, match="input and output"):
        apply_transform(tmp_path / "t.json", tmp_path / "source.laz", tmp_path / "source.laz", overwrite=True)
    (tmp_path / "there.laz").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        apply_transform(tmp_path / "t.json", tmp_path / "source.laz", tmp_path / "there.laz")
    raw = (tmp_path / "source.laz").read_bytes()
    (tmp_path / "cut.laz").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(InputError):
        apply_transform(tmp_path / "t.json", tmp_path / "cut.laz", tmp_path / "new.laz")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("cut.laz", "feet.laz", "source.laz", "t.json", "there.laz")
    ]


def test_apply_writes_no_other_format_and_never_over_its_own_transform(tmp_path):
    pair = a_pair(source_path=tmp_path / "source.laz")
    write_transform_json(tmp_path / "t.json", pair)
    before = (tmp_path / "t.json").read_bytes()
    (tmp_path / "link.laz").hardlink_to(tmp_path / "t.json")
    for name, words in (
        ("t.json", "input and output"),
        ("link.laz", "input and output"),
        ("out.pts", "ends in"),
    ):
        with pytest.raises((InputError, OutputError), match=words):
            apply_transform(tmp_path / "t.json", tmp_path / "source.laz", tmp_path / name, overwrite=True)
    assert (tmp_path / "t.json").read_bytes() == before


WITH_HEIGHTS = "EPSG:2993+5703"  # the metric test system, heights above NAVD88


@pytest.mark.parametrize("side", ["source", "target"])
def test_apply_takes_the_file_that_was_registered_by_a_crs_given_for_it(tmp_path, side):
    stated = CRS.from_epsg(4326) if side == "source" else UTM
    source = ArrayCloud(site(), stated, name="source.laz")
    target = ArrayCloud(site(seed=1), CRS.from_epsg(26910), name="target.laz")
    frame, target_link, source_link = resolve_frames(
        target, source, source_crs=WITH_HEIGHTS, target_crs=WITH_HEIGHTS
    )
    sides = [
        Side("target", target, target_link, target_link.to_work(target.xyz)),
        Side("source", source, source_link, source_link.to_work(source.xyz)),
    ]
    pair = Pair(target=sides[0], source=sides[1], frame=frame, T_target_source=T_WORK)
    write_transform_json(tmp_path / "t.json", pair)
    chain = read_transform(tmp_path / "t.json")
    inverse = side == "target"
    given, other = (target, source) if inverse else (source, target)
    assert moved_by(chain, given, inverse=inverse).count == 600
    assert moved_by(TransformChain.of(pair), given, inverse=inverse).count == 600
    with pytest.raises(CrsError, match="--cloud-crs"):
        moved_by(chain, ArrayCloud(site(), FEET), inverse=inverse)
    if side == "source":
        with pytest.raises(CrsError, match="starts from"):
            moved_by(chain, other, inverse=inverse)


def test_apply_takes_a_cloud_that_states_the_plan_alone(tmp_path):
    pair = a_pair(source_crs=CRS.from_user_input(WITH_HEIGHTS), target_crs=CRS.from_user_input(WITH_HEIGHTS))
    chain = TransformChain.of(pair)
    silent = ArrayCloud(site(), UTM)
    assert np.array_equal(moved_by(chain, silent).to_array(), chain.forward(site()))
    said = heights_text(chain, silent)
    assert said is not None
    assert "says nothing of heights: they are taken as NAVD88 height, as those of the source" in said
    assert heights_text(chain, ArrayCloud(site(), chain.source.file_crs)) is None
    assert heights_text(chain, ArrayCloud(site(), None)) is None
    # heights of another kind, or in another unit, are not those of the frame
    for other in ("EPSG:2993+6360", "EPSG:2993+5702", "EPSG:2994", "EPSG:26910"):
        with pytest.raises(CrsError, match="starts from"):
            moved_by(chain, ArrayCloud(site(), CRS.from_user_input(other)))
    with pytest.raises(CrsError, match="starts from"):
        moved_by(TransformChain.of(a_pair()), ArrayCloud(site(), CRS.from_user_input(WITH_HEIGHTS)))


def test_apply_takes_the_crs_that_is_given_instead_of_the_one_stated(tmp_path):
    pair = a_pair()
    write_transform_json(tmp_path / "t.json", pair)
    write_cloud(tmp_path / "in.laz", ArrayCloud(site(), CRS.from_epsg(26910)), None, CRS.from_epsg(26910))
    paths = tmp_path / "t.json", tmp_path / "in.laz", tmp_path / "out.laz"
    with pytest.raises(CrsError, match="--cloud-crs"):
        apply_transform(*paths)
    with pytest.raises(CrsError, match=r"give cloud_crs if"):
        mg.apply(*paths[:2])
    apply_transform(*paths, cloud_crs="EPSG:2993")
    expected = TransformChain.of(pair).forward(site())
    assert np.abs(open_cloud(tmp_path / "out.laz").to_array() - expected).max() < 0.002
    moved = mg.apply(*paths[:2], cloud_crs="local")
    assert isinstance(moved, Cloud)
    assert np.abs(moved.to_array() - expected).max() < 0.002


@pytest.mark.parametrize("inverse", [False, True])
def test_apply_refuses_a_cloud_without_crs_that_lies_far_away(tmp_path, inverse):
    pair = a_pair(source_path=tmp_path / "source.laz")
    write_transform_json(tmp_path / "t.json", pair)
    chain = read_transform(tmp_path / "t.json")
    near = chain.bounds if not inverse else chain.forward(chain.bounds)
    diagonal = np.linalg.norm(np.ptp(chain.bounds, axis=0)[:2])
    for away, refused in ((1.0, False), (5.0, False), (30.0, True), (5e6, True)):
        cloud = ArrayCloud(near + [away * diagonal, 0, 0], None)
        if refused:
            with pytest.raises(CrsError, match="states no CRS and lies"):
                moved_by(chain, cloud, inverse=inverse)
        else:
            assert moved_by(chain, cloud, inverse=inverse).count == 2
        # one in the same CRS is moved, and that it lies far away is said
        start = (chain.target if inverse else chain.source).file_crs
        same = ArrayCloud(near + [away * diagonal, 0, 0], start)
        assert (far_text(chain, same, inverse=inverse) is not None) == (away > 1.5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        ("[]", "not a transform"),
        ('{"T_target_source": []}', "not a transform"),
        ('{"type": "mtpcr-geo transform", "version": 99}', "version"),
        ('{"type": "mtpcr-geo transform", "version": 1}', "damaged"),
    ],
)
def test_other_files_are_no_transforms(tmp_path, text, words):
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_transform(tmp_path / "t.json")


def test_a_damaged_transform_is_refused(tmp_path):
    write_transform_json(tmp_path / "t.json", a_pair())
    text = (tmp_path / "t.json").read_text()
    data = json.loads(text)
    for change in (
        lambda d: d["work"]["T_target_source"].pop(),
        lambda d: d["chain"]["source"].pop("origin"),
        lambda d: d["chain"]["target"]["crs"].update(wkt="nonsense"),
        lambda d: d["chain"]["target"].update(origin=[1, 2, None]),
    ):
        broken = json.loads(text)
        change(broken)
        assert broken != data
        (tmp_path / "broken.json").write_text(json.dumps(broken))
        with pytest.raises(InputError, match="damaged"):
            read_transform(tmp_path / "broken.json")
    with pytest.raises(InputError, match="cannot read"):
        read_transform(tmp_path / "missing.json")


@settings(max_examples=100)
@given(
    value=st.recursive(
        st.one_of(
            st.floats(allow_nan=False, allow_infinity=False),
            st.integers(-(2**53), 2**53),
            st.text(),
            st.booleans(),
            st.none(),
        ),
        lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(), inner, max_size=4)),
        max_leaves=20,
    )
)
def test_json_is_read_back_as_it_was(value):
    assert json.loads(dumps(value)) == value


def test_numbers_have_17_digits():
    assert dumps(0.1) == "0.10000000000000001"
    assert dumps(np.array([[1.0, 2.5]])) == "[\n  [1.0, 2.5]\n]"


def metres_of(crs, xyz):
    """Metres a unit of x, y and z of coordinates at a place."""
    if crs is None or crs == UTM:
        return np.ones(3)
    if crs == FEET:
        return np.full(3, 0.3048)
    lat = np.radians(xyz[0, 1])
    lon_m = 111_412.84 * np.cos(lat) - 93.5 * np.cos(3 * lat)
    return np.array([lon_m, 111_132.95 - 559.85 * np.cos(2 * lat) + 1.17 * np.cos(4 * lat), 1.0])


def with_normals(xyz, crs, names, kind=np.float64):
    rng = np.random.default_rng(8)
    vectors = rng.normal(size=(len(xyz), 3))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    extra = {name: vectors[:, i].astype(kind) for i, name in enumerate(names)}
    return vectors, ArrayCloud(xyz, crs, "normals", extra)


def normals_of(path, names):
    table = next(iter(open_any(path).table_chunks()))
    by_lower = {name.lower(): np.asarray(values) for name, values in table.items()}
    return np.column_stack([by_lower[name.lower()] for name in names])


@pytest.mark.parametrize("ending", ["laz", "ply", "csv"])
@pytest.mark.parametrize("kind", KINDS)
def test_normals_turn_with_the_points(tmp_path, kind, ending):
    pair = pair_of(kind)
    write_transform_json(tmp_path / "t.json", pair)
    chain = read_transform(tmp_path / "t.json")
    names = {"laz": ("NormalX", "NormalY", "NormalZ"), "ply": ("nx", "ny", "nz")}.get(
        ending, ("Nx", "Ny", "Nz")
    )
    xyz, crs = file_xyz(pair.source.cloud), chain.source.file_crs
    vectors, cloud = with_normals(xyz, crs, names)
    write_any(tmp_path / f"in.{ending}", cloud, None, crs)
    paths = (tmp_path / "t.json", tmp_path / f"in.{ending}", tmp_path / f"out.{ending}")
    apply_transform(*paths, cloud_crs=None if ending == "laz" else "local" if crs is None else crs.to_wkt())
    # where the points a metre along the normals come to
    moved = chain.forward(xyz)
    ahead = chain.forward(xyz + vectors / metres_of(crs, xyz))
    expected = (ahead - moved) * metres_of(chain.target.file_crs, moved)
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    found = normals_of(paths[2], names)
    assert np.abs(np.linalg.norm(found, axis=1) - 1.0).max() < 1e-9
    assert np.abs(found - expected).max() < (1e-7 if "degrees" not in kind and "out" not in kind else 1e-3)
    back = tmp_path / f"back.{ending}"
    apply_transform(paths[0], paths[2], back, inverse=True, cloud_crs="local")
    assert np.abs(normals_of(back, names) - vectors).max() < 1e-9


def test_what_is_no_direction_is_not_turned(tmp_path):
    pair = a_pair()
    chain = TransformChain.of(pair)
    _, cloud = with_normals(site(), UTM, ("NormalX", "NormalY", "NormalZ"), np.int8)
    cloud.extra |= {"nx": np.ones(600), "ny": np.ones(600), "range": np.linspace(0, 1, 600)}
    (table,) = moved_by(chain, cloud).table_chunks()
    for name, values in cloud.extra.items():
        assert np.array_equal(table[name], values), name
    write_cloud(tmp_path / "out.laz", cloud, chain.motion(), UTM)
    assert np.array_equal(laspy.read(tmp_path / "out.laz")["NormalY"], cloud.extra["NormalY"])


@pytest.mark.parametrize("kind", ["metres", "feet to metres", "metres to degrees"])
def test_directions_of_waveforms_turn_with_the_points(tmp_path, kind):
    pair = pair_of(kind)
    chain = TransformChain.of(pair)
    crs, xyz = chain.source.file_crs, file_xyz(pair.source.cloud)
    header = laspy.LasHeader(version="1.4", point_format=9)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz[0])
    las = laspy.LasData(header)
    las.xyz = xyz
    beams = np.random.default_rng(9).normal(size=(600, 3)) * 1.5e-4
    for i, name in enumerate(("x_t", "y_t", "z_t")):
        las[name] = beams[:, i]
    las.write(tmp_path / "in.las")
    write_cloud(tmp_path / "out.las", open_cloud(tmp_path / "in.las", crs), chain.motion(), None)
    written = laspy.read(tmp_path / "out.las")
    found = np.column_stack([written[name] for name in ("x_t", "y_t", "z_t")])
    far = 1e5  # picoseconds
    expected = (chain.forward(las.xyz + far * beams) - chain.forward(las.xyz)) / far
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()
