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

if TYPE_CHECKING:
    from pyproj import CRS

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
    ) -> None:
        super().__init__(path, crs, "PTS" if path.suffix.lower() == ".pts" else "text", count)
        self.names, self.kinds, self.head = names, kinds, head

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name."""
        with self.path.open("rb") as stream:
            for _ in range(self.head):
                stream.readline()
            for rows in rows_of(stream, size):
                yield named(
                    {
                        name: rows[:, i].astype(kind.dtype)
                        for i, (name, kind) in enumerate(zip(self.names, self.kinds, strict=True))
                    }
                )


def open_file(path: Path, crs: CRS | None) -> TextCloud:
    """Open a text file: columns by its first line where that names them, else by their number.

    Raises:
        InputError: if its lines are no points.

    """
    with reported(path), path.open("rb") as stream:
        names, head = _head(path, stream)
        count, low, high, whole = 0, np.array([]), np.array([]), np.array([])
        for rows in rows_of(stream, CHUNK_POINTS):
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
    cloud = TextCloud(path, crs, count, names, kinds, head)
    place = [[name.lower() for name in names].index(axis) for axis in "xyz"]
    cloud.minimum, cloud.maximum = low[place], high[place]
    return cloud


def rows_of(stream: BinaryIO, size: int, most: int | None = None) -> Iterator[Floats]:
    """Yield the numbers of lines, (n, columns) float64 with n <= size, from where a stream stands.

    Lines of one number, with which PTS files count, and empty ones are passed over.

    Raises:
        ValueError: if a line holds something else, or another number of columns.

    """
    columns, left = 0, most
    kept: list[Floats] = []
    while left is None or left > 0:
        wanted = min(_BATCH, size) if left is None else min(_BATCH, size, left)
        lines = [re.sub(rb"[,;\t]+", b" ", line).split(b"#")[0] for line in islice(stream, wanted)]
        if not lines:
            return
        lines = [line for line in lines if len(line.split(None, 2)) > 1]
        if not lines:
            continue
        rows = np.loadtxt([line.decode("ascii") for line in lines], ndmin=2)
        if columns and rows.shape[1] != columns:
            raise ValueError(f"a line has {rows.shape[1]} numbers and others {columns}")
        columns = rows.shape[1]
        if left is not None:
            left -= len(rows)
        kept.append(rows)
        yield kept.pop()


def _head(path: Path, stream: BinaryIO) -> tuple[list[str], int]:
    """Return the names of the columns, if a line gives them, and the lines before the points.

    Raises:
        InputError: if a line names columns, and x, y and z are not among them.

    """
    names: list[str] = []
    other: list[str] = []
    for number in range(100):
        place = stream.tell()
        line = stream.readline()
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
