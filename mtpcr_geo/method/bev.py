"""Bird's-eye-view height rasters: highest z, lowest z and count per cell, streamed (Eq. 2)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev

Floats = NDArray[np.float64]

MAX_CELLS = 64_000_000
"""Cells beyond which a raster is refused: 0.8 GiB for the three bands."""

OCCUPANCY_CELL_M = 2.0
FINEST_AUTO_CELL_M = 1.0
COARSEST_AUTO_CELL_M = 8.0
POINTS_PER_CELL = 1.2
"""Mean points per cell at which a raster has few holes and still resolves eaves and crowns."""


def grid_around(minimum: Floats, maximum: Floats, cell: float) -> Grid:
    """Lay the smallest grid over given bounds whose lines fall on whole multiples of the cell.

    Args:
        minimum, maximum: (2,) or (3,) bounds, metres.
        cell: edge of a cell, metres.

    Raises:
        RegistrationError: if the raster would not fit into memory at that cell size.

    """
    west, south = np.floor(np.asarray(minimum[:2]) / cell)
    east, north = np.floor(np.asarray(maximum[:2]) / cell) + 1
    width, height = int(east - west), int(north - south)
    if width * height > MAX_CELLS:
        raise RegistrationError(
            f"a raster of {width} x {height} cells of {cell:g} m is too large; "
            "give a coarser --cell, or crop the cloud to the place it shares with the other one"
        )
    return Grid(float(west * cell), float(north * cell), cell, width, height)


class Rasteriser:
    """Collects points into a height raster, chunk by chunk: memory is that of the raster.

    Args:
        grid: where the raster lies; points outside it are left out.

    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        size = grid.width * grid.height
        self._top = np.full(size, -np.inf, np.float32)
        self._low = np.full(size, np.inf, np.float32)
        self._count = np.zeros(size, np.uint32)

    def add(self, xyz: Floats) -> None:
        """Add (n, 3) points in the grid's metres."""
        grid = self.grid
        column, row = self._cells(xyz)
        inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
        cell = row * grid.width + column
        z = xyz[:, 2].astype(np.float32)
        if not inside.all():
            cell, z = cell[inside], z[inside]
        np.maximum.at(self._top, cell, z)
        np.minimum.at(self._low, cell, z)
        self._count += np.bincount(cell, minlength=len(self._count)).astype(np.uint32)

    def _cells(self, xyz: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the column and the row of (n, 3) points, inside the raster or not."""
        grid = self.grid
        column = np.floor((xyz[:, 0] - grid.west) * (1.0 / grid.cell)).astype(np.int64)
        row = np.floor((grid.north - xyz[:, 1]) * (1.0 / grid.cell)).astype(np.int64)
        return column, row

    def finish(self) -> Bev:
        """Return the raster of everything added so far."""
        empty = self._count == 0
        top = np.where(empty, np.float32(np.nan), self._top).reshape(self.grid.shape)
        low = np.where(empty, np.float32(np.nan), self._low).reshape(self.grid.shape)
        return Bev(self.grid, top, low, self._count.reshape(self.grid.shape))


def rasterise(chunks: Iterable[Floats], grid: Grid) -> Bev:
    """Rasterise streamed (n, 3) points on a grid (Eq. 2, with pixel centres)."""
    rasteriser = Rasteriser(grid)
    for chunk in chunks:
        rasteriser.add(chunk)
    return rasteriser.finish()


def coarsen(bev: Bev, factor: int) -> Bev:
    """Join ``factor`` x ``factor`` cells into one, exactly as if rasterised at the coarser cell.

    The coarser grid starts on a whole multiple of its own cell, so coarsened rasters of one frame
    stay aligned with each other.
    """
    if factor == 1:
        return bev
    grid = bev.grid
    cell = grid.cell * factor
    column0 = round(grid.west / grid.cell) % factor
    row0 = round(-grid.north / grid.cell) % factor
    width = -(-(grid.width + column0) // factor)
    height = -(-(grid.height + row0) // factor)
    pad = (
        (row0, height * factor - grid.height - row0),
        (column0, width * factor - grid.width - column0),
    )
    blocks = (height, factor, width, factor)

    def joined(band: NDArray[np.float32], fill: float, pick: np.ufunc) -> NDArray[np.float32]:
        filled = np.where(np.isnan(band), np.float32(fill), band)
        padded = np.pad(filled, pad, constant_values=fill).reshape(blocks)
        return np.asarray(pick.reduce(pick.reduce(padded, axis=3), axis=1))

    count = np.pad(bev.count, pad).reshape(blocks).sum(axis=(1, 3), dtype=np.uint32)
    top = joined(bev.top, -np.inf, np.maximum)
    low = joined(bev.low, np.inf, np.minimum)
    empty = count == 0
    top[empty] = np.nan
    low[empty] = np.nan
    coarse = Grid(grid.west - column0 * grid.cell, grid.north + row0 * grid.cell, cell, width, height)
    return Bev(coarse, top, low, count)


@dataclass(frozen=True)
class Density:
    """How densely a cloud covers the ground.

    Attributes:
        area_m2: area of the occupied cells of 2 m.
        per_m2: points per occupied square metre.

    """

    area_m2: float
    per_m2: float


def density(xyz: Floats, count: int) -> Density:
    """Measure the density over occupied area, not over the bounding box (cf. Eq. 1).

    Args:
        xyz: (n, 3) the cloud, or a uniform sample of it, metres.
        count: number of points in the whole cloud.

    """
    low, high = transforms.bounds(xyz[:, :2])
    grid = grid_around(low, high, OCCUPANCY_CELL_M)
    area = int((rasterise([xyz], grid).count > 0).sum()) * OCCUPANCY_CELL_M**2
    return Density(area, count / area)


def choose_cell(*densities: Density, finest: float = FINEST_AUTO_CELL_M) -> float:
    """Choose one cell size for both rasters, metres: set by the sparser cloud, in steps of half a metre.

    Args:
        densities: of the clouds.
        finest: no finer than this, metres.

    """
    sparsest = min(d.per_m2 for d in densities)
    wanted = np.sqrt(POINTS_PER_CELL / sparsest)
    return float(np.clip(np.round(wanted * 2) / 2, finest, COARSEST_AUTO_CELL_M))
