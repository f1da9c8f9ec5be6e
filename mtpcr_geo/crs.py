"""Coordinate reference systems, and the metric work frame in which everything is computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo import geometry

if TYPE_CHECKING:
    from pyproj import CRS

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WorkFrame:
    """The frame of all computation: the target's projected metric CRS, shifted to an integer origin.

    Attributes:
        crs: the projected metric CRS, or None for a local frame in metres.
        origin: (3,) whole metres, subtracted from CRS coordinates.

    """

    crs: CRS | None
    origin: Floats


@dataclass(frozen=True)
class FrameLink:
    """The way between a file's coordinates and work coordinates of its side.

    Attributes:
        file_crs: the CRS of the file's coordinates, or None for local.
        origin: (3,) whole metres near the cloud, subtracted to come to work coordinates.

    """

    file_crs: CRS | None
    origin: Floats

    def to_work(self, xyz: Floats) -> Floats:
        """Take (n, 3) file coordinates to (n, 3) work coordinates in metres."""
        return np.asarray(xyz, np.float64) - self.origin

    def to_file(self, xyz: Floats) -> Floats:
        """Take (n, 3) work coordinates in metres to (n, 3) file coordinates."""
        return np.asarray(xyz, np.float64) + self.origin

    @property
    def T_work_file(self) -> Floats:
        """4x4 from file to work coordinates."""
        return geometry.translation(-self.origin)

    @property
    def T_file_work(self) -> Floats:
        """4x4 from work to file coordinates."""
        return geometry.translation(self.origin)
