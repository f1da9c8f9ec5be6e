"""BEVs on other grids: where a transform puts a cloud, and where both clouds are compared cell by cell.

A cloud that is held in memory is rasterised anew, from its points. Of one that is not only the raster is at
hand, whose cells tell no place within them: each cell of the new grid takes the nearest one, which lies up to
half a cell beside it in each direction, and by the same all over the raster where the yaw is near nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Image, Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair, Side
from mtpcr_geo.method import bev as rasters

_WARP_CELLS = 500_000
_POINTS_AT_ONCE = 262_144
_ALIGNED = 1e-6
"""Of a cell, by which two grids may lie beside each other and still count as one lattice."""


def placed(side: Side, T_work: Floats, grid: Grid) -> Bev:
    """Return a side's raster where a transform puts its cloud, on a given grid.

    Args:
        side: with a BEV; its points are rasterised where they are all at hand, else its cells are resampled.
        T_work: 4x4 from the side's work coordinates to those of the grid, metres.
        grid: where the raster is to lie.

    Raises:
        ValueError: if the side has no BEV yet.

    """
    if side.bev is None:
        raise ValueError(f"the {side.role} has no BEV yet")
    if not side.complete:
        return warp_bev(side.bev, T_work @ transforms.inverse(side.T_level_work), grid)
    starts = range(0, len(side.sample), _POINTS_AT_ONCE)
    parts = (side.sample[start : start + _POINTS_AT_ONCE] for start in starts)
    return rasters.rasterise((transforms.apply(T_work, part) for part in parts), grid)


def placed_whole(side: Side, T_work: Floats) -> Bev:
    """Return a side's whole raster where a transform puts its cloud, see `placed`.

    The grid has the side's cell size and is aligned to whole cells.
    """
    if side.bev is None:
        raise ValueError(f"the {side.role} has no BEV yet")
    if side.complete:
        low, high = transforms.bounds(transforms.apply(T_work, side.sample))
        return placed(side, T_work, rasters.grid_around(low, high, side.bev.grid.cell))
    T_level = T_work @ transforms.inverse(side.T_level_work)
    return warp_bev(side.bev, T_level, grid_around(side.bev, T_level))


def cut_to(bev: Bev, grid: Grid) -> Bev | None:
    """Return the cells of a raster that lie on a grid, empty where it has none; None if they do not nest.

    Args:
        bev: the raster.
        grid: where the result is to lie.

    """
    column, row = (grid.west - bev.grid.west) / grid.cell, (bev.grid.north - grid.north) / grid.cell
    first = np.rint([row, column]).astype(int)
    if abs(grid.cell / bev.grid.cell - 1.0) * max(grid.shape) > _ALIGNED:
        return None
    if np.abs(first - [row, column]).max() > _ALIGNED:
        return None
    low = np.clip(first, 0, bev.grid.shape)
    high = np.clip(first + grid.shape, low, bev.grid.shape)
    from_ = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    to = tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))
    top, least = np.full((2, *grid.shape), np.nan, np.float32)
    count = np.zeros(grid.shape, np.uint32)
    for band, values in ((top, bev.top), (least, bev.low), (count, bev.count)):
        band[to] = values[from_]
    return Bev(grid, top, least, count)


def snapped(grid: Grid, lattice: Grid) -> Grid:
    """Return the grid that covers another one with cells of a lattice of the same cell."""
    cell = lattice.cell
    west, south = grid.west, grid.north - grid.height * grid.cell
    east = grid.west + grid.width * grid.cell
    column0, column1 = np.floor((west - lattice.west) / cell), np.ceil((east - lattice.west) / cell)
    row0, row1 = np.floor((lattice.north - grid.north) / cell), np.ceil((lattice.north - south) / cell)
    return Grid(
        float(lattice.west + column0 * cell),
        float(lattice.north - row0 * cell),
        cell,
        max(1, int(column1 - column0)),
        max(1, int(row1 - row0)),
    )


def registered_bev(pair: Pair) -> Bev:
    """Return the source's BEV where the transform places it, in upright target work coordinates.

    The grid has the source's cell size and is aligned to whole cells, so it nests with the target's
    where both cells agree. See `placed` for what its cells hold.

    Raises:
        ValueError: if the pair is not solved or the source has no BEV yet.

    """
    if pair.T_target_source is None or pair.source.bev is None:
        raise ValueError("the pair needs a transform and the source a BEV to be laid over the target")
    return placed_whole(pair.source, pair.T_target_source)


def grid_around(bev: Bev, T_to_bev: Floats) -> Grid:
    """Return the grid, aligned to whole cells, that holds a BEV's filled cells moved by a 4x4 transform."""
    cell = bev.grid.cell
    filled = np.isfinite(bev.top)
    rows = np.flatnonzero(filled.any(axis=1))
    if len(rows) == 0:
        return Grid(0.0, cell, cell, 1, 1)
    # the ends of the rows, at the least and the greatest height of each, bound all cells between them
    first = filled[rows].argmax(axis=1)
    last = bev.grid.width - 1 - filled[rows, ::-1].argmax(axis=1)
    ends = np.column_stack([np.concatenate([first, last]), np.concatenate([rows, rows])])
    plan = bev.grid.to_metres(ends.astype(np.float64))
    heights = [np.fmin.reduce(bev.low[rows], axis=1), np.fmax.reduce(bev.top[rows], axis=1)]
    xyz = np.concatenate([np.column_stack([plan, np.tile(height, 2)]) for height in heights])
    moved = transforms.apply(T_to_bev, xyz)[:, :2]
    low = np.floor(moved.min(axis=0) / cell - 0.5)
    high = np.ceil(moved.max(axis=0) / cell + 0.5)
    width, height = (int(size) for size in high - low)
    return Grid(float(low[0]) * cell, float(high[1]) * cell, cell, width, height)


def warp_bev(bev: Bev, T_to_bev: Floats, grid: Grid) -> Bev:
    """Resample a BEV to another grid under a 4x4 rigid transform that is mostly yaw and shift.

    Every cell of `grid` takes the nearest cell of `bev`; heights are moved exactly, and a small tilt
    is allowed for by two fixed-point steps on the height of what is found. Where they find nothing, as
    between the lines of a thin scan, the cells of `bev` that come to lie there are taken.

    Args:
        bev: what to resample.
        T_to_bev: 4x4 from the BEV's coordinates to those of `grid`, metres.
        grid: where to resample to.

    """
    filled = np.isfinite(bev.top)
    height = float(np.median(bev.top[filled])) if filled.any() else 0.0
    top = np.full(grid.shape, np.nan, np.float32)
    low = np.full(grid.shape, np.nan, np.float32)
    count = np.zeros(grid.shape, np.uint32)
    rows_at_once = max(1, _WARP_CELLS // grid.width)
    for start in range(0, grid.height, rows_at_once):
        rows = slice(start, min(start + rows_at_once, grid.height))
        found, place, index = _source_cells(bev, filled, T_to_bev, grid, rows, height)
        for band, values in ((top, bev.top), (low, bev.low)):
            moved = _move_z(T_to_bev, *place, values.ravel()[index])
            np.copyto(band[rows], moved, where=found, casting="same_kind")
        np.copyto(count[rows], bev.count.ravel()[index], where=found)
    if _tilts(T_to_bev):
        _add_missed(bev, filled, T_to_bev, Bev(grid, top, low, count))
    return Bev(grid, top, low, count)


def _tilts(T: Floats) -> bool:
    return bool(abs(T[2, 2]) < 1.0 - 1e-7)


def _add_missed(bev: Bev, filled: Mask, T_to_bev: Floats, warped: Bev) -> None:
    """Move cells of a BEV to where a 4x4 transform places them, into cells that are still empty."""
    grid = warped.grid
    row, column = np.nonzero(filled)
    plan = bev.grid.to_metres(np.column_stack([column, row]).astype(np.float64))
    z_top, z_low = bev.top[row, column], bev.low[row, column]
    moved = transforms.apply(T_to_bev, np.column_stack([plan, z_top]))
    to_column, to_row = grid.cells(moved)
    fits = grid.holds(to_column, to_row)
    fits[fits] = warped.count[to_row[fits], to_column[fits]] == 0
    place = (to_row[fits], to_column[fits])
    high = moved[fits, 2].astype(np.float32)
    least = transforms.apply(T_to_bev, np.column_stack([plan[fits], z_low[fits]]))[:, 2].astype(np.float32)
    for band, values, pick in ((warped.top, high, np.fmax), (warped.low, least, np.fmin)):
        pick.at(band, place, values)
    np.add.at(warped.count, place, bev.count[row[fits], column[fits]])


def _source_cells(
    bev: Bev, filled: Mask, T_to_bev: Floats, grid: Grid, rows: slice, height: float
) -> tuple[Mask, tuple[Floats, Floats], NDArray[np.int64]]:
    """Return the BEV's cell for each cell of some rows of a grid.

    Returns:
        (h, w) whether one is there; (h, w) each, east and north in the BEV, metres; (h, w) its flat index.

    """
    T, own = transforms.inverse(T_to_bev), bev.grid
    # columns and rows of a grid are each one coordinate: sums of a row and a column stand for all cells
    x = grid.west + (np.arange(grid.width) + 0.5) * grid.cell
    y = grid.north - (np.arange(rows.start, rows.stop)[:, None] + 0.5) * grid.cell
    z: Any = (T_to_bev @ np.array([0.0, 0.0, height, 1.0]))[2]
    for last in (False, False, True) if _tilts(T_to_bev) else (True,):
        east = (T[0, 0] * x + T[0, 3]) + (T[0, 1] * y + T[0, 2] * z)
        north = (T[1, 0] * x + T[1, 3]) + (T[1, 1] * y + T[1, 2] * z)
        column = np.rint((east - own.west) / own.cell - 0.5).astype(np.int64)
        row = np.rint((own.north - north) / own.cell - 0.5).astype(np.int64)
        inside = own.holds(column, row)
        index = np.where(inside, row * own.width + column, 0)
        found = inside & filled.ravel()[index]
        if not last:
            z = np.where(found, _move_z(T_to_bev, east, north, bev.top.ravel()[index]), z)
    return found, (east, north), index


def _move_z(T: Floats, east: Floats, north: Floats, z: Image) -> Floats:
    """Return heights after T of points at places with heights `z`, all of one shape."""
    moved = T[2, 2] * z + T[2, 3]
    if T[2, 0] == T[2, 1] == 0.0:
        return np.asarray(moved)
    return np.asarray(moved + (T[2, 0] * east + T[2, 1] * north))
