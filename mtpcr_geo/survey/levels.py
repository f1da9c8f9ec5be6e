"""Parts of a mosaic as the search takes them: channels of a window at a level, in metres from an origin."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.match.search import Layer
from mtpcr_geo.method.images import channels
from mtpcr_geo.survey.mosaic import FACTORS, Mosaic

MARGIN_M = 24.0
"""Read beyond a window on each side: twice the width of the blur that band-passes heights."""


@dataclass(frozen=True)
class Ground:
    """A mosaic seen from an origin near where is searched.

    Attributes:
        mosaic: the blocks.
        origin: (2,) metres from the CRS's origin, whole cells of every level.
        bounds: (2, 2) where there is anything, metres from the origin.

    """

    mosaic: Mosaic
    origin: Floats
    bounds: Floats

    @classmethod
    def around(cls, mosaic: Mosaic, bounds: Floats) -> Ground:
        """See a mosaic from the middle of bounds, (2, 2) in metres from the CRS's origin."""
        step = mosaic.frame.cell_m * FACTORS[-1]
        origin = np.round(np.asarray(bounds).mean(axis=0) / step) * step
        return cls(mosaic, origin, np.asarray(bounds, np.float64) - origin)

    @property
    def cell_m(self) -> float:
        """Edge of the finest cell, metres."""
        return self.mosaic.frame.cell_m

    def bev(self, bounds: Floats, factor: int) -> Bev:
        """Return the raster of a level that covers bounds, (2, 2) metres from the origin."""
        found = self.mosaic.read(np.asarray(bounds) + self.origin, factor)
        return replace(found, grid=self._shifted(found.grid))

    def layer(self, bounds: Floats, factor: int) -> Layer:
        """Return the channels of a level that cover bounds and a margin around them."""
        bev = self.bev(widened(bounds, MARGIN_M), factor)
        return Layer(bev.grid, channels(bev))

    def _shifted(self, grid: Grid) -> Grid:
        return Grid(
            grid.west - float(self.origin[0]),
            grid.north - float(self.origin[1]),
            grid.cell,
            grid.width,
            grid.height,
        )


def widened(bounds: Floats, by_m: float) -> Floats:
    """Return bounds, (2, 2), widened by so much on each side."""
    return np.asarray(np.asarray(bounds, np.float64) + np.array([[-by_m], [by_m]]))


def windows(bounds: Floats, edge_m: float) -> Iterator[Floats]:
    """Yield windows of equal size, none larger than an edge, that cover bounds side by side."""
    low, high = np.asarray(bounds, np.float64)
    counts = np.maximum(np.ceil((high - low) / edge_m).astype(int), 1)
    size = (high - low) / counts
    for row in range(int(counts[1])):
        for column in range(int(counts[0])):
            corner = low + size * np.array([column, row])
            yield np.stack([corner, corner + size])
