"""PCD of the Point Cloud Library, text, binary or compressed, by pypcd4."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import PointTable
from mtpcr_geo.core.errors import MissingPartError
from mtpcr_geo.io.file_cloud import FileCloud, named, reported, require_xyz

if TYPE_CHECKING:
    from pyproj import CRS


class PcdCloud(FileCloud):
    """The points of a PCD file, held in memory: its compressed form can only be read whole."""

    def __init__(self, path: Path, crs: CRS | None, points: NDArray[Any]) -> None:
        super().__init__(path, crs, "PCD", len(points))
        self.points = points

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name; colours, packed into one number, are taken apart."""
        for start in range(0, len(self.points), size):
            part = self.points[start : start + size]
            columns: dict[str, NDArray[Any]] = {}
            for name in part.dtype.names or ():
                if name.lower() in ("rgb", "rgba"):
                    packed = np.ascontiguousarray(part[name]).view(np.uint32)
                    for colour, shift in (("red", 16), ("green", 8), ("blue", 0)):
                        columns[colour] = (packed >> np.uint32(shift) & np.uint32(255)).astype(np.uint8)
                elif not name.startswith("_"):  # padding
                    columns[name] = np.array(part[name])
            yield named(columns)


def open_file(path: Path, crs: CRS | None) -> PcdCloud:
    """Read a PCD file; points that are not finite, with which organised clouds are filled up, are left out.

    Raises:
        InputError: if it is none.
        MissingPartError: if pypcd4 is not installed.

    """
    try:
        from pypcd4 import PointCloud
    except ImportError as error:
        raise MissingPartError(f'PCD needs pypcd4 ({error}): pip install "mtpcr-geo[formats]"') from error
    with reported(path):
        points = np.asarray(PointCloud.from_path(path).pc_data).reshape(-1)
        require_xyz(path, points.dtype.names or ())
        finite = np.ones(len(points), bool)
        for name in points.dtype.names or ():
            if name.lower() in ("x", "y", "z"):
                finite &= np.isfinite(points[name])
    return PcdCloud(path, crs, points if finite.all() else points[finite])
