"""Writing clouds in other formats than LAS: PLY, PCD, text, NPY and E57, streamed but for E57.

PLY, PCD and NPY are a header and records, which are written as they come, with coordinates in float64. E57 is
written by pye57, a scan at a time, its coordinates in float32 about the middle of each scan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import InputError, MissingPartError, OutputError
from mtpcr_geo.io.dimensions import PDAL_NAMES
from mtpcr_geo.io.directions import turned_columns

if TYPE_CHECKING:
    from pyproj import CRS

Move = Callable[[Floats], Floats]
_OWN_NAMES = {pdal: las for las, pdal in PDAL_NAMES.items()}
_PLY_TYPES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip
_DECIMALS, _DECIMALS_OF_DEGREES = 6, 12
_COLOURS = ("red", "green", "blue")


def write_other(
    path: Path,
    cloud: Cloud,
    move: Move | None,
    crs: CRS | None,
    advance: Callable[[int], object] = lambda n: None,
) -> tuple[str, ...]:
    """Write a cloud in the format that a file's ending names, its coordinates moved on the way.

    Args:
        path: where to write; the ending is the format.
        cloud: what to write.
        move: takes (n, 3) file coordinates of `cloud` to those to be written; None leaves them. By a `Motion`
            normals turn with the points.
        crs: CRS of the written coordinates, for the digits that degrees need; these formats state none.
        advance: called with the number of points of each chunk written.

    Returns:
        The dimensions that the format cannot hold, which are left out.

    Raises:
        OutputError: if the ending names no format that is written, or the file cannot be written.
        MissingPartError: if its library is not installed.
        InputError: if the cloud cannot be read.

    """
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise OutputError(
            f"{path} ends in none of .las, .laz, .copc.laz, {', '.join(WRITERS)}, which are the formats "
            "written; name such a file"
        )
    try:
        return writer(path, _Columns(cloud, move), crs, advance)
    except OSError as error:
        raise OutputError(
            f"cannot write in {path.parent}: {error.strerror or error}; check rights and free space"
        ) from error


class _Columns:
    """The columns of a cloud under the names that other programs use, moved."""

    def __init__(self, cloud: Cloud, move: Move | None) -> None:
        self.cloud, self.move = cloud, move
        first = next(self._tables(1), None)
        if first is None:
            raise InputError(f"{cloud.name} is empty (0 points); there is nothing to write")
        fields: list[tuple[str, str]] = []
        self.left_out: list[str] = []
        for name, values in first.items():
            if values.dtype.kind not in "buif" or values.ndim > 2:
                self.left_out.append(name)
                continue
            kind = "u1" if values.dtype.kind == "b" else values.dtype.str[1:]
            width = 1 if values.ndim == 1 else values.shape[1]
            own = _OWN_NAMES.get(name, name.lower() if name in "XYZ" else name).replace(" ", "_")
            fields += [(own if width == 1 else f"{own}_{i}", kind) for i in range(width)]
        self.dtype = np.dtype([(name, f"<{kind}") for name, kind in fields])

    def records(self, size: int = CHUNK_POINTS) -> Iterator[NDArray[Any]]:
        """Yield structured arrays of all columns, n <= size."""
        for table in self._tables(size):
            records = np.zeros(len(table["X"]), self.dtype)
            names = iter(self.dtype.names or ())
            for name, values in table.items():
                if name in self.left_out:
                    continue
                for column in values.T if values.ndim == 2 else (values,):
                    records[next(names)] = column
            yield records

    def _tables(self, size: int) -> Iterator[PointTable]:
        for table in self.cloud.table_chunks(size):
            if self.move is None:
                yield table
                continue
            xyz = self.move(np.column_stack([np.asarray(table[axis], np.float64) for axis in "XYZ"]))
            moved = {axis: xyz[:, i] for i, axis in enumerate("XYZ")}
            yield {**table, **turned_columns(table, self.move), **moved}


def _streamed(path: Path, columns: _Columns, head: bytes, dtype: np.dtype[Any], advance: Any) -> None:
    """Write a header, and records of a layout."""
    written = 0
    with path.open("wb") as stream:
        stream.write(head)
        for records in columns.records():
            new = np.zeros(len(records), dtype)
            for name in dtype.names or ():
                new[name] = records[name] if name in (records.dtype.names or ()) else _packed(records)
            stream.write(new.tobytes())
            written += len(new)
            advance(len(new))
    _check_count(columns, written)


def _check_count(columns: _Columns, written: int) -> None:
    if written != columns.cloud.count:
        raise InputError(
            f"{columns.cloud.name} has {written:,} points where {columns.cloud.count:,} were counted; it has "
            "changed while it was read"
        )


def _write_ply(path: Path, columns: _Columns, crs: CRS | None, advance: Any) -> tuple[str, ...]:
    dtype = np.dtype([(name, _ply_type(columns.dtype[name])) for name in columns.dtype.names or ()])
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {columns.cloud.count}"]
    head += [f"property {_PLY_TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    _streamed(path, columns, "\n".join([*head, "end_header\n"]).encode(), dtype, advance)
    return tuple(columns.left_out)


def _ply_type(dtype: np.dtype[Any]) -> str:
    # PLY has no whole numbers of 64 bits, nor half floats
    return "<f8" if dtype.str[1:] not in _PLY_TYPES else dtype.str


def _write_pcd(path: Path, columns: _Columns, crs: CRS | None, advance: Any) -> tuple[str, ...]:
    names = list(columns.dtype.names or ())
    kinds = {name: columns.dtype[name] for name in names}
    if all(kinds.get(name) == np.uint8 for name in _COLOURS):
        # as the Point Cloud Library has them: in one number, which stands as a float
        names = [*(name for name in names if name not in _COLOURS), "rgb"]
        kinds["rgb"] = np.dtype("<f4")
    dtype = np.dtype([(name, kinds[name].str) for name in names])
    letters = {"f": "F", "i": "I", "u": "U"}
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(dtype[name].itemsize) for name in names)}",
        f"TYPE {' '.join(letters[dtype[name].kind] for name in names)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {columns.cloud.count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {columns.cloud.count}",
        "DATA binary\n",
    ]
    _streamed(path, columns, "\n".join(head).encode(), dtype, advance)
    return tuple(columns.left_out)


def _packed(records: NDArray[Any]) -> NDArray[Any]:
    red, green, blue = (records[name].astype(np.uint32) for name in _COLOURS)
    return np.asarray((red << 16 | green << 8 | blue).astype(np.uint32).view(np.float32))


def _write_npy(path: Path, columns: _Columns, crs: CRS | None, advance: Any) -> tuple[str, ...]:
    out = np.lib.format.open_memmap(path, mode="w+", dtype=columns.dtype, shape=(columns.cloud.count,))
    place = 0
    for records in columns.records():
        out[place : place + len(records)] = records
        place += len(records)
        advance(len(records))
    out.flush()
    _check_count(columns, place)
    return tuple(columns.left_out)


def _write_text(path: Path, columns: _Columns, crs: CRS | None, advance: Any) -> tuple[str, ...]:
    names = columns.dtype.names or ()
    csv = path.suffix.lower() == ".csv"
    between = "," if csv else " "
    degrees = crs is not None and crs.is_geographic
    with path.open("wb") as stream:
        stream.write((between.join(names) if csv else f"# {between.join(names)}").encode() + b"\n")
        for records in columns.records():
            formats = [_text_format(name, records.dtype[name], degrees) for name in names]
            np.savetxt(stream, records, fmt=formats, delimiter=between)
            advance(len(records))
    return tuple(columns.left_out)


def _text_format(name: str, dtype: np.dtype[Any], degrees: bool) -> str:
    if name in ("x", "y", "z"):
        return f"%.{_DECIMALS_OF_DEGREES if degrees and name != 'z' else _DECIMALS}f"
    return {"f4": "%.9g", "f8": "%.17g"}.get(dtype.str[1:], "%d")


def _write_e57(path: Path, columns: _Columns, crs: CRS | None, advance: Any) -> tuple[str, ...]:
    try:
        import pye57
    except ImportError as error:
        raise MissingPartError(f'E57 needs pye57 ({error}): pip install "mtpcr-geo[formats]"') from error
    records = np.concatenate(list(columns.records()))
    names = records.dtype.names or ()
    intensity = next((name for name in names if name in ("intensity", "intensity_value")), None)
    colours = all(name in names and records[name].max(initial=0) <= 255 for name in _COLOURS)
    held = {"x", "y", "z", "point_source_id", intensity, *(_COLOURS if colours else ())}
    scans = records["point_source_id"] if "point_source_id" in names else np.zeros(len(records), np.uint16)
    with pye57.E57(str(path), mode="w") as file:
        for number in np.unique(scans):
            part = records[scans == number]
            xyz = np.column_stack([part[axis] for axis in "xyz"])
            middle = np.rint((xyz.min(axis=0) + xyz.max(axis=0)) / 2)
            data = {f"cartesian{axis}": np.ascontiguousarray(xyz[:, i] - middle[i])
                    for i, axis in enumerate("XYZ")}  # fmt: skip
            if intensity is not None:
                data["intensity"] = part[intensity].astype(np.float32)
            if colours:
                data |= {f"color{one.title()}": part[one].astype(np.uint8) for one in _COLOURS}
            file.write_scan_raw(data, name=f"scan {number}", translation=middle)
            advance(len(part))
    return (*columns.left_out, *(name for name in names if name not in held and records[name].any()))


Writer = Callable[[Path, _Columns, "CRS | None", Callable[[int], object]], tuple[str, ...]]
WRITERS: dict[str, Writer] = {
    ".ply": _write_ply,
    ".pcd": _write_pcd,
    ".xyz": _write_text,
    ".txt": _write_text,
    ".asc": _write_text,
    ".csv": _write_text,
    ".npy": _write_npy,
    ".e57": _write_e57,
}
"""Ending of a file, and what writes it."""
