"""How points are laid out in the LAS 1.4 files that are written: point format 6 or up, WKT, nothing lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import date
from itertools import chain
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
from laspy.vlrs.known import ExtraBytesStruct, ExtraBytesVlr
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import Cloud, PointTable, flags_of_table
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.version import __version__
from mtpcr_geo.io.dimensions import LEGACY_OVERLAP, PDAL_NAMES, SCAN_ANGLE_STEP
from mtpcr_geo.io.foreign import as_vlr
from mtpcr_geo.io.las import LasCloud, xyz_of
from mtpcr_geo.io.views import las_below, las_records
from mtpcr_geo.io.vlr import EXTRA_BYTES, WKT_RECORD, Record

if TYPE_CHECKING:
    from pyproj import CRS

Chunk = tuple[Floats, NDArray[Any]]  # coordinates (n, 3), and the rest as packed records (n,)

# the nearest of the formats 6-10 that has all dimensions of a format 0-5
MODERN_FORMAT = {0: 6, 1: 6, 2: 7, 3: 7, 4: 9, 5: 10}
_COPIED = ("intensity", "user_data", "point_source_id", "gps_time", "red", "green", "blue")
_WAVEFORM = (
    "wavepacket_index",
    "wavepacket_offset",
    "wavepacket_size",
    "return_point_wave_location",
    "x_t",
    "y_t",
    "z_t",
)
_TABLE_ELSEWHERE = {
    *("X", "Y", "Z", "ClassFlags", "ScanAngleRank", "ScanAngle"),
    *PDAL_NAMES.values(),
}
_MAX_VLR = 65_535
_WEEK = 604_800.0


def layout(cloud: Cloud, crs: CRS | None) -> tuple[laspy.LasHeader, Iterator[Chunk]]:
    """Return how a cloud is written, and its points in that layout.

    Args:
        cloud: any cloud; a `LasCloud`, and a view of one, keeps dimensions, extra bytes, identifiers and
            records.
        crs: what to state as WKT; None states nothing.

    Returns:
        A header that lacks scales, offsets and bounds, and whose GPS time type is settled only when all
        chunks were taken; and chunks of coordinates with packed records whose X, Y, Z are not filled in.

    Raises:
        InputError: if the cloud has no points, or dimensions or classes that a LAS file cannot hold.

    """
    las = las_below(cloud)
    if las is not None and (cloud.count or cloud is las):
        header, chunks = _las_layout(las, cloud)
    else:
        header, chunks = _table_layout(cloud)
    header.global_encoding.wkt = True
    header.system_identifier = "TRANSFORMATION"
    header.generating_software = f"mtpcr_geo {__version__}"
    header.creation_date = date.today()
    if crs is not None:
        wkt = wkt_of(crs).encode() + b"\0"
        header.vlrs.append(laspy.VLR("LASF_Projection", WKT_RECORD, "OGC coordinate system WKT", wkt))
    return header, chunks


def wkt_of(crs: CRS) -> str:
    """Return a CRS as the WKT 1 that LAS 1.4 prescribes, or as WKT 2 where only that can express it."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        text = crs.to_wkt("WKT1_GDAL")
        if text and CRS.from_wkt(text).equals(crs, ignore_axis_order=True):
            return text
        code = crs.to_epsg()
        if text and code is not None and CRS.from_wkt(text).to_epsg() == code:
            return text
    except CRSError:
        pass
    return str(crs.to_wkt("WKT2_2019"))


def _las_layout(cloud: LasCloud, shown: Cloud) -> tuple[laspy.LasHeader, Iterator[Chunk]]:
    """Return the layout of a LAS file, and what a cloud shows of its points."""
    old = cloud.header
    point_format = laspy.PointFormat(MODERN_FORMAT.get(old.point_format.id, old.point_format.id))
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    # laspy would describe them by records of its own
    point_format.dimensions.extend(cloud.point_format.extra_dimensions)
    header.file_source_id = old.file_source_id
    header.uuid = old.uuid
    encoding = header.global_encoding
    encoding.gps_time_type = old.global_encoding.gps_time_type
    encoding.synthetic_return_numbers = old.global_encoding.synthetic_return_numbers
    encoding.waveform_data_packets_external = old.global_encoding.waveform_data_packets_external
    header.evlrs = laspy.vlrs.vlrlist.VLRList()
    # as raw bytes: laspy would drop "no data" values and replace the minima and maxima
    described = [Record(*EXTRA_BYTES, "", cloud.extra.data)] if cloud.extra.descriptors else []
    for number, record in enumerate([*cloud.records, *described]):
        if record in described or (record.is_kept and record.place is None):
            vlr = as_vlr(record, number)
            (header.vlrs if len(record.data) <= _MAX_VLR else header.evlrs).append(vlr)
    dtype = point_format.dtype()
    return header, ((xyz_of(record), modern(record, dtype)) for record in las_records(shown))


def modern(record: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a laspy record of any point format as packed records of its modern format, X, Y, Z left out.

    Class 12 of the old formats means overlap: the class stays and the flag of that name is set.
    """
    old = record.array
    if old.dtype == dtype:
        # read for this and nothing else: it need not be copied
        return np.asarray(old if old.flags.writeable else old.copy())
    new = np.zeros(len(old), dtype)
    for name in (*_COPIED, *_WAVEFORM, *record.point_format.extra_dimension_names):
        if name in old.dtype.names and name in (dtype.names or ()):
            new[name] = old[name]
    bits, raw = old["bit_fields"], old["raw_classification"]
    classification = raw & 31
    new["bit_fields"] = (bits & 7) | (((bits >> 3) & 7) << 4)
    new["classification"] = classification
    # synthetic, key point and withheld are the upper three bits; scan direction and edge keep their places
    flags = ((raw >> 5) & 7) | (bits & 0b1100_0000)
    new["classification_flags"] = flags | np.where(classification == LEGACY_OVERLAP, 8, 0).astype(np.uint8)
    new["scan_angle"] = np.rint(old["scan_angle_rank"] / SCAN_ANGLE_STEP)
    return new


def _table_layout(cloud: Cloud) -> tuple[laspy.LasHeader, Iterator[Chunk]]:
    tables = cloud.table_chunks()
    first = next(tables, None)
    if first is None:
        raise InputError(f"{cloud.name} is empty (0 points); there is nothing to write")
    format_id = 8 if "Infrared" in first else 7 if "Red" in first else 6
    point_format = laspy.PointFormat(format_id)
    extra = [name for name in first if name not in _TABLE_ELSEWHERE]
    for name in extra:
        values = np.asarray(first[name])
        if values.dtype.kind not in "buif" or len(name.encode()) > 31 or values.ndim > 2:
            raise InputError(f"dimension {name!r} of {cloud.name} cannot be held by a LAS file; leave it out")
        kind = np.dtype(np.uint8) if values.dtype.kind == "b" else values.dtype
        width = values.shape[1:] if values.shape[1:] != (1,) else ()
        point_format.add_extra_dimension(laspy.ExtraBytesParams(name, np.dtype((kind, width))))
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.evlrs = laspy.vlrs.vlrlist.VLRList()
    for vlr in header.vlrs.get("ExtraBytesVlr"):
        _forget_ranges(vlr)
    header.vlrs.extend(
        laspy.VLR(vlr.user_id, vlr.record_id, vlr.description, vlr.record_data_bytes())
        for vlr in header.vlrs.extract("ExtraBytesVlr")
    )
    pack = _table_packer(cloud.name, point_format.dtype(), extra)

    def packed() -> Iterator[Chunk]:
        for table in chain([first], tables):
            if _is_standard_time(table):
                header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
            yield _table_xyz(table), pack(table)

    return header, packed()


def _is_standard_time(table: PointTable) -> bool:
    """Return whether some time is no second of a week (0-604800), so that it is standard GPS time."""
    time = np.asarray(table.get("GpsTime", [0.0]), np.float64)
    return bool(((time < 0) | (time > _WEEK)).any())


def _forget_ranges(vlr: ExtraBytesVlr) -> None:
    """Unset the minima and maxima, which laspy takes from the first point alone."""
    for entry in vlr.extra_bytes_structs:
        entry.options &= ~(ExtraBytesStruct.MIN_BIT_MASK | ExtraBytesStruct.MAX_BIT_MASK)


def _table_xyz(table: PointTable) -> Floats:
    return np.column_stack([np.asarray(table[axis], np.float64) for axis in "XYZ"])


def _table_packer(
    cloud_name: str, dtype: np.dtype[Any], extra: Sequence[str]
) -> Callable[[PointTable], NDArray[Any]]:
    plain = {
        las: pdal
        for las, pdal in PDAL_NAMES.items()
        if las in (dtype.names or ()) and las != "classification"
    }

    def pack(table: PointTable) -> NDArray[Any]:
        new = np.zeros(len(table["X"]), dtype)

        def column(name: str, default: int = 0) -> NDArray[Any]:
            return np.asarray(table.get(name, np.full(len(new), default)))

        for las, pdal in plain.items():
            if pdal in table:
                new[las] = table[pdal]
        returns = column("ReturnNumber", 1).astype(np.uint8) & 15
        new["bit_fields"] = returns | (column("NumberOfReturns", 1).astype(np.uint8) & 15) << 4
        classification = column("Classification")
        if ((classification < 0) | (classification > 255)).any():
            raise InputError(f"{cloud_name} has classes outside 0-255, which LAS cannot hold; map them")
        new["classification"] = classification
        packed = np.zeros(len(new), np.uint8)
        for place, flag in enumerate(flags_of_table(table).values()):
            packed |= flag << np.uint8(place)
        packed |= (column("ScanChannel").astype(np.uint8) & 3) << np.uint8(4)
        packed |= (column("ScanDirectionFlag").astype(np.uint8) & 1) << np.uint8(6)
        packed |= (column("EdgeOfFlightLine").astype(np.uint8) & 1) << np.uint8(7)
        new["classification_flags"] = packed
        degrees = column("ScanAngle" if "ScanAngle" in table else "ScanAngleRank")
        new["scan_angle"] = np.rint(np.clip(degrees, -180, 180) / SCAN_ANGLE_STEP)
        for name in extra:
            new[name] = table[name]
        return new

    return pack
