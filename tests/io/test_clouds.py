"""Reading, checking, sampling and writing clouds."""

import struct
from contextlib import suppress
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_paths import REPOSITORY
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pyproj import CRS

from mtpcr_geo.core.errors import InputError, MtpcrError, OutputError
from mtpcr_geo.io import ArrayCloud
from mtpcr_geo.io.dimensions import separate_legacy_flags
from mtpcr_geo.io.las import check_distinct, open_cloud
from mtpcr_geo.io.octree import OctreeSorter, Spool, quantise
from mtpcr_geo.io.sample import scan, surface_chunks
from mtpcr_geo.io.write import is_copc, write_cloud

MOVE = np.array([10.0, 20.0, 30.0])
UTM = CRS.from_epsg(25832)
DATA = REPOSITORY.parent / "shared" / "data"


def random_xyz(n=500, seed=1, far=(600_000.0, 5_000_000.0, 100.0)):
    rng = np.random.default_rng(seed)
    return np.round(rng.uniform(0, 100, (n, 3)), 3) + np.array(far)


def write_las(
    path, xyz=None, point_format=6, version=None, crs=None, fill=True, scale=0.001, extra=(), seed=3
):
    """Write a LAS or LAZ file through laspy alone, with random values in every dimension."""
    xyz = random_xyz() if xyz is None else xyz
    header = laspy.LasHeader(
        point_format=point_format, version=version or ("1.4" if point_format > 5 else "1.3")
    )
    header.scales, header.offsets = np.full(3, scale), np.floor(xyz.min(axis=0))
    header.add_extra_dims(list(extra))
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    if fill:
        rng = np.random.default_rng(3)
        for dimension in las.point_format.dimensions:
            if dimension.name in "XYZ":
                continue
            if dimension.kind == laspy.point.dims.DimensionKind.FloatingPoint:
                las[dimension.name] = rng.uniform(-5, 5, len(xyz)).astype(dimension.dtype)
            elif dimension.name == "scanner_channel" and las.point_format.has_waveform_packet:
                continue  # mixed channels with waveforms have a test of their own
            elif dimension.name == "wavepacket_size":
                las[dimension.name] = rng.integers(60, 300, len(xyz))
            elif dimension.name == "wavepacket_offset":
                las[dimension.name] = np.arange(len(xyz)) * 300
            elif dimension.name in ("scan_angle_rank", "scan_angle"):
                las[dimension.name] = rng.integers(-90, 91, len(xyz))
            elif dimension.num_elements == 1 and dimension.scales is None:
                low, high = int(dimension.min), int(dimension.max)
                las[dimension.name] = rng.integers(low, high, len(xyz), endpoint=True, dtype=np.int64)
    las.write(path)
    return las


def all_xyz(cloud):
    return np.concatenate(list(cloud.xyz_chunks()))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_every_point_format_keeps_every_dimension(tmp_path, suffix, point_format):
    extra = [
        laspy.ExtraBytesParams("amplitude", "f4", "echo amplitude"),
        laspy.ExtraBytesParams("range", "i4", "scaled", offsets=[1.0], scales=[0.01], no_data=[-9]),
        laspy.ExtraBytesParams("normal", "3f8", "surface normal"),
    ]
    before = write_las(tmp_path / f"in{suffix}", point_format=point_format, extra=extra)
    cloud = open_cloud(tmp_path / f"in{suffix}", UTM)
    write_cloud(tmp_path / f"out{suffix}", cloud, lambda xyz: xyz + MOVE, UTM)
    after = laspy.read(tmp_path / f"out{suffix}")

    assert after.header.version == "1.4"
    assert after.header.point_format.id >= 6
    assert after.header.are_points_compressed == (suffix == ".laz")
    assert after.header.global_encoding.wkt
    assert np.allclose(after.xyz, before.xyz + MOVE, atol=0.0005)
    for name in before.point_format.dimension_names:
        if name in "XYZ":
            continue
        if name == "scan_angle_rank":
            assert np.array_equal(np.rint(after.scan_angle * 0.006), before.scan_angle_rank)
        else:
            assert np.array_equal(np.asarray(after[name]), np.asarray(before[name])), name
    old, new = (las.header.vlrs.get("ExtraBytesVlr")[0] for las in (before, after))
    for a, b in zip(old.extra_bytes_structs, new.extra_bytes_structs, strict=True):
        assert (a.name, a.description, a.no_data) == (b.name, b.description, b.no_data)
    assert np.array_equal(after.header.mins, after.xyz.min(axis=0))
    assert after.header.number_of_points_by_return.sum() == np.count_nonzero(after.return_number)


def test_legacy_overlap_class_sets_the_flag(tmp_path):
    las = write_las(tmp_path / "in.las", point_format=1, fill=False)
    las.classification[:10] = 12
    las.write(tmp_path / "in.las")
    write_cloud(tmp_path / "out.las", open_cloud(tmp_path / "in.las"), None, None)
    after = laspy.read(tmp_path / "out.las")
    assert np.array_equal(np.flatnonzero(after.overlap), np.arange(10))


def test_las_1_0_is_read(tmp_path):
    path = tmp_path / "old.las"
    before = write_las(path, point_format=1, version="1.1")
    raw = bytearray(path.read_bytes())
    raw[25] = 0  # the minor version
    path.write_bytes(raw)
    assert np.array_equal(all_xyz(open_cloud(path)), before.xyz)


def test_identifiers_and_foreign_records_go_over(tmp_path):
    path = tmp_path / "in.las"
    las = write_las(path, point_format=3, version="1.2", crs=UTM)
    las.header.file_source_id = 77
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las.header.vlrs.append(laspy.VLR("maker", 9, "calibration", b"\x01\x02\x03"))
    las.write(path)
    write_cloud(tmp_path / "out.laz", open_cloud(path), None, UTM)
    header = laspy.read(tmp_path / "out.laz").header
    assert header.file_source_id == 77
    assert header.uuid == las.header.uuid
    assert header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    ids = [(vlr.user_id, vlr.record_id) for vlr in header.vlrs]
    assert ("maker", 9) in ids
    assert [record for user, record in ids if user == "LASF_Projection"] == [2112]
    assert header.parse_crs().to_epsg() == 25832


def test_internal_waveforms_go_over(tmp_path):
    path = tmp_path / "in.las"
    las = write_las(path, point_format=9)
    las.header.global_encoding.waveform_data_packets_internal = True
    packets = bytes(range(256)) * 4
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("LASF_Spec", 65535, "waveforms", packets)])
    las.write(path)
    raw = bytearray(path.read_bytes())
    raw[227:235] = raw[235:243]  # the waveforms are the first extended record
    path.write_bytes(raw)

    write_cloud(tmp_path / "out.laz", open_cloud(path), None, None)
    after = laspy.read(tmp_path / "out.laz")
    start = after.header.start_of_waveform_data_packet_record
    assert after.header.global_encoding.waveform_data_packets_internal
    assert (tmp_path / "out.laz").read_bytes()[start + 60 : start + 60 + len(packets)] == packets
    assert after.evlrs[0].record_data == packets


def test_chunks_are_bounded_and_in_order(tmp_path):
    before = write_las(tmp_path / "in.laz")
    cloud = open_cloud(tmp_path / "in.laz")
    chunks = list(cloud.xyz_chunks(size=120))
    assert [len(chunk) for chunk in chunks] == [120, 120, 120, 120, 20]
    assert np.array_equal(np.concatenate(chunks), before.xyz)
    table = next(iter(cloud.table_chunks()))
    assert list(table)[:3] == ["X", "Y", "Z"]
    assert np.array_equal(table["GpsTime"], before.gps_time)


def test_scale_follows_the_input_within_limits(tmp_path):
    for scale, expected in ((0.01, 0.001), (0.001, 0.001), (0.00025, 0.00025), (1e-7, 0.0001)):
        xyz = random_xyz(200, far=(5.0, 5.0, 5.0))
        write_las(tmp_path / "in.las", xyz, scale=scale)
        write_cloud(tmp_path / "out.las", open_cloud(tmp_path / "in.las"), None, UTM)
        assert np.allclose(open_cloud(tmp_path / "out.las").header.scales, expected)


def test_degrees_get_a_fine_scale(tmp_path):
    lonlat = random_xyz(300, far=(0.0, 0.0, 0.0)) * [1e-5, 1e-5, 1.0] + [9.0, 48.0, 100.0]
    write_cloud(tmp_path / "out.laz", ArrayCloud(lonlat), None, CRS.from_epsg(4326))
    assert np.allclose(all_xyz(open_cloud(tmp_path / "out.laz")), lonlat, rtol=0, atol=[6e-10, 6e-10, 6e-4])


def test_stray_points_do_not_wrap_around(tmp_path):
    xyz = random_xyz()
    xyz[7, 0] = 9e9
    # what fits is written, and how many do not is told
    assert write_cloud(tmp_path / "out.las", ArrayCloud(xyz), None, None) == 1
    assert np.allclose(laspy.read(tmp_path / "out.las").xyz, np.delete(xyz, 7, axis=0), atol=0.0005)
    xyz[::4, 0] = 9e9
    with pytest.raises(OutputError, match="do not fit"):
        write_cloud(tmp_path / "out.las", ArrayCloud(xyz), None, UTM)


def test_cloud_from_memory_with_pdal_names(tmp_path):
    n = 400
    rng = np.random.default_rng(0)
    extra = {
        "Intensity": rng.integers(0, 65535, n).astype(np.uint16),
        "ReturnNumber": np.full(n, 2, np.uint8),
        "NumberOfReturns": np.full(n, 3, np.uint8),
        "Classification": rng.integers(0, 19, n).astype(np.uint8),
        "Withheld": (np.arange(n) % 7 == 0).astype(np.uint8),
        "ScanAngleRank": np.full(n, -12.5, np.float32),
        "GpsTime": rng.uniform(0, 1e5, n),
        "Red": rng.integers(0, 65535, n).astype(np.uint16),
        "Green": np.zeros(n, np.uint16),
        "Blue": np.ones(n, np.uint16),
        "Deviation": rng.uniform(0, 1, n),
        "Inside": np.arange(n) % 2 == 0,
    }
    cloud = ArrayCloud(random_xyz(n), UTM, extra=extra)
    write_cloud(tmp_path / "out.laz", cloud, None, UTM)
    back = open_cloud(tmp_path / "out.laz")
    table = next(iter(back.table_chunks()))
    assert back.header.point_format.id == 7
    assert back.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    for name, values in extra.items():
        assert np.allclose(table[name], values, rtol=0, atol=0.003 if name == "ScanAngleRank" else 0), name
    assert not np.asarray(table["Synthetic"]).any()


def test_classes_above_31_are_classes(tmp_path):
    raw = np.full(300, 200, np.uint8)
    raw[:20] = 2 | 128
    cloud = ArrayCloud(random_xyz(300), UTM, extra={"Classification": raw})
    assert scan(cloud).dropped == 0
    write_cloud(tmp_path / "out.las", cloud, None, UTM)
    after = laspy.read(tmp_path / "out.las")
    assert np.array_equal(after.classification, raw)
    assert not np.asarray(after.withheld).any()
    assert not np.asarray(after.synthetic).any()


@pytest.mark.parametrize("name", ["Withheld", "ClassFlags"])
def test_flags_are_read_from_their_own_dimensions(tmp_path, name):
    flags = np.where(np.arange(300) < 20, 1 if name == "Withheld" else 4, 0).astype(np.uint8)
    extra: dict[str, NDArray[np.generic]] = {"Classification": np.full(300, 200, np.uint8), name: flags}
    cloud = ArrayCloud(random_xyz(300), UTM, extra=extra)
    assert scan(cloud).dropped == 20
    write_cloud(tmp_path / "out.las", cloud, None, UTM)
    after = laspy.read(tmp_path / "out.las")
    assert np.array_equal(np.flatnonzero(after.withheld), np.arange(20))
    assert set(np.asarray(after.classification)) == {200}


def test_a_class_that_las_cannot_hold_is_refused(tmp_path):
    # 263 is 7 in eight bits, and no noise
    cloud = ArrayCloud(random_xyz(300), UTM, extra={"Classification": np.full(300, 263)})
    assert scan(cloud).dropped == 0
    with pytest.raises(InputError, match="0-255"):
        write_cloud(tmp_path / "out.las", cloud, None, UTM)


def test_flags_of_older_pdal_are_separated_by_who_knows_the_file():
    raw = [5, 2 | 128, 12 | 32, 6 | 64]
    table: dict[str, NDArray[np.generic]] = {"X": np.zeros(4), "Classification": np.array(raw, np.uint8)}
    separate = separate_legacy_flags(table)
    assert separate["Classification"].tolist() == [5, 2, 12, 6]
    assert separate["Withheld"].tolist() == [0, 1, 0, 0]
    assert separate["Synthetic"].tolist() == [0, 0, 1, 0]
    assert separate["KeyPoint"].tolist() == [0, 0, 0, 1]
    with_flags = {**table, "ClassFlags": np.zeros(4, np.uint8)}
    assert separate_legacy_flags(with_flags) is with_flags


@pytest.mark.parametrize("suffix", ["las", "laz", "copc.laz"])
@pytest.mark.parametrize("standard", [True, False])
def test_gps_time_type_is_that_of_all_points(tmp_path, monkeypatch, suffix, standard):
    monkeypatch.setattr(ArrayCloud.table_chunks, "__defaults__", (100,))
    times = np.full(300, 5.0)
    times[250:] = 3e8 if standard else 604_000.0
    cloud = ArrayCloud(random_xyz(300), UTM, extra={"GpsTime": times})
    path = tmp_path / f"out.{suffix}"
    write_cloud(path, cloud, None, UTM)
    assert open_cloud(path).header.global_encoding.gps_time_type == int(standard)


@pytest.mark.parametrize("geokeys", [True, False])
def test_crs_is_read_from_wkt_and_geotiff_keys(tmp_path, geokeys):
    version, point_format = ("1.2", 1) if geokeys else ("1.4", 6)
    write_las(tmp_path / "in.las", point_format=point_format, version=version, crs=UTM)
    cloud = open_cloud(tmp_path / "in.las")
    assert cloud.crs is not None
    assert cloud.crs.to_epsg() == 25832


def geokey_record(keys):
    flat = [1, 1, 0, len(keys)]
    for key, value in keys.items():
        flat += [key, 0, 1, value]
    return struct.pack(f"<{len(flat)}H", *flat)


@pytest.mark.parametrize(
    ("keys", "name"),
    [
        ({1024: 1, 3072: 2994}, "ft"),
        ({1024: 2, 2048: 4326}, "WGS 84"),
        ({1024: 1, 3072: 25832, 4096: 5783, 4099: 9001}, "DHHN92"),
    ],
)
def test_geotiff_keys_alone(tmp_path, keys, name):
    path = tmp_path / "in.las"
    las = write_las(path, point_format=1, version="1.2")
    las.header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "keys", geokey_record(keys)))
    las.write(path)
    crs = open_cloud(path).crs
    assert crs is not None
    assert name in crs.name


def test_crs_that_cannot_be_read_is_a_note(tmp_path):
    path = tmp_path / "in.las"
    las = write_las(path)
    las.header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "wkt", b'PROJCS["nonsense\0'))
    las.write(path)
    cloud = open_cloud(path)
    assert cloud.crs is None
    assert "WKT" in cloud.crs_problem
    assert open_cloud(path, UTM).crs == UTM


def bad_file(kind, tmp_path):
    path = tmp_path / "bad.laz"
    if kind == "missing":
        return path
    if kind == "folder":
        return tmp_path
    if kind == "text":
        path.write_text("x,y,z\n1,2,3\n")
    elif kind == "nothing":
        path.write_bytes(b"")
    elif kind == "header only":
        write_las(path)
        path.write_bytes(path.read_bytes()[:200])
    elif kind.startswith("cut"):
        path = tmp_path / ("bad.las" if kind.endswith("las") else "bad.laz")
        write_las(path, random_xyz(5000))
        raw = path.read_bytes()
        path.write_bytes(raw[: len(raw) * 2 // 3])
    elif kind == "scrambled":
        write_las(path, random_xyz(5000))
        raw = bytearray(path.read_bytes())
        raw[len(raw) // 2 : len(raw) // 2 + 400] = bytes(400)
        raw[-30:] = bytes([255] * 30)
        path.write_bytes(raw)
    elif kind == "too many promised":
        write_las(path, random_xyz(5000))
        raw = bytearray(path.read_bytes())
        raw[247:255] = struct.pack("<Q", 500_000)
        path.write_bytes(raw)
    return path


@pytest.mark.parametrize(
    "kind",
    [
        *("missing", "folder", "text", "nothing", "header only"),
        *("cut las", "cut laz", "scrambled", "too many promised"),
    ],
)
def test_bad_files_are_one_line_errors(tmp_path, kind):
    path = bad_file(kind, tmp_path)
    with pytest.raises(InputError) as caught:
        scan(open_cloud(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 5


def with_value(value):
    xyz = random_xyz()
    xyz[100, 1] = value
    return xyz


@pytest.mark.parametrize(
    ("xyz", "words"),
    [
        (np.zeros((0, 3)), "empty"),
        (np.ones((1, 3)), "one point"),
        (np.ones((500, 3)), "same place"),
        (np.random.default_rng(0).random((50, 3)), "at least 100"),
        (np.random.default_rng(0).random((500, 3)) * [0, 1, 1], "no area"),
        (
            np.where(np.arange(1500).reshape(500, 3) == 300, np.nan, 1.0 * np.arange(1500).reshape(500, 3)),
            "finite",
        ),
        (
            np.where(np.arange(1500).reshape(500, 3) == 300, np.inf, 1.0 * np.arange(1500).reshape(500, 3)),
            "finite",
        ),
    ],
)
def test_poor_clouds_are_refused(xyz, words):
    with pytest.raises(InputError, match=words):
        scan(ArrayCloud(xyz))


def test_scan_of_nan_scale_in_a_file(tmp_path):
    path = tmp_path / "in.las"
    write_las(path)
    raw = bytearray(path.read_bytes())
    raw[131:139] = struct.pack("<d", float("nan"))
    path.write_bytes(raw)
    with pytest.raises(InputError, match="finite"):
        scan(open_cloud(path))


def test_noise_is_left_out_of_the_sample_only(tmp_path):
    las = write_las(tmp_path / "in.laz", fill=False)
    las.classification[:5] = 7
    las.classification[5:9] = 18
    las.withheld[9:12] = 1
    las.write(tmp_path / "in.laz")
    cloud = open_cloud(tmp_path / "in.laz")
    found = scan(cloud)
    assert (found.count, found.dropped, found.complete) == (500, 12, True)
    assert np.array_equal(found.sample, las.xyz[12:])
    assert np.array_equal(np.concatenate(list(surface_chunks(cloud, 100))), las.xyz[12:])
    assert np.array_equal(found.minimum, las.xyz[12:].min(axis=0))


def test_all_noise_is_refused():
    cloud = ArrayCloud(random_xyz(), extra={"Classification": np.full(500, 7, np.uint8)})
    with pytest.raises(InputError, match="noise"):
        scan(cloud)


class Chunked(ArrayCloud):
    """An array cloud that ignores the asked chunk size."""

    size = 1

    def table_chunks(self, size=0):
        return super().table_chunks(self.size)


@settings(max_examples=30)
@given(
    n=st.integers(150, 3000),
    budget=st.integers(100, 2000),
    chunk=st.integers(40, 3000),
    seed=st.integers(0, 99),
)
def test_sample_depends_on_the_seed_alone(n, budget, chunk, seed):
    xyz = np.column_stack([np.arange(n), np.arange(n) ** 2 % 97, np.zeros(n)]).astype(float)
    whole, pieces = ArrayCloud(xyz), Chunked(xyz)
    pieces.size = chunk
    found = scan(whole, budget=budget, seed=seed)
    assert np.array_equal(found.sample, scan(pieces, budget=budget, seed=seed).sample)
    assert len(found.sample) == min(n, budget)
    assert found.complete == (n <= budget)
    assert np.all(np.diff(found.sample[:, 0]) > 0)


def test_sample_is_uniform():
    xyz = np.column_stack([np.arange(200_000), np.arange(200_000) % 7, np.zeros(200_000)]).astype(float)
    sample = scan(ArrayCloud(xyz), budget=20_000, seed=5).sample
    share = np.histogram(sample[:, 0], bins=10, range=(0, 200_000))[0]
    assert np.all(np.abs(share - 2000) < 5 * np.sqrt(2000))
    other = scan(ArrayCloud(xyz), budget=20_000, seed=6).sample
    assert not np.array_equal(sample, other)


def test_same_cloud_twice_is_refused(tmp_path):
    write_las(tmp_path / "a.laz")
    (tmp_path / "b.laz").write_bytes((tmp_path / "a.laz").read_bytes())
    (tmp_path / "link.laz").symlink_to(tmp_path / "a.laz")
    write_las(tmp_path / "c.laz", random_xyz(seed=9))
    a = open_cloud(tmp_path / "a.laz")
    for other in ("a.laz", "b.laz", "link.laz"):
        with pytest.raises(InputError, match="same"):
            check_distinct(a, open_cloud(tmp_path / other))
    check_distinct(a, open_cloud(tmp_path / "c.laz"))
    with pytest.raises(InputError, match="same"):
        check_distinct(
            ArrayCloud(random_xyz()), memory := ArrayCloud(random_xyz())
        ) if False else check_distinct(memory := ArrayCloud(random_xyz()), memory)


def test_copc_is_a_real_octree(tmp_path):
    rng = np.random.default_rng(2)
    n = 200_000
    xyz = np.column_stack([rng.uniform(0, 300, n), rng.uniform(0, 200, n), rng.normal(20, 3, n)])
    xyz = np.round(xyz, 3) + np.array([600_000, 5_000_000, 0])
    cloud = ArrayCloud(
        xyz, UTM, extra={"GpsTime": np.arange(n) * 1.0, "Label": np.arange(n).astype(np.uint32)}
    )
    path = tmp_path / "out.copc.laz"
    write_cloud(path, cloud, None, UTM)
    with laspy.CopcReader.open(path) as reader:
        points = reader.query()
        order = np.argsort(points["Label"])
        assert np.allclose(np.column_stack([points.x, points.y, points.z])[order], xyz, atol=0.0006)
        assert np.array_equal(points["Label"][order], np.arange(n))
        levels = [len(reader.query(level=level)) for level in range(3)]
        assert 0 < levels[0] < n / 2
        assert sum(levels) == n
        assert reader.copc_info.gps_max == n - 1
        box = laspy.copc.Bounds(np.array([600_000.0, 5_000_000.0]), np.array([600_050.0, 5_000_050.0]))
        inside = np.sum(np.all(xyz[:, :2] <= box.maxs, axis=1))
        assert abs(len(reader.query(box)) - inside) <= 5
    assert len(all_xyz(open_cloud(path))) == n
    crs = open_cloud(path).crs
    assert crs is not None
    assert crs.to_epsg() == 25832
    copclib = pytest.importorskip("copclib", reason="copclib is not installed")
    assert copclib.FileReader(str(path)).copc_config.las_header.point_count == n


def test_octree_of_several_groups(tmp_path, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.io.octree._GROUP", 3000)
    monkeypatch.setattr("mtpcr_geo.io.octree._LEAF", 500)
    monkeypatch.setattr("mtpcr_geo.io.octree._CHUNK", 700)
    rng = np.random.default_rng(4)
    records = np.zeros(20_000, [("p", "<f8", 3), ("id", "<u4")])
    records["p"], records["id"] = rng.random((20_000, 3)) ** 2, np.arange(20_000)
    seen = []
    keys = []
    with (tmp_path / "a").open("w+b") as first, (tmp_path / "b").open("w+b") as second:
        spool = Spool(first, records.dtype, len(records))
        spool.write(0, records)
        sorter = OctreeSorter(spool, lambda part: quantise(part["p"], 1.0), lambda: second)
        for (level, *cell), points in sorter.nodes():
            keys.append((level, *cell))
            assert np.all(np.floor(points["p"] * 2**level) == cell)
            seen.append(points["id"])
    assert len(set(keys)) == len(keys)
    assert (0, 0, 0, 0) in keys
    assert np.array_equal(np.sort(np.concatenate(seen)), np.arange(20_000))


def test_copc_by_name():
    assert is_copc(Path("a.copc.laz"))
    assert is_copc(Path(".a.copc.part-77.laz"))
    assert not is_copc(Path("copc.laz"))
    assert not is_copc(Path("a.copc.las"))


def test_unwritable_place_is_an_output_error(tmp_path):
    with pytest.raises(OutputError):
        write_cloud(tmp_path / "missing" / "out.laz", ArrayCloud(random_xyz()), None, UTM)


def test_waveforms_do_not_fit_copc(tmp_path):
    write_las(tmp_path / "in.las", point_format=9)
    with pytest.raises(OutputError, match=r"\.laz"):
        write_cloud(tmp_path / "out.copc.laz", open_cloud(tmp_path / "in.las"), None, UTM)


def test_waveforms_of_mixed_channels_are_not_compressed(tmp_path):
    las = write_las(tmp_path / "in.las", point_format=9)
    las.scanner_channel = np.arange(len(las.points)) % 2
    las.write(tmp_path / "in.las")
    cloud = open_cloud(tmp_path / "in.las")
    with pytest.raises(OutputError, match=r"\.las"):
        write_cloud(tmp_path / "out.laz", cloud, None, UTM)
    write_cloud(tmp_path / "out.las", cloud, None, UTM)
    after = laspy.read(tmp_path / "out.las")
    assert np.array_equal(after.wavepacket_offset, las.wavepacket_offset)


@settings(max_examples=25)
@given(data=st.data())
def test_scrambled_files_never_raise_anything_else(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("scrambled") / "in.laz"
    write_las(path, random_xyz(300))
    raw = bytearray(path.read_bytes())
    for place in data.draw(st.lists(st.integers(4, len(raw) - 1), min_size=1, max_size=20)):
        raw[place] = data.draw(st.integers(0, 255))
    path.write_bytes(raw)
    with suppress(MtpcrError):
        scan(open_cloud(path))


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the real pairs in ../shared/data")
def test_real_pairs_read_as_their_headers_say():
    for path in sorted(DATA.glob("*/source.laz")):
        found = scan(cloud := open_cloud(path))
        assert found.count == cloud.count
        assert np.all(found.minimum >= cloud.minimum - 1e-6)
        assert np.all(found.maximum <= cloud.maximum + 1e-6)
