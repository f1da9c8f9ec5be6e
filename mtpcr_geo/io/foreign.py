"""Records of others, carried over to another LAS file, whatever their size and their texts."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import laspy

from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.vlr import Record

_HEAD, _EXTENDED_HEAD = struct.Struct("<2s16sHH32s"), struct.Struct("<2s16sHQ32s")
_EXTENDED_AT = 235  # of the place and number of the extended records
_STAND_IN = b"mtpcr_geo #"
_BLOCK = 1 << 20


def as_vlr(record: Record, number: int) -> laspy.VLR:
    """Return a record for laspy to write; of texts that it cannot write, a stand-in by number.

    `restore_texts` puts these back when the file is written.
    """
    user, description = record.user_id, record.description
    if not (user.isascii() and len(user) < 16 and description.isascii() and len(description) < 32):
        user, description = f"{_STAND_IN.decode()}{number:04d}", ""
    return laspy.VLR(user, record.record_id, description, record.data)


def restore_texts(path: Path, cloud: LasCloud) -> None:
    """Put texts back into a file just written for which there are stand-ins, in UTF-8."""
    with path.open("r+b") as output:
        for place, user in list(_record_heads(output)):
            if not user.startswith(_STAND_IN):
                continue
            record = cloud.records[int(user[len(_STAND_IN) :].rstrip(b"\0"))]
            output.seek(place + 2)
            output.write(_packed(record.user_id, 16))
            # behind the user id stand two bytes of record id, and the size
            output.seek(place + (22 if place < _points_at(output) else 28))
            output.write(_packed(record.description, 32))


def append_large(path: Path, cloud: LasCloud) -> None:
    """Copy the records that are too large to be held behind the LAS 1.4 file just written.

    Raises:
        InputError: if the cloud's file has become shorter since it was opened.

    """
    large = [record for record in cloud.records if record.place is not None and record.is_kept]
    if not large:
        return
    with cloud.path.open("rb") as source, path.open("r+b") as output:
        for record in large:
            place = output.seek(0, 2)
            head = (b"", _packed(record.user_id, 16), record.record_id, record.size)
            output.write(_EXTENDED_HEAD.pack(*head, _packed(record.description, 32)))
            source.seek(record.place or 0)
            left = record.size
            while left > 0:
                block = source.read(min(left, _BLOCK))
                if not block:
                    raise InputError(f"{cloud.name} ends within its records; copy or download it again")
                output.write(block)
                left -= len(block)
            first, count = _extended(output)
            output.seek(_EXTENDED_AT)
            output.write(struct.pack("<QI", first if count else place, count + 1))


def _packed(text: str, size: int) -> bytes:
    """Return a text in so many bytes of UTF-8, padded."""
    return text.encode()[:size].decode(errors="ignore").encode().ljust(size, b"\0")


def _extended(stream: BinaryIO) -> tuple[int, int]:
    stream.seek(_EXTENDED_AT)
    first, count = struct.unpack("<QI", stream.read(12))
    return first, count


def _points_at(stream: BinaryIO) -> int:
    stream.seek(96)
    return int(struct.unpack("<I", stream.read(4))[0])


def _record_heads(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield where each record of a LAS 1.4 file begins, and its user id."""
    stream.seek(94)
    size, _, count = struct.unpack("<HII", stream.read(10))
    for start, number, layout in ((size, count, _HEAD), (*_extended(stream), _EXTENDED_HEAD)):
        place = start
        for _ in range(number):
            stream.seek(place)
            _, user, _, length, _ = layout.unpack(stream.read(layout.size))
            yield place, user
            place += layout.size + length
