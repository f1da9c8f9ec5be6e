"""E57: scans, each with its pose, by pye57 (libE57Format)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import PointTable
from mtpcr_geo.core.errors import InputError, MissingPartError
from mtpcr_geo.io.file_cloud import FileCloud, named, reported

if TYPE_CHECKING:
    from pyproj import CRS

_NAMES = {"cartesianX": "x", "cartesianY": "y", "cartesianZ": "z", "intensity": "intensity"}
_NAMES.update(colorRed="red", colorGreen="green", colorBlue="blue")


class E57Cloud(FileCloud):
    """All scans of an E57 file in their common frame, read a scan at a time; invalid points are left out."""

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name; the number of the scan is the point source id."""
        with _opened(self.path) as file:
            for number in range(file.scan_count):
                data = file.read_scan(number, intensity=True, colors=True, ignore_missing_fields=True)
                for start in range(0, len(data["cartesianX"]), size):
                    yield self._table(data, slice(start, start + size), number + 1)

    @staticmethod
    def _table(data: dict[str, NDArray[Any]], part: slice, number: int) -> PointTable:
        columns = {_NAMES[name]: values[part] for name, values in data.items() if name in _NAMES}
        table = named(columns)
        table["PointSourceId"] = np.full(len(columns["x"]), number, np.uint16)
        return table


def open_file(path: Path, crs: CRS | None) -> E57Cloud:
    """Open an E57 file; its headers are read, and which points are valid, where a header tells of such.

    Raises:
        InputError: if it is none, or holds no scan.
        MissingPartError: if pye57 is not installed.

    """
    with reported(path), _opened(path) as file:
        if not file.scan_count:
            raise InputError(f"{path} holds no scan; export its points as well, not its images alone")
        count = sum(_valid_points(file, number) for number in range(file.scan_count))
        stated = crs or _stated_crs(file)
    return E57Cloud(path, stated, "E57", int(count))


def _valid_points(file: Any, number: int) -> int:
    """Return how many points of a scan `read_scan` gives: all, but for those that are marked as invalid."""
    header = file.get_header(number)
    state = "cartesianInvalidState" if "cartesianX" in header.point_fields else "sphericalInvalidState"
    count = int(header.point_count)
    if state not in header.point_fields or not count:
        return count
    data, buffers = file.make_buffers([state], count)
    header.points.reader(buffers).read()
    return int((data[state] == 0).sum())


def _stated_crs(file: Any) -> CRS | None:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    root = file.root
    if not root.isDefined("coordinateMetadata"):
        return None
    try:
        return CRS.from_user_input(root["coordinateMetadata"].value())
    except (CRSError, UnicodeError):
        return None


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file, and turn what its library raises into a ValueError of one line."""
    try:
        import pye57
    except ImportError as error:
        raise MissingPartError(f'E57 needs pye57 ({error}): pip install "mtpcr-geo[formats]"') from error
    try:
        with pye57.E57(str(path)) as file:
            yield file
    except pye57.libe57.E57Exception as error:
        raise ValueError((str(error).splitlines() or ["no E57"])[0]) from error
