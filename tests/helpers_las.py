"""LAS files made byte by byte, so that they can be wrong in ways that no library writes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS

Record = tuple[bytes, int, bytes, bytes]  # user id, record id, content, description

WKT: Record = (b"LASF_Projection", 2112, CRS(25832).to_wkt("WKT1_GDAL").encode() + b"\0", b"")
OFFSET = np.array([500_000.0, 5_200_000.0, 100.0])
SCALE = 0.01
BASE = {0: 20, 1: 28, 3: 34, 6: 30, 7: 36, 8: 38}


def points(count: int = 300) -> np.ndarray:
    """(n, 3) coordinates as the files hold them."""
    whole = np.random.default_rng(5).integers(0, 10_000, (count, 3)) * [1, 1, 0.1]
    return np.rint(whole) * SCALE + OFFSET


def descriptor(kind: int, name: bytes, text: bytes = b"", options: int = 0) -> bytes:
    """One descriptor of an Extra Bytes record."""
    return struct.pack("<2sBB32s4s120x32s", b"", kind, options, name, b"", text)


def geokeys(*entries: tuple[int, int], head: int | None = None) -> Record:
    """A GeoTIFF key directory of keys whose values stand in it."""
    count = len(entries) if head is None else head
    data = struct.pack("<4H", 1, 1, 0, count)
    data += b"".join(struct.pack("<4H", key, 0, int(key > 0), value) for key, value in entries)
    return (b"LASF_Projection", 34735, data, b"")


def write_raw(
    path: Path,
    *,
    point_format: int = 6,
    minor: int = 4,
    records: Sequence[Record] = (WKT,),
    extended: Sequence[Record] = (),
    extra: Callable[[int], bytes] | None = None,
    bounds: np.ndarray | None = None,
    stated: int | None = None,
    count: int = 300,
    encoding: int = 16,
) -> Path:
    """Write a LAS file: of `count` points, stated as so many, with such records and bounds."""
    size = 375 if minor >= 4 else 227
    stated = count if stated is None else stated
    head = b"".join(struct.pack("<H16sHH32s", 0, u, r, len(d), t) + d for u, r, d, t in records)
    xyz = points(count)
    width = BASE[point_format] + (len(extra(0)) if extra else 0)
    body = b""
    for i, row in enumerate(np.rint((xyz - OFFSET) / SCALE).astype(int)):
        if point_format >= 6:
            own = struct.pack("<3iHBBBBhHd", *row, 100, 0x11, 0, 2, 0, 0, 7, float(i))
        else:
            own = struct.pack("<3iHBBbBH", *row, 100, 0x09, 2, 0, 0, 7) + struct.pack("<d", float(i))
        body += own[: BASE[point_format]].ljust(BASE[point_format], b"\0") + (extra(i) if extra else b"")
    low, high = (xyz.min(axis=0), xyz.max(axis=0)) if bounds is None else bounds
    start = size + len(head)
    old = stated if point_format < 6 else 0
    data = b"LASF" + struct.pack(
        "<HH16sBB32s32sHHHIIBHI5I",
        *(3, encoding, b"\1" * 16, 1, minor, b"system", b"software", 10, 2024, size, start),
        *(len(records), point_format, width, old, old, 0, 0, 0, 0),
    )
    box = (high[0], low[0], high[1], low[1], high[2], low[2])
    data += struct.pack("<12d", SCALE, SCALE, SCALE, *OFFSET, *box)
    if minor >= 4:
        behind = start + len(body) if extended else 0
        data += struct.pack("<QQIQ15Q", 0, behind, len(extended), stated, stated, *(0,) * 14)
    tail = b"".join(struct.pack("<H16sHQ32s", 0, u, r, len(d), t) + d for u, r, d, t in extended)
    assert all(len(one) == size for one in [data])
    path.write_bytes(data + head + body + tail)
    return path
