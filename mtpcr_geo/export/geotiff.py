"""BEVs as GeoTIFF: absolute heights, where they lie, and what the numbers mean, for any GIS."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair, Side
from mtpcr_geo.core.version import __version__
from mtpcr_geo.core.wording import visible
from mtpcr_geo.crs import WorkFrame
from mtpcr_geo.export import overviews
from mtpcr_geo.export.resample import registered_bev

_CREATION = {
    "blocksize": 256,
    "compress": "deflate",
    "level": 4,
    "num_threads": "ALL_CPUS",
    "predictor": "floating_point",
    "bigtiff": "IF_SAFER",
}
_SMALLEST_OVERVIEW = 128


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
        "RESAMPLING": "none: the points, moved by the found transform"
        if pair.source.complete
        else "nearest cell of the source's BEV, moved by the found transform",
    }
    write_bev(path, registered_bev(pair) if bev is None else bev, pair.frame, tags=tags)


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
