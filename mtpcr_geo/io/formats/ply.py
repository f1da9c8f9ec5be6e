"""PLY, binary and text: the vertices of a cloud or mesh.

Read here, since its header is a few lines, binary vertices are a memory map, and the usual library for it is
under a licence that would bind this package.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import PointTable
from mtpcr_geo.io.file_cloud import FileCloud, named, reported, require_xyz
from mtpcr_geo.io.formats.text import rows_of

if TYPE_CHECKING:
    from pyproj import CRS

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
_TYPES.update((f"{kind}{8 * size}", f"{kind[0]}{size}") for kind in ("int", "uint") for size in (1, 2, 4, 8))
_TYPES.update(float="f4", double="f8", float32="f4", float64="f8")
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_LONGEST_HEADER = 1_000


class PlyCloud(FileCloud):
    """The vertices of a PLY file, streamed."""

    def __init__(self, path: Path, crs: CRS | None, order: str, start: int, count: int, dtype: Any) -> None:
        super().__init__(path, crs, "PLY", count)
        self.order, self.start, self.dtype = order, start, np.dtype(dtype)

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name."""
        names = self.dtype.names or ()
        if not self.order:
            with self.path.open("rb") as stream:
                stream.seek(self.start)
                for rows in rows_of(stream, size, most=self.count):
                    typed = {name: rows[:, i].astype(self.dtype[name]) for i, name in enumerate(names)}
                    yield named(typed)
            return
        records: NDArray[Any] = np.memmap(self.path, self.dtype, "r", self.start, (self.count,))
        for place in range(0, self.count, size):
            part = records[place : place + size]
            yield named({name: part[name].astype(part.dtype[name].newbyteorder("=")) for name in names})


def open_file(path: Path, crs: CRS | None) -> PlyCloud:
    """Open a PLY file; its header is read.

    Raises:
        InputError: if it is none, or its vertices cannot be read.

    """
    with reported(path), path.open("rb") as stream:
        order, start, count, fields = _header(stream)
        require_xyz(path, [name for name, _ in fields])
        dtype = np.dtype([(name, f"{order}{kind}") for name, kind in fields])
        size = stream.seek(0, 2)
        if order and size < start + count * dtype.itemsize:
            raise ValueError(f"it holds {size} bytes where {count} vertices need more")
    return PlyCloud(path, crs, order, start, count, dtype)


def _header(stream: BinaryIO) -> tuple[str, int, int, list[tuple[str, str]]]:
    """Return the byte order ("" for text), where the vertices begin, their number and properties."""
    if stream.readline().strip() != b"ply":
        raise ValueError("it does not begin with ply")
    order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    for _ in range(_LONGEST_HEADER):
        words = stream.readline().decode("utf-8", errors="replace").split()
        if words[:1] == ["format"]:
            order = _ORDERS[words[1]]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            kind = "list" if words[1] == "list" else _TYPES[words[1]]
            elements[-1][2].append((words[-1], kind))
        elif words[:1] == ["end_header"]:
            break
    if order is None or not elements:
        raise ValueError("its header is not complete")
    start = stream.tell()
    for name, count, fields in elements:
        listed = any(kind == "list" for _, kind in fields)
        if name == "vertex":
            if listed:
                raise ValueError("its vertices have lists, which no cloud has")
            return order, start, count, fields
        if listed or not order:
            raise ValueError(f"its element {name} stands before the vertices")
        start += count * np.dtype([(one, f"{order}{kind}") for one, kind in fields]).itemsize
    raise ValueError("it has no vertices")
