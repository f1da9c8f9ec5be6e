"""The height difference of both clouds where they overlap, as a raster in the target's frame."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mtpcr_geo.core.arrays import ComparesArrays, Image
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.export import geotiff, overviews, resample
from mtpcr_geo.method.bev import coarsen

GROUND_CELL_M = 0.5
"""Least edge of a cell: finer ones under a canopy hold branches more often than ground."""


@dataclass(frozen=True, eq=False)
class HeightDifference(ComparesArrays):
    """Registered source minus target, where both have points.

    Attributes:
        grid: where it lies, upright target work coordinates, metres.
        low: (h, w) float32 difference of the lowest z of each cell, metres, NaN where one cloud is missing.
        top: (h, w) float32 difference of the highest z, likewise.

    """

    grid: Grid
    low: Image
    top: Image


def upright_target(pair: Pair) -> Bev:
    """Return the target's raster in upright work coordinates: as it is, unless the target was levelled.

    Raises:
        ValueError: if the target has no raster yet.

    """
    bev = pair.target.bev
    if bev is None:
        raise ValueError("the target has no BEV yet")
    if np.array_equal(pair.target.T_level_work, np.eye(4)):
        return bev
    return resample.placed_whole(pair.target, np.eye(4))


def height_difference(pair: Pair, registered: Bev | None = None) -> HeightDifference | None:
    """Compare the heights of both clouds cell by cell where they overlap.

    The cells are those of the target's raster, or blocks of them of half a metre at least.

    Args:
        pair: with a transform and both rasters.
        registered: what `mtpcr_geo.export.resample.registered_bev` made of it, where it is there already.

    Returns:
        The difference, cut to the overlap; None where no cell has points of both.

    Raises:
        ValueError: if the pair is not solved or lacks a raster.

    """
    if pair.T_target_source is None or pair.source.bev is None:
        raise ValueError("the pair needs a transform and both rasters to be compared")
    target = upright_target(pair)
    whole = resample.registered_bev(pair) if registered is None else registered
    moved = whole.grid
    ends = np.array(
        [
            [moved.west, moved.north],
            [moved.west + moved.width * moved.cell, moved.north - moved.height * moved.cell],
        ]
    )
    column, row = target.grid.cells(ends)
    join = max(1, round(GROUND_CELL_M / target.grid.cell))
    columns = _within(column[0], column[1], target.grid.width)
    rows = _within(row[0], row[1], target.grid.height)
    if columns.start >= columns.stop or rows.start >= rows.stop:
        return None
    part = target.grid.part(rows, columns)
    fixed = Bev(part, target.top[rows, columns], target.low[rows, columns], target.count[rows, columns])
    source = resample.cut_to(whole, part) or resample.placed(pair.source, pair.T_target_source, part)
    fixed, source = coarsen(fixed, join), coarsen(source, join)
    low = source.low - fixed.low
    both = np.isfinite(low)
    if not both.any():
        return None
    rows, columns = _filled(both.any(axis=1)), _filled(both.any(axis=0))
    top = (source.top - fixed.top)[rows, columns]
    return HeightDifference(fixed.grid.part(rows, columns), low[rows, columns], top)


def write_difference(path: str | os.PathLike[str], difference: HeightDifference, pair: Pair) -> None:
    """Write a height difference as a cloud optimized GeoTIFF in the target's CRS.

    Band 1 holds the difference of the lowest heights, which are the ground's more often than not; band 2
    that of the highest. An overview has the mean of the cells that it covers.

    Raises:
        OutputError: if the file cannot be written.

    """
    meaning = "registered minus target"
    bands = (
        geotiff.Band(difference.low, f"lowest z, {meaning}, metres", "metre", overviews.MEAN),
        geotiff.Band(difference.top, f"highest z, {meaning}, metres", "metre", overviews.MEAN),
    )
    tags = {
        "ROLE": "height difference, registered source minus target",
        "CLOUD": " and ".join(Path(side.cloud.name).name for side in (pair.source, pair.target)),
    }
    geotiff.write_raster(path, bands, difference.grid, pair.frame, tags=tags)


def _within(first: float, last: float, size: int) -> slice:
    return slice(max(0, int(first)), min(size, int(last) + 1))


def _filled(line: Image) -> slice:
    """Return the part of a line from its first to its last true entry."""
    places = np.flatnonzero(line)
    return slice(int(places[0]), int(places[-1]) + 1)
