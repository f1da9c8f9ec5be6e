"""BEVs as GeoTIFF: absolute heights, where they lie, and what the numbers mean, for any GIS."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Image, Mask
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair, Side
from mtpcr_geo.core.version import __version__
from mtpcr_geo.core.wording import visible
from mtpcr_geo.crs import WorkFrame
from mtpcr_geo.export import overviews

_CREATION = {
    "blocksize": 256,
    "compress": "deflate",
    "level": 4,
    "num_threads": "ALL_CPUS",
    "predictor": "floating_point",
    "bigtiff": "IF_SAFER",
}
_SMALLEST_OVERVIEW = 128
_WARP_CELLS = 500_000


@dataclass(frozen=True, eq=False)
class Band:
    """One band of a raster file.

    Attributes:
        values: (h, w) float32, NaN where there is none.
        description: what the band holds, in a few words.
        unit: of its values, such as "metre" or "count".
        pool: how a cell of an overview comes from those that it covers.

    """

    values: Image
    description: str
    unit: str
    pool: overviews.Pool


def write_bev(
    path: str | os.PathLike[str],
    bev: Bev,
    frame: WorkFrame,
    *,
    T_level_work: Floats | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write a BEV as a cloud optimized GeoTIFF, float32, deflated, with overviews.

    Bands: highest z, lowest z (both absolute: the origin's z is added; NaN is nodata) and the number of
    points (0 where empty). Cell edges, not centres, carry the geotransform (AREA_OR_POINT=Area). A cell of
    an overview has the highest, the lowest and the number of points of all the cells that it covers.

    Args:
        path: where to write; no other file is left beside it.
        bev: the raster, in levelled work coordinates, metres.
        frame: CRS and origin of the work coordinates that the BEV's side has.
        T_level_work: 4x4 from work to levelled coordinates. Where it is not the identity the raster's
            positions are not CRS coordinates, so the file gets no CRS; its tags state how the
            levelled frame lies.
        tags: further tags for the file.

    Raises:
        OutputError: if the file cannot be written.

    """
    bands = (
        Band(_absolute(bev.top, frame), "highest z in the cell, metres", "metre", overviews.HIGHEST),
        Band(_absolute(bev.low, frame), "lowest z in the cell, metres", "metre", overviews.LOWEST),
        Band(bev.count.astype(np.float32), "points in the cell", "count", overviews.SUM),
    )
    meaning = "absolute: highest and lowest z of the points whose plan position falls into the cell"
    write_raster(
        path, bands, bev.grid, frame, T_level_work=T_level_work, tags={"HEIGHTS": meaning, **(tags or {})}
    )


def write_raster(
    path: str | os.PathLike[str],
    bands: Sequence[Band],
    grid: Grid,
    frame: WorkFrame,
    *,
    T_level_work: Floats | None = None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write bands of one grid as a cloud optimized GeoTIFF.

    Args:
        path: where to write; no other file is left beside it.
        bands: what to write; the first is what a program shows that shows one.
        grid: where they lie, in levelled work coordinates, metres.
        frame: CRS and origin of the work coordinates.
        T_level_work: 4x4 from work to levelled coordinates, as in `write_bev`.
        tags: further tags for the file.

    Raises:
        OutputError: if the file cannot be written.

    """
    import rasterio
    from rasterio._err import CPLE_BaseError  # what rasterio.shutil.copy raises, and no RasterioError
    from rasterio.enums import ColorInterp
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.io import MemoryFile

    level = np.eye(4) if T_level_work is None else np.asarray(T_level_work, np.float64)
    upright = bool(np.array_equal(level, np.eye(4)))
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": len(bands),
        "width": grid.width,
        "height": grid.height,
        "nodata": float("nan"),
        "transform": geotransform(grid, frame.origin),
        "crs": frame.crs.to_wkt() if frame.crs is not None and upright else None,
    }
    every_tag = {
        "AREA_OR_POINT": "Area",
        "TIFFTAG_SOFTWARE": f"mtpcr_geo {__version__}",
        "CELL_SIZE": f"{grid.cell:.17g} metre",
        **_frame_tags(frame, level, upright),
        **(tags or {}),
    }
    try:
        with rasterio.Env(GDAL_PAM_ENABLED="NO"), warnings.catch_warnings():
            # a local raster with its corner at zero is georeferenced all the same
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with MemoryFile(ext=".tif") as memory:
                with memory.open(**profile, interleave="band") as out:
                    out.update_tags(**{key: visible(text) for key, text in every_tag.items()})
                    # no band is a colour
                    rest = [ColorInterp.undefined] * (len(bands) - 1)
                    out.colorinterp = [ColorInterp.gray, *rest]
                    for index, band in enumerate(bands, start=1):
                        out.set_band_description(index, band.description)
                        out.set_band_unit(index, band.unit)
                        out.write(band.values, index)
                pools = [band.pool for band in bands]
                values = [band.values for band in bands]
                levels = overview_levels(grid)
                overviews.copy_with_overviews(memory.name, Path(path), values, pools, levels, **_CREATION)
    except (RasterioError, CPLE_BaseError, OSError) as error:
        raise OutputError(f"cannot write the raster {Path(path)}: {error}") from error


def write_side_bev(path: str | os.PathLike[str], side: Side, frame: WorkFrame | None = None) -> None:
    """Write a side's BEV in that side's own frame.

    Args:
        path: where to write.
        side: a side with a BEV.
        frame: the pair's work frame, whose CRS the side's work coordinates have where its link
            converts units or CRS; without it such a raster gets no CRS.

    Raises:
        ValueError: if the side has no BEV yet.
        OutputError: if the file cannot be written.

    """
    if side.bev is None:
        raise ValueError(f"the {side.role} has no BEV yet")
    link = side.link
    converted = link.pipeline is not None or bool(np.any(link.factor != 1.0))
    crs = link.file_crs if not converted else frame.crs if frame is not None else None
    tags = {"ROLE": side.role, "CLOUD": Path(side.cloud.name).name}
    write_bev(path, side.bev, WorkFrame(crs, link.origin), T_level_work=side.T_level_work, tags=tags)


def write_registered_bev(path: str | os.PathLike[str], pair: Pair, bev: Bev | None = None) -> None:
    """Write the source's BEV as the found transform places it, in the target's CRS, upright.

    Laid over the target in a GIS it shows at once whether the registration holds.

    Args:
        path: where to write.
        pair: a solved pair.
        bev: what `registered_bev` made of it, where it is there already.

    Raises:
        ValueError: if the pair is not solved or the source has no BEV yet.
        OutputError: if the file cannot be written.

    """
    tags = {
        "ROLE": "source, registered to the target",
        "CLOUD": Path(pair.source.cloud.name).name,
        "RESAMPLING": "nearest cell of the source's BEV, moved by the found transform",
    }
    write_bev(path, registered_bev(pair) if bev is None else bev, pair.frame, tags=tags)


def registered_bev(pair: Pair) -> Bev:
    """Resample the source's BEV to where the transform places it, in upright target work coordinates.

    The grid has the source's cell size and is aligned to whole cells, so it nests with the target's
    where both cells agree.

    Raises:
        ValueError: if the pair is not solved or the source has no BEV yet.

    """
    bev = pair.source.bev
    if pair.T_target_source is None or bev is None:
        raise ValueError("the pair needs a transform and the source a BEV to be laid over the target")
    T_target_levelled = pair.T_target_source @ transforms.inverse(pair.source.T_level_work)
    return warp_bev(bev, T_target_levelled, grid_around(bev, T_target_levelled))


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


def geotransform(grid: Grid, origin: Floats) -> Any:
    """Return the affine from pixel corners to CRS coordinates of a grid whose frame has this origin."""
    from affine import Affine

    return Affine(
        grid.cell, 0.0, grid.west + float(origin[0]), 0.0, -grid.cell, grid.north + float(origin[1])
    )


def overview_levels(grid: Grid) -> int:
    """Return how often a raster of this size is worth halving: until its longer side is below 256 cells."""
    levels = 0
    while max(grid.width, grid.height) / 2 ** (levels + 1) >= _SMALLEST_OVERVIEW:
        levels += 1
    return levels


def _move_z(T: Floats, east: Floats, north: Floats, z: Image) -> Floats:
    """Return heights after T of points at places with heights `z`, all of one shape."""
    moved = T[2, 2] * z + T[2, 3]
    if T[2, 0] == T[2, 1] == 0.0:
        return np.asarray(moved)
    return np.asarray(moved + (T[2, 0] * east + T[2, 1] * north))


def _absolute(z: Image, frame: WorkFrame) -> Image:
    return (z.astype(np.float64) + float(frame.origin[2])).astype(np.float32)


def _frame_tags(frame: WorkFrame, level: Floats, upright: bool) -> dict[str, str]:
    origin = " ".join(f"{value:.17g}" for value in frame.origin)
    if upright:
        kind = "coordinates of the CRS" if frame.crs is not None else "local coordinates in metres"
        return {"FRAME": kind, "LEVELLED": "no", "WORK_ORIGIN": origin}
    return {
        "FRAME": "levelled coordinates plus the work origin: a tilted frame, so no CRS is set",
        "LEVELLED": "yes",
        "WORK_ORIGIN": origin,
        "T_LEVEL_WORK": " ".join(f"{value:.17g}" for value in level.ravel()),
    }
