"""Text with a point a line: XYZ, CSV, TXT, ASC, and Leica's PTS."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import CHUNK_POINTS, PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.file_cloud import FileCloud, named, reported, require_xyz
from mtpcr_geo.io.formats.text_found import LOOKED_AT, empty_place, found_layout, to_text
from mtpcr_geo.io.formats.text_layout import LEFT_OUT, TextLayout

if TYPE_CHECKING:
    from pyproj import CRS

_LONGEST_HEAD = 100
_BATCH = 200_000  # lines read at once
_UNNAMED = {
    3: "",
    4: "Intensity",
    6: "Red Green Blue",
    7: "Intensity Red Green Blue",
    9: "Red Green Blue nx ny nz",
}
"""Columns behind x, y and z by their number, where no line names them."""
_PLACES = {"easting": "x", "east": "x", "northing": "y", "north": "y", "height": "z", "elevation": "z"}
_WHOLE_DTYPES = (np.uint8, np.uint16, np.int32, np.int64)


class TextCloud(FileCloud):
    """Points in lines of text, streamed; opening reads them once, to know their number and kinds."""

    def __init__(
        self,
        path: Path,
        crs: CRS | None,
        count: int,
        names: list[str],
        kinds: list[NDArray[np.generic]],
        head: int,
        layout: TextLayout,
    ) -> None:
        super().__init__(path, crs, "PTS" if path.suffix.lower() == ".pts" else "text", count)
        self.names, self.kinds, self.head, self.layout = names, kinds, head, layout

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name."""
        with self.path.open("rb") as stream:
            to_text(self.path, stream)
            for _ in range(self.head):
                stream.readline()
            for rows in rows_of(stream, size, layout=self.layout):
                yield named(
                    {
                        name: rows[:, i].astype(kind.dtype)
                        for i, (name, kind) in enumerate(zip(self.names, self.kinds, strict=True))
                    }
                )


def open_file(path: Path, crs: CRS | None, layout: TextLayout | None = None) -> TextCloud:
    """Open a text file: columns as declared, or by its first line where that names them, or by their number.

    Raises:
        InputError: if its lines are no points, or a coordinate is missing.

    """
    layout = layout or TextLayout()
    with reported(path), path.open("rb") as stream:
        to_text(path, stream)
        layout = _completed(path, stream, layout)
        names, head = _declared_head(stream, layout) if layout.columns else _head(path, stream, layout)
        count, low, high, whole = 0, np.array([]), np.array([]), np.array([])
        for rows in rows_of(stream, CHUNK_POINTS, layout=layout):
            if not count:
                low, high = rows.min(axis=0), rows.max(axis=0)
                whole = np.ones(rows.shape[1], bool)
            count += len(rows)
            low, high = np.minimum(low, rows.min(axis=0)), np.maximum(high, rows.max(axis=0))
            whole = whole & (rows == np.rint(rows)).all(axis=0)
        if not count:
            raise InputError(f"{path} holds no points; give a text file with x, y and z in each line")
        if len(low) < 3:
            raise InputError(f"{path} has {len(low)} numbers in a line; x, y and z are wanted")
        names = names or ["x", "y", "z", *_names_of(len(low), low, high, whole)]
        if len(names) != len(low):
            raise InputError(f"{path} names {len(names)} columns and has {len(low)}; correct its first line")
    require_xyz(path, names)
    kinds = [_kind(name, bool(whole[i]), float(low[i]), float(high[i])) for i, name in enumerate(names)]
    cloud = TextCloud(path, crs, count, names, kinds, head, layout)
    place = [[name.lower() for name in names].index(axis) for axis in "xyz"]
    cloud.minimum, cloud.maximum = low[place], high[place]
    if layout.separator and np.isnan(cloud.minimum).any():
        _check_complete(cloud, [layout.kept[i] for i in place] if layout.columns else place)
    return cloud


def _completed(path: Path, stream: BinaryIO, layout: TextLayout) -> TextLayout:
    """Return a layout completed by the first lines, the stream where it was."""
    begin = stream.tell()
    for _ in range(layout.skip or 0):
        stream.readline()
    layout = found_layout(path, list(islice(stream, LOOKED_AT)), layout)
    stream.seek(begin)
    return layout


def _check_complete(cloud: TextCloud, places: list[int]) -> None:
    """Refuse a file in which x, y or z of a point is empty.

    Raises:
        InputError: naming the line.

    """
    with cloud.path.open("rb") as stream:
        found = empty_place(stream, cloud.layout, places, cloud.head)
    if found is not None:
        raise InputError(
            f"line {found[0]} of {cloud.path} has no {'xyz'[found[1]]}; complete it, or leave the line out"
        )


def rows_of(
    stream: BinaryIO, size: int, most: int | None = None, layout: TextLayout | None = None
) -> Iterator[Floats]:
    """Yield the numbers of lines, (n, columns) float64 with n <= size, from where a stream stands.

    Lines of one number, with which PTS files count, and empty ones are passed over.

    Raises:
        ValueError: if a line holds something else, or another number of columns.

    """
    layout = layout or TextLayout()
    between = (layout.separator or "").encode()
    columns, left = 0, most
    kept: list[Floats] = []
    while left is None or left > 0:
        wanted = min(_BATCH, size) if left is None else min(_BATCH, size, left)
        lines = [_separated(line, layout) for line in islice(stream, wanted)]
        if not lines:
            return
        lines = [line for line in lines if len(line.split(between or None, 2)) > 1]
        if not lines:
            continue
        if layout.columns:
            _check_number(lines[0].split(between or None), layout)
        rows = np.loadtxt(
            [line.decode("utf-8" if layout.columns else "ascii") for line in lines],
            ndmin=2,
            delimiter=layout.separator or None,
            usecols=layout.kept or None,
        )
        if columns and rows.shape[1] != columns:
            raise ValueError(f"a line has {rows.shape[1]} numbers and others {columns}")
        columns = rows.shape[1]
        if left is not None:
            left -= len(rows)
        kept.append(rows)
        yield kept.pop()


def _separated(line: bytes, layout: TextLayout) -> bytes:
    """Return a line without its comment, with a decimal point, and columns apart; empty ones hold nan."""
    line = line.split(b"#")[0].replace(b'"', b"").strip(b"\r\n ")
    if layout.separator is None:
        # a decimal comma leaves semicolons, tabs and blanks
        line = re.sub(rb"[;\t]+" if layout.decimal == "," else rb"[,;\t]+", b" ", line)
    elif layout.separator:
        sign = layout.separator.encode()
        if sign + sign in line or b" " in line or line.endswith(sign):
            line = re.sub(re.escape(sign) + rb"[ ]*(?=" + re.escape(sign) + rb"|$)", sign + b"nan", line)
        if line.startswith(sign):
            line = b"nan" + line
    return line.replace(b",", b".") if layout.decimal == "," else line


def _check_number(fields: list[bytes], layout: TextLayout) -> None:
    """Refuse a number of columns that is not the declared one.

    Raises:
        InputError: saying both.

    """
    if len(fields) != len(layout.columns):
        raise InputError(
            f"a line of the text file has {len(fields)} columns, and {len(layout.columns)} are named "
            f"({' '.join(layout.columns)}); name each, {LEFT_OUT} for those to leave out, and check the "
            "separator"
        )


def _declared_head(stream: BinaryIO, layout: TextLayout) -> tuple[list[str], int]:
    """Return the declared names of the columns that are read, and the lines before the points."""
    names = [_PLACES.get(layout.columns[i].lower(), layout.columns[i]) for i in layout.kept]
    if layout.skip is not None:
        for _ in range(layout.skip):
            stream.readline()
        return names, layout.skip
    for number in range(_LONGEST_HEAD):
        place = stream.tell()
        line = _separated(stream.readline(), layout).decode("utf-8", errors="replace")
        fields = line.split(layout.separator or None)
        if fields and _are_numbers([fields[i] for i in layout.kept if i < len(fields)]) and len(fields) > 1:
            stream.seek(place)
            return names, number
    raise ValueError("none of its first lines is a point")


def _head(path: Path, stream: BinaryIO, layout: TextLayout) -> tuple[list[str], int]:
    """Return the names of the columns, if a line gives them, and the lines before the points.

    Raises:
        InputError: if a line names columns, and x, y and z are not among them.

    """
    names: list[str] = []
    other: list[str] = []
    skip = layout.skip or 0
    for _ in range(skip):
        stream.readline()
    for number in range(skip, skip + _LONGEST_HEAD):
        place = stream.tell()
        line = stream.readline()
        if layout.decimal == ",":
            line = _separated(line, layout)
        text = line.decode("utf-8", errors="replace").strip().lstrip("\ufeff")
        words = [word.strip().strip('"') for word in re.split(r"[,;\s]+", text.lstrip("#/ ")) if word.strip()]
        if line and (not words or not _are_numbers(words) or text.startswith(("#", "//"))):
            words = [_PLACES.get(word.lower(), word) for word in words]
            if {"x", "y", "z"} <= {word.lower() for word in words}:
                names = words
            elif not text.startswith(("#", "//")):
                other = words
            continue
        stream.seek(place)
        if other and not names and len(other) == len(words):
            require_xyz(path, other)
        return names, number
    raise ValueError("none of its first lines is a point")


def _are_numbers(words: list[str]) -> bool:
    try:
        return bool([float(word) for word in words])
    except ValueError:
        return False


def _names_of(count: int, low: Floats, high: Floats, whole: Floats) -> list[str]:
    usual = _UNNAMED.get(count, "").split()
    colours = [3 + i for i, name in enumerate(usual) if name in ("Red", "Green", "Blue")]
    if colours and not (whole[colours].all() and low[colours].min() >= 0 and high[colours].max() <= 65535):
        usual = []
    return usual or [f"column_{i}" for i in range(4, count + 1)]


def _kind(name: str, whole: bool, low: float, high: float) -> NDArray[np.generic]:
    """Return an empty array of the smallest type that holds a column."""
    if whole and name.lower() not in ("x", "y", "z"):
        for kind in _WHOLE_DTYPES:
            if np.iinfo(kind).min <= low and high <= np.iinfo(kind).max:
                return np.empty(0, kind)
    return np.empty(0, np.float64)
