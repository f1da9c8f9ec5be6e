"""LAS 1.0-1.4, LAZ and COPC, streamed through laspy."""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import lazrs
import numpy as np
from laspy import DecompressionSelection as Fields

from mtpcr_geo.core.ahead import ahead
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.paths import real
from mtpcr_geo.core.system import sha256, usable_cores
from mtpcr_geo.io.dimensions import las_table, noise_of_record
from mtpcr_geo.io.kept import KeptPoints, placed
from mtpcr_geo.io.las_header import Head, Overlaid
from mtpcr_geo.io.vlr import crs_of_records

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
# What they raise on files that are sound, but of a kind that they do not know.
_UNKNOWN_KIND = (laspy.errors.PointFormatNotSupported, laspy.errors.FileVersionNotSupported)
_UNKNOWN_WORDS = ("not supported", "unsupported", "is unknown", "is not valid")
_XYZ = Fields.XY_RETURNS_CHANNEL | Fields.Z
_XYZ_AND_CLASS = _XYZ | Fields.CLASSIFICATION | Fields.FLAGS

# laspy logs to the console what it then raises; one message is enough
logging.getLogger("laspy").addHandler(logging.NullHandler())


class LasCloud(Cloud):
    """A cloud in a LAS, LAZ or COPC file: only its header is held, the points are streamed.

    Attributes:
        path: the file.
        header: laspy's header (point format, scales, offsets, bounds, identifiers).
        point_format: laspy's, with the extra dimensions.
        extra: the extra dimensions, as they are written again.
        records: its variable length records, before and behind the points, byte for byte.
        stated_count: number of points by its header, where `count` is what there are.
        crs_problem: what cannot be used of the CRS that the file states, or "".

    """

    def __init__(self, path: Path, head: Head, crs: CRS | None = None) -> None:
        header = head.header
        self.path = path
        self.name = str(path)
        self.header = header
        self.point_format = head.point_format
        self.extra = head.extra
        self.records = head.records
        self.stated_count = head.stated_count
        self.crs_problem = ""
        self.crs = crs
        if crs is None:
            self.crs, self.crs_problem = crs_of_records(head.records)
        self.count = head.count
        self._head = head.raw
        self._kept: KeptPoints | None = None
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
        yield from ahead(self._record_chunks(size, fields))

    def _record_chunks(self, size: int, fields: Fields | None) -> Iterator[laspy.ScaleAwarePointRecord]:
        with self._points(fields) as reader:
            left = self.count
            while left:
                record = self._record(reader.read_points(min(size, left)))
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
        with self._points(fields) as reader:
            for place in places:
                reader.seek(place)
                yield self._record(reader.read_points(min(size, self.count - place)))

    @contextmanager
    def _points(self, fields: Fields | None) -> Iterator[laspy.LasReader]:
        chosen = Fields.all() if fields is None else fields
        stream = BufferedReader(Overlaid(self.path, self._head), 1 << 20)
        with (
            _reported(self.path),
            laspy.open(
                stream, laz_backend=_backend(), read_evlrs=False, decompression_selection=chosen
            ) as reader,
        ):
            reader.header.point_count = self.count
            yield reader

    def _record(self, record: laspy.ScaleAwarePointRecord) -> laspy.ScaleAwarePointRecord:
        """Return a record that was read without names of its extra dimensions with them."""
        if self.point_format.num_extra_bytes == 0:
            return record
        named = np.frombuffer(record.array, self.point_format.dtype())
        return laspy.ScaleAwarePointRecord(named, self.point_format, record.scales, record.offsets)

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates in the file's CRS and units, n <= size.

        Raises:
            InputError: if the file is truncated or damaged.

        """
        for record in self.record_chunks(size, _XYZ):
            yield xyz_of(record)

    def noise_chunks(self, size: int = CHUNK_POINTS) -> Iterator[tuple[Floats, Mask]]:
        """Yield coordinates (n, 3) and which of them are noise or withheld (n,), see `keep`."""
        if self._kept is not None and self._kept.holds(size):
            yield from ahead(self._kept.chunks())
            return
        keeper = self._kept.keeper(size) if self._kept is not None else None
        for record in self.record_chunks(size, _XYZ_AND_CLASS):
            noise = noise_of_record(record)
            if keeper is not None:
                keeper.add(record.array, noise)
            yield xyz_of(record), noise
        if keeper is not None:
            keeper.finish()

    def keep(self, until: ExitStack) -> None:
        """Let the first pass over all coordinates keep them in a temporary file, for the passes after it.

        Decoding takes ten times as long as reading them there. They take 13 bytes a point, and nothing is
        kept where the folder of temporary files has no room for twice that.

        Args:
            until: the file is gone when this is closed; then the cloud is decoded again.

        """
        if self._kept is None:
            self._kept = KeptPoints.for_cloud(self.count, self.header.scales, self.header.offsets)
            if self._kept is not None:
                until.callback(self._forget)

    def _forget(self) -> None:
        if self._kept is not None:
            self._kept.close()
            self._kept = None

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name (X, Y, Z in float64 first), n <= size rows each."""
        for record in self.record_chunks(size):
            yield las_table(record, xyz_of(record))


def xyz_of(record: Any) -> Floats:
    """Return the (n, 3) float64 coordinates of a laspy point record."""
    return placed(record.array, record.scales, record.offsets)


def _backend() -> laspy.LazBackend:
    return laspy.LazBackend.Lazrs if usable_cores() == 1 else laspy.LazBackend.LazrsParallel


def open_cloud(path: str | Path, crs: CRS | None = None) -> LasCloud:
    """Open a LAS 1.0-1.4, LAZ or COPC file; nothing but its header is read.

    Args:
        path: the file; its content decides what it is, not its suffix.
        crs: coordinate reference system to take instead of what the file states.

    Raises:
        InputError: if it is missing, unreadable, or not such a file, or has an axis turned round.

    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path")
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a LAS, LAZ or COPC file")
    if not path.is_file():
        # a pipe would be waited for
        raise InputError(f"{path} is no regular file, and clouds are read more than once; save it as one")
    with _reported(path), path.open("rb") as stream:
        begins = stream.read(4)
        if not begins:
            raise InputError(f"{path} is empty: copy or export it again")
        if begins != b"LASF":
            raise InputError(f"{path} is not a LAS, LAZ or COPC file (it does not begin with LASF)")
        head = Head(stream)
    if (np.asarray(head.header.scales) < 0).any():
        axis = "xyz"[int(np.argmin(head.header.scales))]
        raise InputError(
            f"{path} has a negative scale in {axis}, so that it may be mirrored; export it again with scales "
            "above zero"
        )
    return LasCloud(path, head, crs)


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
    of_library = isinstance(error, laspy.errors.LaspyException | lazrs.LazrsError)
    if isinstance(error, _UNKNOWN_KIND) or (of_library and any(w in detail.lower() for w in _UNKNOWN_WORDS)):
        return InputError(
            f"{path} is of a kind that is not supported here ({detail}); write it as LAS 1.4 or LAZ by the "
            "program that made it, or by PDAL or LAStools"
        )
    return InputError(f"{path} is truncated or damaged ({detail}); copy or download it again")


def _files(cloud: Cloud) -> list[Path]:
    """Return the files of a cloud, one or many, resolved; none of a cloud in memory."""
    parts = getattr(cloud, "parts", None)
    return [real(one.name) for one in (parts or (cloud,)) if hasattr(one, "path")]


def check_distinct(target: Cloud, source: Cloud) -> None:
    """Refuse one cloud given as both target and source: it would fit itself perfectly.

    Raises:
        InputError: if both are the same file, or files of the same content.

    """
    if target is source:
        raise InputError(f"source and target are the same cloud ({source.name}); give two different ones")
    paths = [getattr(cloud, "path", None) for cloud in (target, source)]
    if not (isinstance(paths[0], Path) and isinstance(paths[1], Path)):
        return
    one, other = paths[0], paths[1]
    if not (one.is_file() and other.is_file()):
        twice = set(_files(target)) & set(_files(source))
        if twice:
            raise InputError(f"source and target share the file {min(twice)}; give two different clouds")
        return
    if one.samefile(other):
        raise InputError(f"source and target are the same file ({other}); give two different clouds")
    same_size = one.stat().st_size == other.stat().st_size
    if same_size and sha256(one) == sha256(other):
        raise InputError(
            f"source and target hold the same bytes ({other} and {one}); give two different clouds"
        )
