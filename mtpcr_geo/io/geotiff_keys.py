"""GeoTIFF keys as LAS files carry them, read by the library that defines their meaning: GDAL."""

from __future__ import annotations

import struct
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pyproj import CRS

_SHORT, _LONG, _DOUBLE, _ASCII = 3, 4, 12, 2
_SIZES = {_SHORT: 2, _LONG: 4, _DOUBLE: 8, _ASCII: 1}
_MODEL, _GEOGRAPHIC, _PROJECTED = 1024, 2048, 3072
_VERTICAL, _VERTICAL_DATUM, _VERTICAL_UNIT = 4096, 4098, 4099
_USER_DEFINED = 32767
_ELLIPSOIDAL = range(5001, 5034)
"""Vertical codes of GeoTIFF 1.0 that mean heights above an ellipsoid: EPSG's code of that, less 2000."""
_NO_DATUM = "unretrievable"  # in the name of the ellipsoid that GDAL puts where keys name none

Entry = tuple[int, int, int, int]  # key, where its value stands (0: here), how many, the value or its place


def crs_of_geokeys(directory: bytes, doubles: bytes, text: bytes) -> tuple[CRS | None, str]:
    """Return the CRS of the three GeoTIFF records of a LAS file.

    The horizontal keys are wrapped into a TIFF of one pixel that GDAL then opens: it knows user-defined
    projections and angular units, which a look-up of EPSG codes does not. The vertical keys, in which
    codes of datums and of systems are often confused, are read here. No datum is made up.

    Args:
        directory: content of record 34735, 16 bit integers.
        doubles: content of record 34736, 64 bit floats, may be empty.
        text: content of record 34737, may be empty.

    Returns:
        The CRS, or None if the keys name none; and what of them cannot be used, or "".

    Raises:
        ValueError: if they name one that cannot be understood.

    """
    from pyproj.exceptions import CRSError
    from rasterio.errors import RasterioError

    entries = _entries(directory)
    if not entries:
        return None, ""
    codes = {key: value for key, place, _, value in entries if place == 0}
    try:
        horizontal = _horizontal(entries, codes, doubles, text)
        if horizontal is None:
            return None, ""
        return _with_heights(horizontal, codes)
    except (RasterioError, CRSError) as error:
        raise ValueError(str(error)) from error


def _entries(directory: bytes) -> list[Entry]:
    """Return the entries of a key directory, without padding, the last one of each key."""
    found = {
        entry[0]: entry
        for entry in struct.iter_unpack("<4H", directory[8 : len(directory) // 8 * 8])
        if entry[0] != 0
    }
    return [(key, place, count, value) for key, (_, place, count, value) in sorted(found.items())]


def _horizontal(entries: list[Entry], codes: dict[int, int], doubles: bytes, text: bytes) -> CRS | None:
    """Return the horizontal CRS by GDAL; None where the keys give units or a name and nothing else.

    Raises:
        ValueError: if no key names its datum.

    """
    import rasterio
    from pyproj import CRS
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    kept = [entry for entry in entries if not _VERTICAL <= entry[0] <= _VERTICAL_UNIT]
    # which keys count is told by the model; some writers leave it out, or contradict the rest by it
    model = codes.get(_MODEL, 0)
    if _is_code(codes.get(_PROJECTED, 0)):
        model = 1
    elif model == 0 and _is_code(codes.get(_GEOGRAPHIC, 0)):
        model = 2
    if model:
        kept = [(_MODEL, 0, 1, model), *(entry for entry in kept if entry[0] != _MODEL)]
    directory = struct.pack("<4H", 1, 1, 0, len(kept)) + b"".join(
        struct.pack("<4H", *entry) for entry in kept
    )
    with warnings.catch_warnings(), rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with MemoryFile(_tiff(directory, doubles, text)) as memory, memory.open() as dataset:
            found = dataset.crs
    if not found:
        return None
    crs = CRS.from_wkt(found.to_wkt(version="WKT2_2019"))
    if crs.is_engineering:
        return None
    if crs.ellipsoid is not None and _NO_DATUM in crs.ellipsoid.name:
        raise ValueError("they name no geodetic datum")
    return crs


def _with_heights(crs: CRS, codes: dict[int, int]) -> tuple[CRS, str]:
    """Return the CRS with what the keys state of heights; and what of that cannot be used, or ""."""
    from pyproj.crs import CompoundCRS

    code, datum = codes.get(_VERTICAL, 0), codes.get(_VERTICAL_DATUM, 0)
    unit = _unit(codes.get(_VERTICAL_UNIT, 0))
    if crs.is_compound or crs.is_geocentric or len(crs.axis_info) == 3:
        return crs, ""
    if code in _ELLIPSOIDAL:
        if unit in (None, 1.0) and _rests_on(crs, code + 2000):
            return crs.to_3d(), ""
        return crs, f"its vertical GeoTIFF key {code} means heights above an ellipsoid that is not its CRS's"
    vertical = _vertical_system(code, datum, unit)
    if vertical is not None:
        return CompoundCRS(f"{crs.name} + {vertical.name}", components=[crs, vertical]), _contradiction(
            code, datum, unit
        )
    named = [f"{value}" for value in (code, datum) if _is_code(value)]
    problem = (
        f"its vertical GeoTIFF keys ({', '.join(named)}) name no vertical system: the datum of its heights "
        "is not known"
        if named
        else ""
    )
    plan = crs.axis_info[0].unit_conversion_factor if crs.is_projected else 1.0
    if unit is None or abs(unit - plan) < 1e-12:
        return crs, problem
    vertical = _vertical_of("unknown", "unknown", unit)
    return CompoundCRS(f"{crs.name} + heights of unknown datum", components=[crs, vertical]), problem


def _vertical_system(code: int, datum: int, unit: float | None) -> CRS | None:
    """Return the vertical CRS that the keys name, by its own code or that of its datum; None if none.

    Args:
        code: of the key for the system.
        datum: of the key for the datum.
        unit: metres a unit of height, None where no key states it.

    """
    system = _epsg_vertical(code)
    if system is not None:
        return _in_unit(system, unit)
    name = _epsg_vertical_datum(code) or ("" if _is_code(code) else _epsg_vertical_datum(datum))
    other = _epsg_vertical(datum)
    if other is not None and (
        not _is_code(code) or (name and other.datum is not None and _same(other.datum.name, name))
    ):
        return _in_unit(other, unit)  # both keys exchanged, or the system under the datum's key
    return _vertical_of(f"{name} height", name, 1.0 if unit is None else unit) if name else None


def _in_unit(system: CRS, unit: float | None) -> CRS:
    """Return a vertical CRS of EPSG in the unit that the keys state beside its code.

    Codes of systems in metres are often written for heights in feet, and the unit key is what tells them
    apart: the heights are in the unit that is stated.

    Args:
        system: the one that the code names.
        unit: metres a unit of height, None where no key states it.

    Returns:
        The system itself if that is its unit; else EPSG's of the same datum in the unit, or one built so.

    """
    from pyproj import CRS
    from pyproj.database import query_crs_info
    from pyproj.enums import PJType

    if not _differs(system, unit) or unit is None or system.datum is None:
        return system
    plain = _plain_name(system.name)
    for info in query_crs_info(auth_name="EPSG", pj_types=PJType.VERTICAL_CRS):
        if _plain_name(info.name) == plain:
            other = CRS.from_epsg(int(info.code))
            same_datum = other.datum is not None and _same(other.datum.name, system.datum.name)
            if same_datum and other.axis_info[0].direction == "up" and not _differs(other, unit):
                return other
    return _vertical_of(f"{plain} ({_name(unit)})", system.datum.name, unit)


def _contradiction(code: int, datum: int, unit: float | None) -> str:
    """Return a remark if the keys state another unit of height than that of the system they name, or ""."""
    for value in (code, datum):
        system = _epsg_vertical(value)
        if system is None:
            continue
        if unit is None or not _differs(system, unit):
            return ""
        own = system.axis_info[0].unit_name
        return (
            f"its vertical GeoTIFF keys name EPSG:{value} ({system.name}), which is in {own}, and state "
            f"heights in {_name(unit)}, which is taken"
        )
    return ""


def _differs(system: CRS, unit: float | None) -> bool:
    return unit is not None and abs(system.axis_info[0].unit_conversion_factor - unit) > 1e-9


def _plain_name(name: str) -> str:
    """Return the name of a vertical system without its unit: "NAVD88 height" of "NAVD88 height (ftUS)"."""
    return name.partition(" (")[0]


def _rests_on(crs: CRS, code: int) -> bool:
    """Return whether a CRS has the ellipsoid of an EPSG code."""
    from pyproj.crs import Ellipsoid  # type: ignore[attr-defined]
    from pyproj.exceptions import CRSError

    try:
        other = Ellipsoid.from_epsg(code)
    except CRSError:
        return False
    own = crs.ellipsoid
    return (
        own is not None
        and abs(own.semi_major_metre - other.semi_major_metre) < 0.001
        and abs(own.inverse_flattening - other.inverse_flattening) < 1e-6
    )


def _epsg_vertical(code: int) -> CRS | None:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    # 5000-5099 meant ellipsoids in GeoTIFF 1.0, not EPSG codes of vertical systems
    if not _is_code(code) or 5000 <= code < 5100:
        return None
    try:
        crs = CRS.from_epsg(code)
    except CRSError:
        return None
    return crs if crs.is_vertical else None


def _epsg_vertical_datum(code: int) -> str:
    """Return the name of a vertical datum; "" if the code is none."""
    from pyproj.crs import Datum  # type: ignore[attr-defined]
    from pyproj.exceptions import CRSError

    if not _is_code(code):
        return ""
    try:
        datum = Datum.from_epsg(code)
    except CRSError:
        return ""
    return str(datum.name) if datum.type_name.startswith("Vertical") else ""


def _vertical_of(name: str, datum: str, unit: float) -> CRS:
    from pyproj import CRS

    units = "metre" if unit == 1.0 else {"type": "LinearUnit", "name": _name(unit), "conversion_factor": unit}
    axis = {"name": "Gravity-related height", "abbreviation": "H", "direction": "up", "unit": units}
    return CRS.from_json_dict(
        {
            "type": "VerticalCRS",
            "name": name,
            "datum": {"type": "VerticalReferenceFrame", "name": datum},
            "coordinate_system": {"subtype": "vertical", "axis": [axis]},
        }
    )


def _unit(code: int) -> float | None:
    """Return metres a unit of length by its EPSG code; None if it is none."""
    return {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937, 9005: 0.3047972654}.get(code)


def _name(unit: float) -> str:
    return {1.0: "metre", 0.3048: "foot", 1200 / 3937: "US survey foot"}.get(unit, f"unit of {unit:.9g} m")


def _same(one: str, other: str) -> bool:
    return one.lower().split() == other.lower().split()


def _is_code(value: int) -> bool:
    return 1024 <= value < _USER_DEFINED


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
