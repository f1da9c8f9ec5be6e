"""Variable length records of LAS files, byte for byte, and the CRS they state."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

from mtpcr_geo.io.geotiff_keys import crs_of_geokeys

if TYPE_CHECKING:
    from pyproj import CRS

WKT_RECORD = 2112
GEOKEYS, GEODOUBLES, GEOASCII = 34735, 34736, 34737
EXTRA_BYTES = ("LASF_Spec", 4)
_CRS_RECORDS = {2111, WKT_RECORD, GEOKEYS, GEODOUBLES, GEOASCII}
# What belongs to how the file was laid out, not to the points: compression, octree.
_LAYOUT_USERS = {"laszip encoded", "copc", "entwine"}
_WAVEFORM_PACKETS = ("LASF_Spec", 65535)


@dataclass(frozen=True)
class Record:
    """One variable length record.

    Attributes:
        user_id: who defined it.
        record_id: which of theirs it is.
        description: up to 32 bytes of text.
        data: its content.
        extended: True if it stood behind the points.
        place: byte of the file at which the content begins, where it is too large to be held; else None.
        size: bytes of the content, held or not.

    """

    user_id: str
    record_id: int
    description: str
    data: bytes
    extended: bool = False
    place: int | None = None
    size: int = 0

    @property
    def states_crs(self) -> bool:
        """Return whether the record is one of those that state the coordinate reference system."""
        return self.record_id in _CRS_RECORDS and self.user_id in ("LASF_Projection", "liblas")

    @property
    def is_kept(self) -> bool:
        """Return whether the record still holds for the same points in another file and place."""
        key = (self.user_id, self.record_id)
        layout = self.user_id in _LAYOUT_USERS or key in (_WAVEFORM_PACKETS, EXTRA_BYTES)
        return not (self.states_crs or layout)


def read_records(
    stream: BinaryIO, start: int, count: int, extended: bool, limit: int = 16_000_000
) -> list[Record]:
    """Read `count` records from byte `start`; of those larger than `limit` bytes only the head is held.

    Args:
        stream: the open file.
        start: where the first record begins.
        count: how many follow each other.
        extended: whether they are the 60 byte kind behind the points, or the 54 byte kind before them.
        limit: waveforms, octree hierarchies and others can be as large as the points.

    Raises:
        ValueError: if the file ends before they do.

    """
    layout = struct.Struct("<2x16sHQ32s" if extended else "<2x16sHH32s")
    records = []
    end = stream.seek(0, 2)
    stream.seek(start)
    for _ in range(count):
        head = stream.read(layout.size)
        if len(head) < layout.size:
            raise ValueError("the file ends within its variable length records")
        user, record_id, size, description = layout.unpack(head)
        place = stream.tell()
        if place + size > end:
            raise ValueError("the file ends within its variable length records")
        large = size > limit
        data = b"" if large else stream.read(size)
        stream.seek(place + size)
        records.append(
            Record(
                text_of(user), record_id, text_of(description), data, extended, place if large else None, size
            )
        )
    return records


def text_of(raw: bytes) -> str:
    """Return a padded text of a header or record: UTF-8, or Latin-1 as older programs write it."""
    text = raw.split(b"\0")[0]
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def crs_of_records(records: Sequence[Record]) -> tuple[CRS | None, str]:
    """Return the CRS that the records state.

    WKT comes before GeoTIFF keys; a record behind the points counts like one before them.

    Returns:
        The CRS, or None; and what of it cannot be used, or why there is None ("" if the file states nothing).

    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    problem = ""
    for record in records:
        if (record.user_id, record.record_id) == ("LASF_Projection", WKT_RECORD):
            wkt = record.data.decode("utf-8", errors="replace").rstrip("\0 \n\r\t")
            if not wkt:
                continue
            try:
                return CRS.from_wkt(wkt), ""
            except CRSError as error:
                problem = f"its WKT cannot be understood ({_first_line(error)})"
    parts = {record.record_id: record.data for record in records if record.states_crs}
    if GEOKEYS in parts:
        try:
            crs, part = crs_of_geokeys(parts[GEOKEYS], parts.get(GEODOUBLES, b""), parts.get(GEOASCII, b""))
        except ValueError as error:
            return None, problem or f"its GeoTIFF keys cannot be understood ({_first_line(error)})"
        if crs is not None:
            return crs, part
        problem = problem or "its GeoTIFF keys name no coordinate reference system"
    return None, problem


def _first_line(error: Exception) -> str:
    text = str(error).splitlines()
    return text[0][:120] if text else type(error).__name__
