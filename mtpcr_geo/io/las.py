"""LAS 1.0-1.4, LAZ and COPC, streamed through laspy."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy import DecompressionSelection as Fields

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.system import sha256
from mtpcr_geo.io.dimensions import las_table, noise_of_record
from mtpcr_geo.io.vlr import Record, crs_of_records, read_records

if TYPE_CHECKING:
    from pyproj import CRS

# What laspy and lazrs raise on files that are not as they should be.
_BROKEN = (
    laspy.errors.LaspyException,
    lazrs.LazrsError,
    ValueError,
    OverflowError,
    struct.error,
    EOFError,
    IndexError,
    KeyError,
    AssertionError,
)
_CHUNK_MOST = 10_000_000  # points that a chunk may promise beyond those of the file
_XYZ = Fields.XY_RETURNS_CHANNEL | Fields.Z
_XYZ_AND_CLASS = _XYZ | Fields.CLASSIFICATION | Fields.FLAGS

# laspy logs to the console what it then raises; one message is enough
logging.getLogger("laspy").addHandler(logging.NullHandler())


class LasCloud(Cloud):
    """A cloud in a LAS, LAZ or COPC file: only its header is held, the points are streamed.

    Attributes:
        path: the file.
        header: laspy's header (point format, scales, offsets, bounds, identifiers).
        records: its variable length records, before and behind the points, byte for byte.
        crs_problem: why `crs` is None though the file states one, or "".

    """

    def __init__(
        self, path: Path, header: laspy.LasHeader, records: list[Record], crs: CRS | None = None
    ) -> None:
        self.path = path
        self.name = str(path)
        self.header = header
        self.records = records
        self.crs_problem = ""
        self.crs = crs
        if crs is None:
            self.crs, self.crs_problem = crs_of_records(records)
        self.count = int(header.point_count)
        self.minimum = np.array(header.mins, np.float64)
        self.maximum = np.array(header.maxs, np.float64)

    def record_chunks(
        self, size: int = CHUNK_POINTS, fields: Fields | None = None
    ) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield laspy point records of at most `size` points, with every dimension as stored.

        Args:
            size: points a chunk.
            fields: what to decompress (point formats 6 and up); the rest is left at zero. All by default.

        Raises:
            InputError: if the file is truncated or damaged.

        """
        chosen = Fields.all() if fields is None else fields
        with (
            _reported(self.path),
            laspy.open(self.path, read_evlrs=False, decompression_selection=chosen) as reader,
        ):
            left = self.count
            while left:
                record = reader.read_points(min(size, left))
                if not len(record):
                    raise ValueError(f"{left} of {self.count} points are missing")
                left -= len(record)
                yield record

    def records_at(
        self, places: Sequence[int], size: int, fields: Fields | None = None
    ) -> Iterator[laspy.ScaleAwarePointRecord]:
        """Yield up to `size` points from each of some places of the file, without reading what is between.

        Args:
            places: indices of the first point of each part, 0 to `count` - 1.
            size: points a part, at most.
            fields: as in `record_chunks`.

        Raises:
            InputError: if the file is truncated or damaged.

        """
        chosen = Fields.all() if fields is None else fields
        with (
            _reported(self.path),
            laspy.open(self.path, read_evlrs=False, decompression_selection=chosen) as reader,
        ):
            for place in places:
                reader.seek(place)
                yield reader.read_points(min(size, self.count - place))

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates in the file's CRS and units, n <= size.

        Raises:
            InputError: if the file is truncated or damaged.

        """
        for record in self.record_chunks(size, _XYZ):
            yield xyz_of(record)

    def noise_chunks(self, size: int = CHUNK_POINTS) -> Iterator[tuple[Floats, Mask]]:
        """Yield coordinates (n, 3) and which of them are noise or withheld (n,)."""
        for record in self.record_chunks(size, _XYZ_AND_CLASS):
            yield xyz_of(record), noise_of_record(record)

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name (X, Y, Z in float64 first), n <= size rows each."""
        for record in self.record_chunks(size):
            yield las_table(record, xyz_of(record))


def xyz_of(record: Any) -> Floats:
    """Return the (n, 3) float64 coordinates of a laspy point record."""
    xyz = np.empty((len(record), 3))
    for axis, name in enumerate("XYZ"):
        np.multiply(record.array[name], record.scales[axis], out=xyz[:, axis])
        xyz[:, axis] += record.offsets[axis]
    return xyz


def open_cloud(path: str | Path, crs: CRS | None = None) -> LasCloud:
    """Open a LAS 1.0-1.4, LAZ or COPC file; nothing but its header is read.

    Args:
        path: the file; its content decides what it is, not its suffix.
        crs: coordinate reference system to take instead of what the file states.

    Raises:
        InputError: if it is missing, unreadable, or not such a file.

    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a LAS, LAZ or COPC file")
    with _reported(path), path.open("rb") as stream:
        if stream.read(4) != b"LASF":
            raise InputError(f"{path} is not a LAS, LAZ or COPC file (it does not begin with LASF)")
        _check_head(stream)
        stream.seek(0)
        header = laspy.LasHeader.read_from(stream)
        records = _records(stream, header)
        header.point_format.dtype()  # two dimensions of one name show here
        _check_size(path, header)
        _check_chunk_table(stream, header, records)
    return LasCloud(path, header, records, crs)


def _check_head(stream: BinaryIO) -> None:
    """Check the counts at the head of the file before anything is read by them.

    Raises:
        ValueError: if the file cannot hold what they promise.

    """
    size = stream.seek(0, 2)
    stream.seek(94)
    header_size, points, records = struct.unpack("<HII", stream.read(10))
    if not 227 <= header_size <= points <= size or records * 54 > points - header_size:
        raise ValueError("its header contradicts its size")


def _records(stream: Any, header: laspy.LasHeader) -> list[Record]:
    stream.seek(94)
    header_size, _, count = struct.unpack("<HII", stream.read(10))
    records = read_records(stream, header_size, count, extended=False)
    if header.version.minor >= 4 and header.number_of_evlrs:
        records += read_records(stream, header.start_of_first_evlr, header.number_of_evlrs, extended=True)
    return records


def _check_size(path: Path, header: laspy.LasHeader) -> None:
    if header.are_points_compressed or not header.point_count:
        return
    wanted = header.offset_to_point_data + header.point_count * header.point_format.size
    if path.stat().st_size < wanted:
        raise ValueError(f"it holds {path.stat().st_size} bytes where its header promises {wanted}")


def _check_chunk_table(stream: BinaryIO, header: laspy.LasHeader, records: list[Record]) -> None:
    """Check the table of the compressed chunks: lazrs ends the whole process on absurd sizes.

    Raises:
        ValueError: if the table contradicts the file.

    """
    if not (header.are_points_compressed and header.point_count):
        return
    described = [record.data for record in records if record.user_id == "laszip encoded"]
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
    if not fits or sum(promised) < header.point_count or max(promised) > max(header.point_count, _CHUNK_MOST):
        raise ValueError("the table of its compressed chunks does not fit its header")


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn whatever a broken file makes the libraries raise into an InputError that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror or error}; check the file and its rights"
        ) from error
    except _BROKEN as error:
        raise _damaged(path, error) from error
    except BaseException as error:
        # a panic in lazrs comes as a BaseException of its own, which is not exported
        if type(error).__name__ != "PanicException":
            raise
        raise _damaged(path, error) from error


def _damaged(path: Path, error: BaseException) -> InputError:
    detail = (str(error).splitlines() or [type(error).__name__])[0]
    return InputError(f"{path} is truncated or damaged ({detail}); copy or download it again")


def check_distinct(target: Cloud, source: Cloud) -> None:
    """Refuse one cloud given as both target and source: it would fit itself perfectly.

    Raises:
        InputError: if both are the same file, or files of the same content.

    """
    if target is source:
        raise InputError(f"source and target are the same cloud ({source.name}); give two different ones")
    if not (isinstance(target, LasCloud) and isinstance(source, LasCloud)):
        return
    if target.path.samefile(source.path):
        raise InputError(f"source and target are the same file ({source.path}); give two different clouds")
    same_size = target.path.stat().st_size == source.path.stat().st_size
    if same_size and sha256(target.path) == sha256(source.path):
        raise InputError(
            f"source and target hold the same bytes ({source.path} and {target.path}); "
            "give two different clouds"
        )
