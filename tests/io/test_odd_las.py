"""LAS files that are sound but for a text, a name, a descriptor, a count or the size of a record."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_las import SCALE, WKT, descriptor, points, write_raw
from pyproj import CRS

from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.las import LasCloud, open_cloud
from mtpcr_geo.io.write import write_cloud

UTM = CRS.from_epsg(25832)
FORMATS = ["las", "laz", "copc.laz"]


def two(i: int) -> bytes:
    return struct.pack("<HH", i, 2 * i)


def eb(*descriptors: bytes) -> tuple[bytes, int, bytes, bytes]:
    return (b"LASF_Spec", 4, b"".join(descriptors), b"")


def values(cloud: LasCloud) -> np.ndarray:
    """All points, by their GPS time."""
    found = np.concatenate([record.array for record in cloud.record_chunks()])
    return found[np.argsort(found["gps_time"])]


def again(cloud: LasCloud, path: Path) -> LasCloud:
    write_cloud(path, cloud, None, UTM)
    return open_cloud(path)


EXTRA = {
    "latin-1 name": ([eb(descriptor(3, b"H\xf6he"), descriptor(3, b"B"))], two, ["Höhe", "B"]),
    "utf-8 name": ([eb(descriptor(3, "Höhe".encode()), descriptor(3, b"B"))], two, ["Höhe", "B"]),
    "latin-1 text": ([eb(descriptor(3, b"A", b"\xe9cart"), descriptor(3, b"B"))], two, ["A", "B"]),
    "32 byte name": ([eb(descriptor(3, b"N" * 32), descriptor(3, b"B"))], two, ["N" * 32, "B"]),
    "a name twice": ([eb(descriptor(3, b"A"), descriptor(3, b"A"))], two, ["A", "A_2"]),
    "a name of the format's": (
        [eb(descriptor(3, b"intensity"), descriptor(3, b"Z"))],
        two,
        ["intensity_2", "Z_2"],
    ),
    "no name": ([eb(descriptor(3, b""), descriptor(3, b""))], two, ["extra_1", "extra_2"]),
    "more descriptors than bytes": (
        [eb(descriptor(3, b"A"), descriptor(3, b"B"), descriptor(9, b"C"))],
        two,
        ["A", "B"],
    ),
    "fewer descriptors than bytes": ([eb(descriptor(3, b"A"))], two, ["A", "ExtraBytes"]),
    "no descriptor": ([], two, ["ExtraBytes"]),
    "an unknown type": ([eb(descriptor(3, b"A"), descriptor(99, b"B"))], two, ["A", "ExtraBytes"]),
    "two records": ([eb(descriptor(3, b"A")), eb(descriptor(3, b"B"))], two, ["A", "B"]),
    "three records": (
        [eb(descriptor(1, b"A")), eb(descriptor(1, b"B")), eb(descriptor(3, b"A"))],
        two,
        ["A", "B", "A_2"],
    ),
    "half a descriptor": (
        [(b"LASF_Spec", 4, descriptor(3, b"A") + descriptor(3, b"B")[:100], b"")],
        two,
        ["A", "ExtraBytes"],
    ),
}


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("name", EXTRA)
def test_extra_dimensions_are_kept_however_they_are_described(tmp_path, name, suffix):
    records, extra, names = EXTRA[name]
    cloud = open_cloud(write_raw(tmp_path / "in.las", records=[WKT, *records], extra=extra))
    assert list(cloud.point_format.extra_dimension_names) == names
    assert np.allclose(cloud.to_array(), points(), rtol=0, atol=1e-9)
    written = again(cloud, tmp_path / f"out.{suffix}")
    assert list(written.point_format.extra_dimension_names) == names
    before, after = values(cloud), values(written)
    for one in names:
        assert np.array_equal(before[one], after[one])
    assert before[names[0]].any()
    # whatever the input was, the output is read by others
    assert list(laspy.read(tmp_path / f"out.{suffix}").point_format.extra_dimension_names) == names


@pytest.mark.parametrize("count", [341, 342, 700])
def test_many_extra_dimensions_stand_behind_the_points(tmp_path, count):
    many = eb(*(descriptor(1, b"d%d" % i) for i in range(count)))
    path = write_raw(
        tmp_path / "in.las",
        records=[WKT],
        extended=[many],
        extra=lambda i: bytes((i + k) % 256 for k in range(count)),
        count=50,
    )
    cloud = open_cloud(path)
    written = again(cloud, tmp_path / "out.laz")
    names = [f"d{i}" for i in range(count)]
    assert list(written.point_format.extra_dimension_names) == names
    before, after = values(cloud), values(written)
    assert all(np.array_equal(before[name], after[name]) for name in names)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize(
    ("user", "text"),
    [
        (b"Societ\xe9", b"caf\xe9"),
        ("Société".encode(), b"plain"),
        (b"sixteen_letters_", b"of thirty-two bytes, all of them"),
        (b"plain", b"d\xfcnn"),
    ],
)
def test_records_of_any_text_are_kept(tmp_path, user, text, suffix):
    foreign = (user, 5, b"\0\1\2\xff", text)
    path = write_raw(tmp_path / "in.las", records=[foreign, WKT, foreign], extended=[foreign])
    cloud = open_cloud(path)
    written = again(cloud, tmp_path / f"out.{suffix}")
    kept = [record for record in written.records if record.record_id == 5]
    assert len(kept) == 3
    for record in kept:
        assert record.data == b"\0\1\2\xff"
        assert record.user_id == cloud.records[0].user_id
        assert record.description == cloud.records[0].description
    assert len(laspy.read(tmp_path / f"out.{suffix}")) == 300


@pytest.mark.parametrize("suffix", FORMATS)
def test_large_records_are_streamed_over(tmp_path, suffix, monkeypatch):
    monkeypatch.setattr("mtpcr_geo.io.foreign._BLOCK", 1000)
    monkeypatch.setattr("mtpcr_geo.io.vlr.read_records.__defaults__", (5_000,))
    rng = np.random.default_rng(1)
    large = [(b"trajectory", 70 + i, rng.bytes(size), b"line") for i, size in enumerate((12_345, 90_000))]
    small = (b"small", 9, b"kept too", b"")
    path = write_raw(tmp_path / "in.las", extended=[large[0], small, large[1]])
    cloud = open_cloud(path)
    assert [record.data for record in cloud.records if record.user_id == "trajectory"] == [b"", b""]
    write_cloud(tmp_path / f"out.{suffix}", cloud, None, UTM)
    monkeypatch.undo()
    kept = {record.record_id: record.data for record in open_cloud(tmp_path / f"out.{suffix}").records}
    assert kept[70] == large[0][2]
    assert kept[71] == large[1][2]
    assert kept[9] == b"kept too"
    read = laspy.read(tmp_path / f"out.{suffix}")
    assert {vlr.record_id for vlr in read.evlrs} >= {70, 71}


def test_all_points_are_read_whatever_the_header_counts(tmp_path):
    for stated in (0, 10, 299):
        cloud = open_cloud(write_raw(tmp_path / "in.las", stated=stated))
        assert (cloud.stated_count, cloud.count) == (stated, 300)
        assert len(cloud.to_array()) == 300
        assert len(next(cloud.records_at([290], 20))) == 10
        assert again(cloud, tmp_path / "out.laz").count == 300
    with pytest.raises(InputError, match="truncated or damaged"):
        open_cloud(write_raw(tmp_path / "in.las", stated=301))


def test_a_record_behind_the_points_is_no_points(tmp_path):
    # as long as two points
    cloud = open_cloud(write_raw(tmp_path / "in.las", extended=[(b"other", 1, b"", b"")], stated=10))
    assert cloud.count == 300


def test_the_old_count_is_taken_where_the_new_one_is_zero(tmp_path):
    path = write_raw(tmp_path / "in.las", point_format=1)
    raw = bytearray(path.read_bytes())
    raw[247:255] = bytes(8)
    path.write_bytes(raw)
    laspy_sees = 300
    assert open_cloud(path).count == laspy_sees
    # compressed points cannot be counted without reading them
    write_cloud(tmp_path / "in.laz", open_cloud(path), None, UTM)
    raw = bytearray((tmp_path / "in.laz").read_bytes())
    raw[107:111], raw[247:255] = struct.pack("<I", 300), bytes(8)
    (tmp_path / "in.laz").write_bytes(raw)
    assert open_cloud(tmp_path / "in.laz").count == 300


def test_kinds_that_are_not_supported_are_told_from_damage(tmp_path):
    plain = open_cloud(write_raw(tmp_path / "in.las"))
    write_cloud(tmp_path / "in.laz", plain, None, UTM)
    good = (tmp_path / "in.laz").read_bytes()
    at = good.index(b"laszip encoded") - 2 + 54
    edits = {
        "compressor": (at, struct.pack("<H", 7)),
        "item": (at + 34, struct.pack("<H", 99)),
        "point format": (104, bytes([128 + 17])),
        "version": (25, bytes([9])),
    }
    for name, (place, data) in edits.items():
        raw = bytearray(good)
        raw[place : place + len(data)] = data
        (tmp_path / f"{name}.laz").write_bytes(raw)
        with pytest.raises(InputError, match="not supported here"):
            open_cloud(tmp_path / f"{name}.laz")
    (tmp_path / "cut.laz").write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match="truncated or damaged"):
        open_cloud(tmp_path / "cut.laz").to_array()


def test_the_scale_of_the_helper_is_that_of_the_files(tmp_path):
    assert open_cloud(write_raw(tmp_path / "in.las")).header.scales[0] == SCALE


@pytest.mark.parametrize("axis", range(3))
def test_a_negative_scale_may_mirror_and_is_refused(tmp_path, axis):
    path = tmp_path / "mirrored.las"
    write_cloud(path, ArrayCloud(np.random.default_rng(1).uniform(0, 50, (500, 3))), None, None)
    data = bytearray(path.read_bytes())
    # the scales stand at byte 131 of a header of LAS, as doubles
    at = 131 + 8 * axis
    data[at : at + 8] = struct.pack("<d", -struct.unpack("<d", data[at : at + 8])[0])
    path.write_bytes(data)
    with pytest.raises(InputError, match=f"negative scale in {'xyz'[axis]}"):
        open_cloud(path)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_without_a_byte_is_said_to_be_empty(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"interrupted.{suffix}"
    path.touch()
    with pytest.raises(InputError, match=r"interrupted\..* is empty"):
        open_cloud(path)
