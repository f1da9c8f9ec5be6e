"""Leica's PTX: scans in rows and columns of text, each with its pose."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import PointTable
from mtpcr_geo.io.file_cloud import FileCloud, named, reported
from mtpcr_geo.io.formats.text import rows_of

if TYPE_CHECKING:
    from pyproj import CRS

_HEAD = 8  # lines behind the two counts: place and axes of the scanner, and the 4x4


class PtxCloud(FileCloud):
    """All scans of a PTX file in their common frame; beams without a return lie on their scanner."""

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name; the number of the scan is the point source id."""
        with self.path.open("rb") as stream:
            for number, (count, T) in enumerate(_scans(stream), 1):
                for rows in rows_of(stream, size, most=count):
                    with np.errstate(over="ignore", invalid="ignore"):
                        xyz = rows[:, :3] @ T[:3, :3] + T[3, :3]
                    columns = {axis: xyz[:, i] for i, axis in enumerate("xyz")}
                    if rows.shape[1] > 3:
                        columns["intensity"] = rows[:, 3]
                    for i, colour in enumerate(("red", "green", "blue"), 4):
                        if rows.shape[1] > i:
                            columns[colour] = rows[:, i].astype(np.uint16)
                    yield {**named(columns), "PointSourceId": np.full(len(rows), number, np.uint16)}


def open_file(path: Path, crs: CRS | None) -> PtxCloud:
    """Open a PTX file; it is gone through once, to know the number of its points.

    Raises:
        InputError: if it is none.

    """
    count = 0
    with reported(path), path.open("rb") as stream:
        for points, _ in _scans(stream):
            count += points
            for _ in range(points):
                if not stream.readline():
                    raise ValueError("it ends within a scan")
    return PtxCloud(path, crs, "PTX", count)


def _scans(stream: BinaryIO) -> Iterator[tuple[int, Floats]]:
    """Yield the number of points and the 4x4 (of row vectors) of each scan, the stream before its points."""
    while True:
        line = stream.readline()
        while line and not line.strip():
            line = stream.readline()
        if not line:
            return
        columns, rows = int(line), int(stream.readline())
        head = [[float(word) for word in stream.readline().split()] for _ in range(_HEAD)]
        T = np.array(head[4:], np.float64)
        if T.shape != (4, 4):
            raise ValueError("the 4x4 of a scan is none")
        if not (np.isfinite(T).all() and np.linalg.det(T[:3, :3]) > 0):
            raise ValueError("the 4x4 of a scan mirrors it, or is no transform")
        yield columns * rows, T
