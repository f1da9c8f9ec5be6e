"""Where a raster lies: the mapping between metres and pixels, with pixel centres throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Grid:
    """A north-up raster of square cells.

    Pixel coordinates are (column, row) as float64 with (0, 0) the *centre* of the top-left cell, so a
    point at pixel (c, r) lies at x = west + (c + 0.5) * cell and y = north - (r + 0.5) * cell.

    Attributes:
        west, north: outer top-left corner of the raster in metres (levelled work frame).
        cell: edge of a cell in metres.
        width, height: number of columns and rows.

    """

    west: float
    north: float
    cell: float
    width: int
    height: int

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an image on this grid: (height, width)."""
        return self.height, self.width

    def to_pixel(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take (n, 2) metres to (n, 2) pixel coordinates (column, row)."""
        xy = np.asarray(xy, np.float64)
        return np.stack(
            [(xy[:, 0] - self.west) / self.cell - 0.5, (self.north - xy[:, 1]) / self.cell - 0.5], axis=1
        )

    def to_metres(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take (n, 2) pixel coordinates (column, row) to (n, 2) metres: Eq. 5 with pixel centres."""
        pixel = np.asarray(pixel, np.float64)
        x = self.west + (pixel[:, 0] + 0.5) * self.cell
        y = self.north - (pixel[:, 1] + 0.5) * self.cell
        return np.stack([x, y], axis=1)

    def cells(self, xy: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return column and row of the cells that hold (n, >=2) points, in metres, in the grid or not."""
        scale = 1.0 / self.cell
        column = np.floor((xy[:, 0] - self.west) * scale).astype(np.int64)
        row = np.floor((self.north - xy[:, 1]) * scale).astype(np.int64)
        return column, row

    def near(self, xy: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return indices of the (n, >=2) points, in metres, in the grid or less than a cell from it.

        It takes a fifth of the time of `cells`, where most points lie elsewhere.
        """
        x, y = xy[:, 0], xy[:, 1]
        found = x >= self.west - self.cell
        found &= x <= self.west + (self.width + 1) * self.cell
        found &= y <= self.north + self.cell
        found &= y >= self.north - (self.height + 1) * self.cell
        return np.flatnonzero(found)

    def part(self, rows: slice, columns: slice) -> Grid:
        """Return the grid of some rows and columns, each from start to stop and inside this one."""
        west, north = self.west + columns.start * self.cell, self.north - rows.start * self.cell
        return Grid(west, north, self.cell, columns.stop - columns.start, rows.stop - rows.start)

    def holds(self, column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which of (n,) columns and rows lie in the grid."""
        return (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
