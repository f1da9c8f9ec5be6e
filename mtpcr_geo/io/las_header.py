"""The head of a LAS file: its header, its records, and how many points there really are.

laspy reads the public header and the points; records and extra dimensions are read here, since files whose
texts are no UTF-8, whose names stand twice or whose descriptors lie behind the points are sound otherwise.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import lazrs

from mtpcr_geo.io.extra_bytes import ExtraBytes
from mtpcr_geo.io.vlr import Record, read_records

LASZIP = "laszip encoded"
_RECORD_HEAD = 54
_VERSIONS = [(1, minor) for minor in range(5)]
_LEGACY_COUNT, _EXTENDED = 107, 235
_CHUNK_MOST = 10_000_000  # points that a chunk may promise beyond those of the file
# of the point, and of colours, infrared and wave packets where the format has them
_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}


class Head:
    """What stands before the points.

    Attributes:
        header: laspy's, without names of extra dimensions, and with no records but the compression's.
        records: all variable length records, before and behind the points.
        extra: the extra dimensions.
        point_format: laspy's, with the extra dimensions.
        stated_count: the number of points that the header states.
        count: the number of points that there are.
        raw: the bytes before the points, as laspy can read them.

    """

    def __init__(self, stream: BinaryIO) -> None:
        """Read the head of an open file.

        Raises:
            ValueError, laspy.errors.LaspyException, lazrs.LazrsError: if it is damaged or not supported.

        """
        size, start, count = _check_head(stream)
        self.records = read_records(stream, size, count, extended=False)
        self.raw = _plain_head(stream, size, start, self.records)
        self.header = laspy.LasHeader.read_from(io.BytesIO(self.raw))
        header = self.header
        if header.version.minor >= 4 and header.number_of_evlrs:
            self.records += read_records(
                stream, header.start_of_first_evlr, header.number_of_evlrs, extended=True
            )
        own = laspy.PointFormat(header.point_format.id)
        self.extra = ExtraBytes.of(self.records, own.id, header.point_format.size - own.size)
        self.extra.add_to(own)
        own.dtype()
        self.point_format = own
        self.stated_count = int(header.point_count)
        self.count = _count(stream, header, self.raw)
        _check_chunk_table(stream, header, self.count, self.records)


class Overlaid(io.RawIOBase):
    """A file whose first bytes are replaced by others.

    Args:
        path: the file.
        head: what stands in place of its first bytes.

    """

    def __init__(self, path: Path, head: bytes) -> None:
        self._stream = path.open("rb")
        self._head = head
        self._place = 0

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def seekable(self) -> bool:
        """Return that it can be searched."""
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a byte."""
        if whence == io.SEEK_CUR:
            offset += self._place
        elif whence == io.SEEK_END:
            offset = self._stream.seek(offset, io.SEEK_END)
        self._place = offset
        return offset

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from where the last read ended."""
        view = memoryview(buffer).cast("B")
        if self._place < len(self._head):
            part = self._head[self._place : self._place + len(view)]
            view[: len(part)] = part
            read = len(part)
        else:
            self._stream.seek(self._place)
            read = self._stream.readinto(view)
        self._place += read
        return read

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        super().close()


def _check_head(stream: BinaryIO) -> tuple[int, int, int]:
    """Return the size of the header, where the points begin, and the number of records before them.

    Raises:
        ValueError: if the file cannot hold what they promise.
        laspy.errors.FileVersionNotSupported: if it is of another version of LAS.

    """
    size = stream.seek(0, 2)
    stream.seek(24)
    major, minor = stream.read(2)
    if (major, minor) not in _VERSIONS:
        raise laspy.errors.FileVersionNotSupported(f"LAS version {major}.{minor}")
    stream.seek(94)
    header_size, points, records = struct.unpack("<HII", stream.read(10))
    if not 227 <= header_size <= points <= size or records * _RECORD_HEAD > points - header_size:
        raise ValueError("its header contradicts its size")
    return header_size, points, records


def _plain_head(stream: BinaryIO, size: int, start: int, records: list[Record]) -> bytes:
    """Return the bytes before the points with no record in them but the one about compression."""
    stream.seek(0)
    raw = bytearray(stream.read(size))
    kept = [record for record in records if record.user_id == LASZIP][:1]
    struct.pack_into("<I", raw, 100, len(kept))
    minor = raw[25]
    if minor >= 4 and size >= 255:
        (count,) = struct.unpack_from("<Q", raw, 247)
        (legacy,) = struct.unpack_from("<I", raw, _LEGACY_COUNT)
        if count == 0 and legacy:
            struct.pack_into("<Q", raw, 247, legacy)
    for record in kept:
        raw += struct.pack("<2x16sHH32x", record.user_id.encode(), record.record_id, len(record.data))
        raw += record.data
    if len(raw) > start:
        raise ValueError("its header contradicts its size")
    return bytes(raw).ljust(start, b"\0")


def _count(stream: BinaryIO, header: laspy.LasHeader, raw: bytes) -> int:
    """Return how many points there are: of an uncompressed file, as many as there are bytes of them.

    Raises:
        ValueError: if there are fewer than the header promises.

    """
    count = int(header.point_count)
    if header.are_points_compressed:
        return count
    size = stream.seek(0, 2)
    start, width = int(header.offset_to_point_data), int(header.point_format.size)
    if size < start + count * width:
        raise ValueError(f"it holds {size} bytes where its header promises {start + count * width}")
    behind = [size]
    if header.version.minor >= 4 and header.number_of_evlrs:
        behind.append(int(header.start_of_first_evlr))
    if header.version.minor >= 3 and header.start_of_waveform_data_packet_record:
        behind.append(int(header.start_of_waveform_data_packet_record))
    room = min((place for place in behind if place > start), default=size) - start
    # a rest that is no whole point is something else
    return room // width if room % width == 0 else count


def _check_chunk_table(stream: BinaryIO, header: laspy.LasHeader, count: int, records: list[Record]) -> None:
    """Check the table of the compressed chunks: lazrs ends the whole process on absurd sizes.

    Raises:
        ValueError: if the table contradicts the file.

    """
    if not (header.are_points_compressed and count):
        return
    described = [record.data for record in records if record.user_id == LASZIP]
    if not described:
        raise ValueError("the record that describes its compression is missing")
    vlr = lazrs.LazVlr(described[0])
    if vlr.item_size() != header.point_format.size:
        raise ValueError("its points and their compression have different sizes")
    size = stream.seek(0, 2)
    start = header.offset_to_point_data
    stream.seek(start)
    (table,) = struct.unpack("<q", stream.read(8))
    if table == -1:
        stream.seek(size - 8)
        (table,) = struct.unpack("<q", stream.read(8))
    if not start + 8 <= table <= size - 8:
        raise ValueError("the table of its compressed chunks is missing")
    stream.seek(table + 4)
    (chunks,) = struct.unpack("<I", stream.read(4))
    if chunks > table - start:
        raise ValueError("the table of its compressed chunks makes no sense")
    stream.seek(start)
    entries = lazrs.read_chunk_table(stream, vlr)
    fits = sum(length for _, length in entries) <= table - start
    # with chunks of one size, the table promises full ones, the last one too
    promised = [points for points, _ in entries]
    if not fits or sum(promised) < count or max(promised) > max(count, _CHUNK_MOST):
        raise ValueError("the table of its compressed chunks does not fit its header")
    _check_layers(stream, header, [length for _, length in entries])


def _check_layers(stream: BinaryIO, header: laspy.LasHeader, lengths: list[int]) -> None:
    """Check the sizes that each chunk of point formats 6 to 10 begins with: lazrs takes memory by them.

    Behind a chunk's first point, as it is, and its count stand the sizes of its layers, 32 bits each.

    Raises:
        ValueError: if they are larger than the chunk.

    """
    kind = header.point_format
    layers = _LAYERS.get(kind.id)
    if layers is None:
        return
    layers += kind.num_extra_bytes
    place = header.offset_to_point_data + 8
    for length in lengths:
        stream.seek(place + kind.size + 4)
        sizes = stream.read(4 * layers)
        if length and sum(struct.unpack(f"<{len(sizes) // 4}I", sizes[: len(sizes) // 4 * 4])) > length:
            raise ValueError("a compressed chunk is smaller than its layers")
        place += length
