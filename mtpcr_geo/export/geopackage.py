"""A small writer of GeoPackage (OGC 12-128r19): vector layers with a CRS, from arrays.

The format is SQLite with a handful of agreed tables, so the standard library writes it in some
milliseconds, where a second copy of GDAL would add 30 MB to the installation.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.wording import visible

if TYPE_CHECKING:
    from pyproj import CRS

Kind = Literal["POINT", "LINESTRING", "POLYGON"]

_APPLICATION_ID = 0x47504B47  # "GPKG"
_VERSION = 10300
_UNDEFINED_CARTESIAN = -1
_OWN_SRS = 100_000
_WKB = {"POINT": 1, "LINESTRING": 2, "POLYGON": 3}

_SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (
    srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
    table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '', last_change DATETIME NOT NULL,
    min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
    CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
    table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
    srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
    CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
    CONSTRAINT uk_gc_table_name UNIQUE (table_name),
    CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
    CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT, f_table_schema TEXT,
    f_table_name TEXT, f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT,
    useAsDefault BOOLEAN, description TEXT, owner TEXT, ui TEXT, update_time DATETIME);
"""
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",'
    '0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)


@dataclass(frozen=True, eq=False)
class Layer:
    """One vector layer.

    Attributes:
        name: of the layer; letters, digits and underscores.
        kind: what its geometries are.
        geometries: one (m, 2) or (m, 3) float64 array each, absolute CRS coordinates: m = 1 for a
            point; a polygon is its closed outer ring.
        fields: attributes by name, each (n,): bool, integer, float (NaN becomes NULL) or text.
        description: what the layer shows, for the reader's layer properties.
        style: a QML that QGIS applies by default, or "".
        local: whether its coordinates are local, in a file whose other layers are in a CRS.

    """

    name: str
    kind: Kind
    geometries: list[Floats]
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    description: str = ""
    style: str = ""
    local: bool = False


def write_geopackage(path: str | Path, layers: Iterable[Layer], crs: CRS | None) -> None:
    """Write a new GeoPackage; an existing file of that name is replaced.

    Args:
        path: where to write.
        layers: what to write; a layer without geometries becomes an empty table.
        crs: of all layers that are not local, or None for local coordinates ("undefined Cartesian" in the
            file).

    Raises:
        OutputError: if the file cannot be written.

    """
    path = Path(path)
    try:
        path.unlink(missing_ok=True)
        with closing(sqlite3.connect(path)) as base, base:
            # the file has a temporary name until it is whole, so no journal needs to guard it
            base.execute("PRAGMA journal_mode = OFF")
            base.execute("PRAGMA synchronous = OFF")
            base.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            base.execute(f"PRAGMA user_version = {_VERSION}")
            base.executescript(_SCHEMA)
            srs = _add_srs(base, crs)
            for layer in layers:
                _add_layer(base, layer, _UNDEFINED_CARTESIAN if layer.local else srs)
            _register(base, "layer_styles", "attributes", "styles that QGIS applies", None, 0)
    except (sqlite3.Error, OSError) as error:
        raise OutputError(f"cannot write {path}: {error}") from error


def blob(kind: Kind, xyz: Floats, srs: int) -> bytes:
    """Return one geometry as GeoPackage binary: header with envelope, then little-endian WKB.

    Args:
        kind: what it is.
        xyz: (m, 2) or (m, 3) coordinates; one row for a point, a closed ring for a polygon.
        srs: the id of its reference system in the file.

    """
    xyz = np.ascontiguousarray(xyz, "<f8")
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    head = struct.pack("<2sBBi", b"GP", 0, 0b0011, srs)
    envelope = struct.pack("<4d", low[0], high[0], low[1], high[1])
    wkb = struct.pack("<BI", 1, _WKB[kind] + (1000 if xyz.shape[1] == 3 else 0))
    if kind == "POLYGON":
        wkb += struct.pack("<I", 1)
    if kind != "POINT":
        wkb += struct.pack("<I", len(xyz))
    return head + envelope + wkb + xyz.tobytes()


def _add_srs(base: sqlite3.Connection, crs: CRS | None) -> int:
    rows = [
        ("Undefined Cartesian", _UNDEFINED_CARTESIAN, "NONE", -1, "undefined", "a local frame"),
        ("Undefined geographic", 0, "NONE", 0, "undefined", ""),
        ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS84, "longitude and latitude"),
    ]
    srs = _UNDEFINED_CARTESIAN
    if crs is not None:
        authority = crs.to_authority(min_confidence=100)
        if authority is not None and authority[0] == "EPSG":
            organization, code = authority[0], int(authority[1])
            srs = code
        else:
            organization, code, srs = "NONE", _OWN_SRS, _OWN_SRS
        rows.append((visible(crs.name), srs, organization, code, visible(_definition(crs)), ""))
    base.executemany("INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", rows)
    return srs


def _definition(crs: CRS) -> str:
    """Return WKT as the standard asks for it; the newer form where the older cannot express it."""
    from pyproj.enums import WktVersion
    from pyproj.exceptions import CRSError

    try:
        return crs.to_wkt(WktVersion.WKT1_GDAL)
    except CRSError:
        return crs.to_wkt()


def _add_layer(base: sqlite3.Connection, layer: Layer, srs: int) -> None:
    columns = "".join(f', "{name}" {_sql_type(values)}' for name, values in layer.fields.items())
    base.execute(
        f'CREATE TABLE "{layer.name}" '
        f"(fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {layer.kind}{columns})"
    )
    shapes = [blob(layer.kind, xyz, srs) for xyz in layer.geometries]
    columns_of_values = [_plain(values) for values in layer.fields.values()]
    marks = ", ".join("?" * (1 + len(columns_of_values)))
    names = "".join(f', "{name}"' for name in layer.fields)
    base.executemany(
        f'INSERT INTO "{layer.name}" (geom{names}) VALUES ({marks})',
        zip(shapes, *columns_of_values, strict=True),
    )
    bounds = None
    if layer.geometries:
        every = np.vstack([xyz[:, :2] for xyz in layer.geometries])
        bounds = (*every.min(axis=0).tolist(), *every.max(axis=0).tolist())
    _register(base, layer.name, "features", layer.description, bounds, srs)
    has_z = int(any(xyz.shape[1] == 3 for xyz in layer.geometries))
    base.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, ?, 0)",
        (layer.name, layer.kind, srs, has_z),
    )
    if layer.style:
        base.execute(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, "
            "styleName, styleQML, useAsDefault, description, update_time) "
            "VALUES ('', '', ?, 'geom', ?, ?, 1, ?, ?)",
            (layer.name, layer.name, layer.style, visible(layer.description), _now()),
        )


def _register(
    base: sqlite3.Connection,
    name: str,
    data_type: str,
    description: str,
    bounds: tuple[float, ...] | None,
    srs: int,
) -> None:
    base.execute(
        "INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        (name, data_type, name, visible(description), _now(), *(bounds or (None,) * 4), srs),
    )


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")


def _sql_type(values: NDArray[Any]) -> str:
    names = {"b": "BOOLEAN", "i": "INTEGER", "u": "INTEGER", "f": "DOUBLE"}
    return names.get(np.asarray(values).dtype.kind, "TEXT")


def _plain(values: NDArray[Any]) -> list[Any]:
    """Return values as SQLite takes them; SQLite itself stores NaN as NULL."""
    values = np.asarray(values)
    plain = (values.astype(np.int64) if values.dtype.kind == "b" else values).tolist()
    return [visible(value) if isinstance(value, str) else value for value in plain]
