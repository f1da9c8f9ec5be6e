"""GeoTIFF keys as LAS files carry them, read by the library that defines their meaning: GDAL."""

from __future__ import annotations

import struct
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pyproj import CRS

_SHORT, _LONG, _DOUBLE, _ASCII = 3, 4, 12, 2
_SIZES = {_SHORT: 2, _LONG: 4, _DOUBLE: 8, _ASCII: 1}
_GEOGRAPHIC, _PROJECTED, _VERTICAL_CRS, _VERTICAL_UNIT = 2048, 3072, 4096, 4099


def crs_of_geokeys(directory: bytes, doubles: bytes, text: bytes) -> CRS | None:
    """Return the CRS of the three GeoTIFF records of a LAS file.

    The keys are wrapped into a TIFF of one pixel that GDAL then opens: it knows user-defined
    projections, angular units and compound systems, which a look-up of EPSG codes does not.

    Args:
        directory: content of record 34735, 16 bit integers.
        doubles: content of record 34736, 64 bit floats, may be empty.
        text: content of record 34737, may be empty.

    Returns:
        The CRS, or None if the keys name none.

    Raises:
        ValueError: if they name one that cannot be understood.

    """
    import rasterio
    from pyproj import CRS
    from pyproj.exceptions import CRSError
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.io import MemoryFile

    keys = _simple_keys(directory)
    if not keys:
        return None
    try:
        with warnings.catch_warnings(), rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"):
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with MemoryFile(_tiff(directory, doubles, text)) as memory, memory.open() as dataset:
                found = dataset.crs
        if not found:
            return None
        return _with_vertical_key(CRS.from_wkt(found.to_wkt(version="WKT2_2019")), keys)
    except (RasterioError, CRSError) as error:
        raise ValueError(str(error)) from error


def _simple_keys(directory: bytes) -> dict[int, int]:
    """Return the keys whose value stands in the directory itself."""
    entries = struct.iter_unpack("<4H", directory[8 : len(directory) // 8 * 8])
    return {key: value for key, place, _, value in entries if place == 0 and key != 0}


def _with_vertical_key(crs: CRS, keys: dict[int, int]) -> CRS:
    """Return the CRS with the vertical part that a key names, where GDAL gave a horizontal one only."""
    from pyproj import CRS
    from pyproj.crs import CompoundCRS

    code = keys.get(_VERTICAL_CRS, 0)
    # 5000-5099 meant ellipsoids in GeoTIFF 1.0, not EPSG codes of vertical systems; 32767 is user-defined
    if crs.is_compound or not 1024 <= code < 32767 or 5000 <= code < 5100:
        return crs
    vertical = CRS.from_epsg(code)
    return CompoundCRS(f"{crs.name} + {vertical.name}", components=[crs, vertical])


def _tiff(directory: bytes, doubles: bytes, text: bytes) -> bytes:
    """Return a TIFF of one pixel that carries the keys."""
    entries: list[tuple[int, int, bytes]] = [
        (256, _SHORT, struct.pack("<H", 1)),
        (257, _SHORT, struct.pack("<H", 1)),
        (258, _SHORT, struct.pack("<H", 8)),
        (259, _SHORT, struct.pack("<H", 1)),
        (262, _SHORT, struct.pack("<H", 1)),
        (273, _LONG, struct.pack("<I", 8)),
        (277, _SHORT, struct.pack("<H", 1)),
        (278, _SHORT, struct.pack("<H", 1)),
        (279, _LONG, struct.pack("<I", 1)),
        # without a place on earth GDAL does not look at the keys
        (33550, _DOUBLE, struct.pack("<3d", 1.0, 1.0, 0.0)),
        (33922, _DOUBLE, struct.pack("<6d", 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)),
        (34735, _SHORT, directory[: len(directory) // 2 * 2]),
    ]
    if len(doubles) >= 8:
        entries.append((34736, _DOUBLE, doubles[: len(doubles) // 8 * 8]))
    if text:
        entries.append((34737, _ASCII, text))
    place = 10 + 2 + 12 * len(entries) + 4
    table, overflow = b"", b""
    for tag, kind, data in entries:
        value = data.ljust(4, b"\0")
        if len(data) > 4:
            value = struct.pack("<I", place + len(overflow))
            overflow += data + b"\0" * (len(data) % 2)
        table += struct.pack("<HHI", tag, kind, len(data) // _SIZES[kind]) + value
    head = struct.pack("<2sHI", b"II", 42, 10) + b"\0\0"  # the pixel stands at byte 8
    return head + struct.pack("<H", len(entries)) + table + struct.pack("<I", 0) + overflow
