"""The extra dimensions of LAS points: their descriptors, read whatever old programs made of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import laspy
from laspy.vlrs.known import ExtraBytesVlr

from mtpcr_geo.io.vlr import EXTRA_BYTES, Record, text_of

DESCRIPTOR = 192  # bytes of each
_NAME, _DESCRIPTION = slice(4, 36), slice(160, 192)
_DATA_TYPES = 30  # the last one that LAS 1.3 and 1.4 know
_REST = "ExtraBytes"


@dataclass(frozen=True)
class ExtraBytes:
    """The extra dimensions of a file.

    Attributes:
        descriptors: of each named dimension, 192 bytes as they are written again: names in UTF-8, each once.
        rest: bytes of a point behind those that no descriptor names.
        remarks: what had to be settled, a sentence each.

    """

    descriptors: tuple[bytes, ...] = ()
    rest: int = 0
    remarks: tuple[str, ...] = ()

    @classmethod
    def of(cls, records: Sequence[Record], point_format: int, size: int) -> ExtraBytes:
        """Read the descriptors of all records that have some, as far as the points have bytes for them.

        Args:
            records: of the file, before and behind the points.
            point_format: whose own dimensions are taken already.
            size: extra bytes of a point.

        """
        taken = {dimension.name.lower() for dimension in laspy.PointFormat(point_format).dimensions}
        kept: list[bytes] = []
        remarks: list[str] = []
        left, beyond = size, 0
        for raw in _descriptors(records):
            width = _width(raw)
            if beyond or not 0 < width <= left:
                beyond += 1
                continue
            left -= width
            name = text_of(raw[_NAME])
            unique = _unique(name, taken)
            if unique != name:
                remarks.append(
                    f"its extra dimension {name!r} is called {unique!r}: the name was taken or empty"
                )
            taken.add(unique.lower())
            kept.append(_described(raw, unique))
        if beyond:
            remarks.append(f"{beyond} of its extra dimensions have no bytes in the points, and are left out")
        return cls(tuple(kept), left, tuple(remarks))

    @property
    def data(self) -> bytes:
        """The content of the one record that describes them all."""
        return b"".join(self.descriptors)

    def add_to(self, point_format: laspy.PointFormat) -> None:
        """Add the dimensions to a point format."""
        for raw in self.descriptors:
            if raw[2] == 0:
                # its options are its width, and laspy would read them as the bits of other types
                name, text = (text_of(raw[part]) for part in (_NAME, _DESCRIPTION))
                point_format.dimensions.append(_bytes(name, raw[3], text))
                continue
            known = ExtraBytesVlr()
            known.parse_record_data(raw)
            for dimension in known.type_of_extra_dims():
                point_format.add_extra_dimension(dimension)
        if self.rest:
            taken = {dimension.name.lower() for dimension in point_format.dimensions}
            point_format.dimensions.append(
                _bytes(_unique(_REST, taken), self.rest, "bytes without a descriptor")
            )


def _bytes(name: str, width: int, description: str) -> laspy.point.dims.DimensionInfo:
    """Return a dimension of so many bytes that are no number."""
    return laspy.point.dims.DimensionInfo(
        name=name,
        kind=laspy.point.dims.DimensionKind.UnsignedInteger,
        num_bits=8 * width,
        num_elements=width,
        is_standard=False,
        description=description,
    )


def _descriptors(records: Sequence[Record]) -> Iterator[bytes]:
    for record in records:
        if (record.user_id, record.record_id) == EXTRA_BYTES:
            for start in range(0, len(record.data) - DESCRIPTOR + 1, DESCRIPTOR):
                yield record.data[start : start + DESCRIPTOR]


def _width(raw: bytes) -> int:
    """Return the bytes of a dimension in a point; 0 where its type is none."""
    kind, options = raw[2], raw[3]
    if kind == 0:
        return options
    if kind > _DATA_TYPES:
        return 0
    sizes = (1, 1, 2, 2, 4, 4, 8, 8, 4, 8)
    return sizes[(kind - 1) % 10] * (1 + (kind - 1) // 10)


def _unique(name: str, taken: set[str]) -> str:
    """Return the name, or with a number behind it the first that is not taken; at most 31 bytes."""
    base, number = name or "extra", 2 if name else 1
    unique = name
    while not unique or unique.lower() in taken:
        tail = f"_{number}"
        unique = _cut(base, 31 - len(tail)) + tail
        number += 1
    return unique


def _described(raw: bytes, name: str) -> bytes:
    """Return a descriptor under that name, itself where it says so already."""
    new = bytearray(raw)
    if text_of(raw[_NAME]) != name or not _is_utf8(raw[_NAME]):
        new[_NAME] = _cut(name, 32).encode().ljust(32, b"\0")
    if not _is_utf8(raw[_DESCRIPTION]):
        new[_DESCRIPTION] = _cut(text_of(raw[_DESCRIPTION]), 32).encode().ljust(32, b"\0")
    return bytes(new)


def _is_utf8(raw: bytes) -> bool:
    try:
        # as it will be read: with all that stands before the padding
        raw.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        return False
    return b"\0" not in raw.rstrip(b"\0")


def _cut(text: str, most: int) -> str:
    """Shorten a text to so many bytes of UTF-8."""
    return text.encode()[:most].decode(errors="ignore")
