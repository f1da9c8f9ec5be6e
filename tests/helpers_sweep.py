"""LAS files of every kind that can be made, byte by byte and without a library, moved there and back.

``python tests/helpers_sweep.py TABLE.md`` writes what was tried and what came of it.
"""

from __future__ import annotations

import itertools
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lazrs
import numpy as np
from pyproj import CRS, Transformer

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.crs import resolve_frames
from mtpcr_geo.crs.facts import same_place
from mtpcr_geo.export.apply import apply_transform
from mtpcr_geo.export.transform import write_transform_json
from mtpcr_geo.io import ArrayCloud
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud

UTM = CRS.from_epsg(25832)
PLACE = np.array([500_000.0, 5_200_000.0, 100.0])
COUNT = 150

_OLD = [("X", "i4"), ("Y", "i4"), ("Z", "i4"), ("intensity", "u2"), ("bits", "u1"), ("class", "u1")]
_OLD += [("rank", "i1"), ("user_data", "u1"), ("point_source_id", "u2")]
_NEW = [("X", "i4"), ("Y", "i4"), ("Z", "i4"), ("intensity", "u2"), ("bits", "u1"), ("flags", "u1")]
_NEW += [("class", "u1"), ("user_data", "u1"), ("angle", "i2"), ("point_source_id", "u2"), ("gps_time", "f8")]
_TIME, _NIR = [("gps_time", "f8")], [("nir", "u2")]
_RGB = [("red", "u2"), ("green", "u2"), ("blue", "u2")]
_WAVE = [("w_index", "u1"), ("w_offset", "u8"), ("w_size", "u4"), ("w_place", "f4")]
BEAMS = ("w_x", "w_y", "w_z")
"""Directions of waveforms, which turn with the points."""
_WAVE += [("w_x", "f4"), ("w_y", "f4"), ("w_z", "f4")]
FIELDS = {
    0: _OLD, 1: _OLD + _TIME, 2: _OLD + _RGB, 3: _OLD + _TIME + _RGB, 4: _OLD + _TIME + _WAVE,
    5: _OLD + _TIME + _RGB + _WAVE, 6: _NEW, 7: _NEW + _RGB, 8: _NEW + _RGB + _NIR, 9: _NEW + _WAVE,
    10: _NEW + _RGB + _NIR + _WAVE,
}  # fmt: skip
"""Fields of each point format, by the LAS specification 1.4 R15, sections 2.6.1 to 2.6.11."""
WRITTEN_AS = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10, **{i: i for i in range(6, 11)}}
FIRST_VERSION = {0: 0, 1: 0, 2: 2, 3: 2, 4: 3, 5: 3, **dict.fromkeys(range(6, 11), 4)}
WAVEFORMS = (4, 5, 9, 10)

_TYPES = ["", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]
Record = tuple[bytes, int, bytes, bytes]  # user id, record id, content, description


@dataclass(frozen=True)
class Kind:
    """One kind of file.

    Attributes:
        name: what is special about it.
        point_format, minor: point format and version 1.x.
        scale, offset: (3,) of its coordinates, in units of its CRS.
        crs: it.
        geokeys: code that GeoTIFF keys state instead of WKT.
        extra: fields of its extra bytes, with their descriptors.
        records, extended: records before and behind its points.
        header_pad, gap: bytes of the user behind the header, and before the points.
        encoding: bits of the global encoding beside that of the WKT.
        packets: waveforms in the file.
        steps: highest integer of coordinates.

    """

    name: str
    point_format: int = 6
    minor: int = 4
    scale: tuple[float, float, float] = (0.01, 0.01, 0.01)
    offset: tuple[float, float, float] = (500_000.0, 5_200_000.0, 100.0)
    crs: CRS = UTM
    geokeys: int = 0
    extra: tuple[tuple[str, Any, bytes], ...] = ()
    records: tuple[Record, ...] = ()
    extended: tuple[Record, ...] = ()
    header_pad: bytes = b""
    gap: bytes = b""
    encoding: int = 0
    packets: bytes = b""
    steps: int = 10_000
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class Row:
    """What came of one kind: "kept", a refusal, or what was lost."""

    kind: str
    suffix: str
    result: str = "kept"
    lost: list[str] = field(default_factory=list)


def descriptor(number: int, name: bytes, options: int = 0, **values: float) -> bytes:
    """Return a descriptor of one extra dimension, 192 bytes; type 0 has its width in the options."""
    kind = "<q" if 1 <= number <= 10 and _TYPES[number][0] in "ui" else "<d"
    parts = []
    for key, bit in (("no_data", 1), ("min", 2), ("max", 4), ("scale", 8), ("offset", 16)):
        one = "<d" if key in ("scale", "offset") else kind
        number_type: Callable[[float], Any] = float if one == "<d" else int
        packed = struct.pack(one, number_type(values.get(key, 0))).ljust(24, b"\0")
        options |= bit if key in values else 0
        parts.append(packed)
    return (
        struct.pack("<2sBB32s4s", b"", number, options, name, b"")
        + b"".join(parts)
        + b"about it".ljust(32, b"\0")
    )


def write(path: Path, kind: Kind, seed: int = 0) -> np.ndarray:
    """Write a file of a kind by the specification; return its points as they are stored, (n,)."""
    rng = np.random.default_rng(seed)
    names = [(name, f"<{one}" if isinstance(one, str) else one) for name, one in FIELDS[kind.point_format]]
    names += [(name, one) for name, one, _ in kind.extra]
    points = np.zeros(COUNT, names)
    points = np.frombuffer(rng.bytes(points.nbytes), points.dtype).copy()  # any bits at all
    for axis, centre in zip("XYZ", kind.centre, strict=True):
        points[axis] = int(centre) + rng.integers(-kind.steps, kind.steps, COUNT, endpoint=True)
    points["point_source_id"] = rng.permutation(COUNT)
    for name, one in names:  # of floats any bits are many that are no numbers
        base = np.dtype(one).base
        if base.kind == "f":
            points[name] = rng.normal(size=points[name].shape) * 1e3
    if "gps_time" in (points.dtype.names or ()):
        points["gps_time"] = np.arange(COUNT) * 1.25 + 0.1
    if "flags" in (points.dtype.names or ()) and kind.point_format in WAVEFORMS:
        points["flags"] &= 0b1100_1111
    size = 375 if kind.minor >= 4 else 235 if kind.minor == 3 else 227
    records = [*kind.records]
    if kind.geokeys:
        records.append(_geokeys(kind.geokeys))
    else:
        wkt = kind.crs.to_wkt("WKT2_2019")
        records.append((b"LASF_Projection", 2112, wkt.encode() + b"\0", b""))
    described = b"".join(one for _, _, one in kind.extra)
    if described:
        records.append((b"LASF_Spec", 4, described, b""))
    head = b"".join(struct.pack("<H16sHH32s", 0, u, r, len(d), t) + d for u, r, d, t in records)
    body = points.tobytes()
    start = size + len(kind.header_pad) + len(head) + len(kind.gap)
    old_count = COUNT if kind.point_format < 6 else 0
    encoding = kind.encoding | (0 if kind.geokeys else 16) | (2 if kind.packets else 0)
    data = b"LASF" + struct.pack(
        "<HH16sBB32s32sHHHIIBHI5I",
        *(7, encoding, bytes(range(16)), 1, kind.minor, b"system", b"software", 10, 2024),
        *(size + len(kind.header_pad), start, len(records), kind.point_format, points.dtype.itemsize),
        *(old_count, old_count, 0, 0, 0, 0),
    )
    xyz = np.column_stack([points[axis] for axis in "XYZ"]) * np.array(kind.scale) + kind.offset
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    data += struct.pack("<12d", *kind.scale, *kind.offset, *np.column_stack([high, low]).ravel())
    extended = [*kind.extended]
    waves = (b"LASF_Spec", 65535, kind.packets, b"waveforms")
    tail = b"".join(struct.pack("<H16sHQ32s", 0, u, r, len(d), t) + d for u, r, d, t in extended)
    behind = start + len(body)
    wave_place = behind + len(tail) if kind.packets else 0
    if kind.packets:
        u, r, d, t = waves
        tail += struct.pack("<H16sHQ32s", 0, u, r, len(d), t) + d
    if kind.minor >= 3:
        data += struct.pack("<Q", wave_place)
    if kind.minor >= 4:
        number = len(extended) + bool(kind.packets)
        data += struct.pack("<QIQ15Q", behind if number else 0, number, COUNT, COUNT, *(0,) * 14)
    assert len(data) == size, (len(data), size)
    path.write_bytes(data + kind.header_pad + head + kind.gap + body + tail)
    return points


def _geokeys(code: int) -> Record:
    return (b"LASF_Projection", 34735, struct.pack("<12H", 1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, code), b"")


def modern(points: np.ndarray) -> dict[str, np.ndarray]:
    """Return what points of any format must be in formats 6-10, by the specification; without coordinates."""
    fields = {name: points[name] for name in points.dtype.names or () if name not in "XYZ"}
    if "rank" not in fields:
        return fields
    bits, raw = fields.pop("bits"), fields.pop("class")
    fields["angle"] = np.rint(fields.pop("rank") / 0.006).astype(np.int16)
    fields["class"] = raw & 31
    fields["bits"] = (bits & 7) | ((bits >> 3 & 7) << 4)
    overlap = np.where(raw & 31 == 12, 8, 0).astype(np.uint8)
    fields["flags"] = (raw >> 5 & 7) | (bits & 0b1100_0000) | overlap
    return fields


@dataclass(frozen=True)
class Stored:
    """What stands in a LAS 1.4, LAZ or COPC file, read byte by byte.

    Attributes:
        head: its public header.
        points: (n,) in the order of the point source ids.
        records: user id, record id, content and description of each, before and behind the points.

    """

    head: bytes
    points: np.ndarray
    records: tuple[Record, ...]

    def at(self, layout: str, place: int) -> Any:
        """Return what stands at a byte of the header."""
        values = struct.unpack_from(layout, self.head, place)
        return values[0] if len(values) == 1 else values

    @property
    def foreign(self) -> set[Record]:
        """Return the records that are neither about the CRS nor the layout."""
        own = {(b"LASF_Projection", i) for i in (2111, 2112, 34735, 34736, 34737)}
        own |= {(b"LASF_Spec", 4), (b"LASF_Spec", 65535)}
        return {
            one
            for one in self.records
            if (one[0], one[1]) not in own and one[0] not in (b"copc", b"laszip encoded")
        }


def read(path: Path, extra: tuple[tuple[str, Any, bytes], ...]) -> Stored:
    """Read a file by the specification; lazrs decompresses LAZ."""
    data = path.read_bytes()
    size, start, count = struct.unpack_from("<HII", data, 94)
    first, extended, points = struct.unpack_from("<QIQ", data, 235)
    records = []
    for place, number, head in ((size, count, "<2x16sHH32s"), (first, extended, "<2x16sHQ32s")):
        for _ in range(number):
            user, record, length, text = struct.unpack_from(head, data, place)
            place += struct.calcsize(head)
            records.append((user.rstrip(b"\0"), record, data[place : place + length], text.rstrip(b"\0")))
            place += length
    dtype = np.dtype(
        [(name, f"<{one}" if isinstance(one, str) else one) for name, one in FIELDS[data[104] & 63]]
        + [(name, one) for name, one, _ in extra]
    )
    width = struct.unpack_from("<H", data, 105)[0]
    assert width == dtype.itemsize, (width, dtype.itemsize)
    body: bytes | bytearray = data[start:]
    if data[104] & 128:
        (laszip,) = [one[2] for one in records if one[0] == b"laszip encoded"]
        body = bytearray(points * width)
        with path.open("rb") as stream:
            stream.seek(start)
            lazrs.LasZipDecompressor(stream, laszip).decompress_many(body)
    array = np.frombuffer(bytes(body[: points * width]), dtype)
    array = array[np.argsort(array["point_source_id"], kind="stable")]
    return Stored(data[:size], array, tuple(records))


def pair_at(crs: CRS, middle: np.ndarray, span: np.ndarray) -> Pair:
    """Return a solved pair of two clouds at a place, whose transform turns, tilts and shifts."""
    rng = np.random.default_rng(1)
    clouds = [ArrayCloud(middle + rng.uniform(-0.5, 0.5, (40, 3)) * span, crs) for _ in range(2)]
    frame, target, source = resolve_frames(*clouds)
    sides = [
        Side("target", clouds[0], target, target.to_work(clouds[0].xyz)),
        Side("source", clouds[1], source, source.to_work(clouds[1].xyz)),
    ]
    T = transforms.compose(
        transforms.yaw_matrix(0.6) @ transforms.tilt_matrix(0.2, 0.03), np.array([11.5, -6.25, 1.75])
    )
    return Pair(target=sides[0], source=sides[1], frame=frame, T_target_source=T)


def _lost_beams(first: Any, moved: np.ndarray, back: np.ndarray) -> list[str]:
    """Return the directions of waveforms that were not turned there and back, but for single precision."""
    if "w_x" not in first:
        return []
    there, between, again = (
        np.array([one[name] for name in BEAMS], np.float64) for one in (first, moved, back)
    )
    far = np.abs(there).max() + np.abs(between).max()
    lost = [name for name, a, b in zip(BEAMS, there, again, strict=True) if np.abs(a - b).max() > 1e-6 * far]
    return lost if np.abs(there - between).max() > 0.1 * np.abs(there).max() else [*lost, "w_x, not turned"]


def try_kind(kind: Kind, suffix: str, folder: Path) -> Row:
    """Write a file of a kind, move it, move it back, and compare all that it holds; return what was lost."""
    row = Row(f"1.{kind.minor} format {kind.point_format}: {kind.name}", suffix)
    first, moved, back = (folder / f"{name}{suffix}" for name in ("first", "moved", "back"))
    raw = folder / "raw.las"
    points = write(raw, kind)
    if suffix == ".las":
        first = raw
    else:
        if suffix == ".copc.laz" and kind.point_format in WAVEFORMS:
            row.result = "no such file"
            return row
        write_cloud(first, open_cloud(raw), None, kind.crs, kind.scale)
    xyz = np.column_stack([points[axis] for axis in "XYZ"]) * np.array(kind.scale) + kind.offset
    transform = folder / "t.json"
    write_transform_json(transform, pair_at(kind.crs, xyz.mean(axis=0), np.ptp(xyz, axis=0)))
    said: list[str] = []
    try:
        apply_transform(transform, first, moved, say=said.append)
        apply_transform(transform, moved, back, inverse=True, say=said.append)
    except OutputError as error:
        row.result = f"refused: {error}"
        return row
    row.lost += said
    expected = modern(points[np.argsort(points["point_source_id"])])
    wanted = {(u, r, d, t[:32].rstrip(b"\0")) for u, r, d, t in (*kind.records, *kind.extended)}
    described = b"".join(one for _, _, one in kind.extra)
    for path in (moved, back):
        found, where = read(path, kind.extra), path.stem
        if (found.head[24:26], found.head[104] & 63) != (b"\1\4", WRITTEN_AS[kind.point_format]):
            row.lost.append(f"{where}: version or point format")
        row.lost += [
            f"{where}: {name}"
            for name, one in expected.items()
            if name not in BEAMS and found.points[name].tobytes() != np.ascontiguousarray(one).tobytes()
        ]
        row.lost += [f"{where}: record {one[0]!r} {one[1]}" for one in sorted(wanted - found.foreign)]
        if (found.at("<H", 4), found.at("16s", 8)) != (7, bytes(range(16))):
            row.lost.append(f"{where}: identifiers")
        if kind.packets:
            start = found.at("<Q", 227)
            if path.read_bytes()[start + 60 : start + 60 + len(kind.packets)] != kind.packets:
                row.lost.append(f"{where}: waveforms")
        if kind.encoding & ~found.at("<H", 6):
            row.lost.append(f"{where}: global encoding")
        if described not in [d for u, r, d, _ in found.records if (u, r) == (b"LASF_Spec", 4)] + [b""]:
            row.lost.append(f"{where}: descriptors of extra bytes")
        crs = open_cloud(path).crs
        if crs is None or not same_place(crs, kind.crs):
            row.lost.append(f"{where}: CRS {crs.name if crs is not None else None}")
    found = read(back, kind.extra)
    row.lost += [
        f"back: {name}" for name in _lost_beams(expected, read(moved, kind.extra).points, found.points)
    ]
    again = np.column_stack([found.points[axis] for axis in "XYZ"]) * found.at("<3d", 131)
    again += found.at("<3d", 155)
    there = xyz[np.argsort(points["point_source_id"])]
    # half a step of the file, unless its range only bears coarser steps once it is turned
    steps = np.maximum(found.at("<3d", 131), read(moved, kind.extra).at("<3d", 131))
    turned = np.array([*(steps[:2].max(),) * 2, steps.max()])
    limit = np.maximum(np.array(kind.scale) / 2, 1.5 * turned)
    if kind.steps * 1.5 < 2**31 / 10 and not kind.crs.is_geographic:
        finest = max(min(kind.scale) / 10, 1e-5)
        if steps.max() > max(finest, max(kind.scale) / 10) * 1.0001:
            row.lost.append(f"coarser steps than need be: {steps}")
    worst = np.abs(again - there).max(axis=0)
    if (worst > limit * 1.0001).any():
        row.lost.append(f"coordinates come back to {worst} where {limit} is wanted")
    if row.lost:
        row.result = "lost"
    return row


VLRS: tuple[Record, ...] = (
    (b"maker", 1, b"calibration", b"of the maker"),
    (b"maker", 2, b"", b"empty"),
    (b"maker", 1, b"again", b"same id"),
    (b"LASF_Spec", 0, bytes(range(16)) * 3, b"classification lookup"),
    (b"LASF_Spec", 3, b"text area\0", b"text"),
    (b"LASF_Spec", 7, b"superseded", b"superseded"),
    (b"0123456789abcdef", 65_000, bytes(65_535), b"the longest there is, and no zero"),
)
EVLRS: tuple[Record, ...] = (
    (b"maker", 100, bytes(range(256)) * 300, b"longer than any VLR"),
    (b"maker", 101, b"short", b""),
    (b"maker", 102, b"", b"empty"),
)


def _extra_kinds() -> Iterator[Kind]:
    for number in range(1, 31):
        base = _TYPES[(number - 1) % 10 + 1]
        width = (number - 1) // 10 + 1
        kind: Any = f"<{base}" if width == 1 else (f"<{base}", (width,))
        yield Kind(f"extra bytes of type {number}", extra=(("extra", kind, descriptor(number, b"extra")),))
    for width in (1, 3, 17):
        raw = (("extra", ("u1", (width,)), descriptor(0, b"extra", width)),)
        yield Kind(f"extra bytes of no type, {width} bytes", extra=raw)
    values = {"no_data": -9.0, "min": -100.0, "max": 100.0, "scale": 0.01, "offset": 5.0}
    every = tuple(
        (f"e{number}", f"<{_TYPES[number]}", descriptor(number, b"e%d" % number, 0, **values))
        for number in (2, 4, 6, 8, 9, 10)
    )
    for point_format in (1, 3, 6, 8, 9):
        yield Kind("extra bytes with scale, offset, range and no data", point_format, extra=every)


def kinds() -> Iterator[Kind]:
    """Yield all kinds: formats and versions, scales, extra bytes, records, waveforms, user's bytes, CRSs."""
    for point_format, minor in itertools.product(range(11), range(5)):
        if minor >= FIRST_VERSION[point_format]:
            yield Kind("all bits of all dimensions", point_format, minor)
            if point_format < 6:
                yield Kind("CRS by GeoTIFF keys", point_format, minor, geokeys=25832)
            yield Kind("bytes of the user behind header and records", point_format, minor,
                       header_pad=b"user" * 5, gap=b"\xcc\xddmore")  # fmt: skip
            yield Kind("records", point_format, minor, records=VLRS)
    yield from _extra_kinds()
    for point_format in (1, 3, 6, 7, 8):
        yield Kind("records behind the points", point_format, extended=EVLRS, records=VLRS)
    for scale in (1e-6, 1e-5, 1e-4, 1e-3, 0.1, 1.0, 0.3048, 1 / 3, 0.0254):
        steps = int(min(2**31 - 2, 2_000 / scale))
        yield Kind(f"scale {scale:.3g}", scale=(scale,) * 3, steps=steps)
    yield Kind("a scale for each axis", scale=(0.01, 0.001, 0.25))
    yield Kind("all of the integers", scale=(1e-5, 1e-5, 1e-5), steps=2**31 - 1)
    yield Kind("all of the integers in millimetres", scale=(1e-3, 1e-3, 1e-5), steps=2**27)
    yield Kind("offset zero", offset=(0.0, 0.0, 0.0), scale=(0.01,) * 3, centre=(5e7, 5.2e8, 1e4))
    yield Kind("an odd offset", offset=(499_999.123456, 5_200_000.987654, -3.3333))
    for bits, name in ((1, "standard time"), (8, "synthetic returns"), (9, "both")):
        yield Kind(f"global encoding: {name}", encoding=bits)
    for point_format, minor in ((4, 3), (5, 3), (4, 4), (5, 4), (9, 4), (10, 4)):
        yield Kind("waveforms in a file of their own", point_format, minor, encoding=4,
                   records=((b"LASF_Spec", 101, bytes(26), b"packets"),))  # fmt: skip
        if minor == 4:
            yield Kind("waveforms in the file", point_format, minor, packets=bytes(range(256)) * 5,
                       records=((b"LASF_Spec", 101, bytes(26), b"packets"),))  # fmt: skip
    yield from _crs_kinds()


_PLACES: dict[str, tuple[float, float]] = {
    "EPSG:25832+7837": (9.0, 47.0), "EPSG:2994": (-122.0, 44.0), "EPSG:2994+6360": (-122.0, 44.0),
    "EPSG:2225": (-121.0, 40.0), "EPSG:2154+5720": (2.0, 47.0), "EPSG:28992+5709": (5.0, 52.0),
    "EPSG:5514": (15.0, 50.0), "EPSG:2193": (174.0, -41.0), "EPSG:3031": (10.0, -75.0),
    "EPSG:27700": (-2.0, 53.0), "EPSG:2056+5728": (8.0, 47.0), "EPSG:6341+5703": (-111.0, 34.0),
    "EPSG:4326": (9.0, 47.0), "EPSG:4979": (9.0, 47.0), "EPSG:4269+5703": (-105.0, 40.0),
    "EPSG:4978": (9.0, 47.0), "EPSG:3857": (9.0, 47.0), "EPSG:32761": (0.0, -80.0),
    "+proj=tmerc +lat_0=47 +lon_0=9 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m": (9.0, 47.0),
    "+proj=omerc +lat_0=47 +lonc=9 +alpha=30 +gamma=10 +k=1 +ellps=GRS80 +units=us-ft": (9.0, 47.0),
    "+proj=laea +lat_0=47 +lon_0=9 +datum=WGS84 +units=m +vunits=us-ft": (9.0, 47.0),
}  # fmt: skip


def _crs_kinds() -> Iterator[Kind]:
    for text, (lon, lat) in _PLACES.items():
        crs = CRS.from_user_input(text)
        flat = CRS.from_epsg(4979)
        middle = np.array(Transformer.from_crs(flat, crs, always_xy=True).transform(lon, lat, 300.0))
        geographic = crs.is_geographic
        scale = (1e-8, 1e-8, 0.001) if geographic else (0.001, 0.001, 0.001)
        steps = 100_000 if not crs.is_geocentric else 20_000
        x, y, z = (np.rint(middle * 10) / 10).tolist()
        yield Kind(f"CRS {text}", crs=crs, scale=scale, offset=(x, y, z), steps=steps)


def main(out: Path) -> int:
    """Try all kinds in LAS, LAZ and COPC; write a table, and return how many lost something."""
    rows = []
    for kind in kinds():
        for suffix in (".las", ".laz", ".copc.laz"):
            with tempfile.TemporaryDirectory() as folder:
                rows.append(try_kind(kind, suffix, Path(folder)))
    lines = ["| kind | file | result |", "|---|---|---|"]
    lines += [f"| {r.kind} | {r.suffix} | {' '.join([r.result, '; '.join(r.lost)]).strip()} |" for r in rows]
    out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return sum(row.result == "lost" for row in rows)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
