"""Overviews of rasters whose bands must not be averaged: highest stays highest, lowest lowest, counts add up.

The file is a cloud optimized GeoTIFF (OGC 21-026), as GDAL's driver COG arranges it. GDAL builds overviews
with one method for all bands of a file, and maximum, minimum and sum are not among its methods. It copies
overviews that a virtual raster (VRT) names band by band, which is done here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mtpcr_geo.core.arrays import Image

Pool = Callable[[Image, Image], Image]
"""Joins the values of two equal arrays of cells into one."""

HIGHEST: Pool = np.fmax
LOWEST: Pool = np.fmin
SUM: Pool = np.add


def _mean(one: Image, other: Image) -> Image:
    mean = np.float32(0.5) * (one + other)
    return np.where(np.isfinite(mean), mean, np.where(np.isfinite(one), one, other))


MEAN: Pool = _mean
"""The mean of what is there; for differences, which are noise at some scale."""


def halved(band: Image, pool: Pool) -> Image:
    """Return a band at half its resolution.

    Args:
        band: (h, w) values; NaN where there is none, which `HIGHEST` and `LOWEST` pass over.
        pool: how the values of a cell's four parts are joined.

    Returns:
        (ceil(h / 2), ceil(w / 2)): cell (r, c) joins rows 2r, 2r + 1 and columns 2c, 2c + 1, as far as the
        band has them.

    """
    for axis in (0, 1):
        band = np.moveaxis(band, axis, 0)
        even, odd = band[0::2].copy(), band[1::2]
        even[: len(odd)] = pool(even[: len(odd)], odd)
        band = np.moveaxis(even, 0, axis)
    return np.ascontiguousarray(band)


def copy_with_overviews(
    source: str, path: Path, bands: Sequence[Image], pools: Sequence[Pool], levels: int, **creation: Any
) -> None:
    """Copy a raster into a cloud optimized GeoTIFF with overviews at half, a quarter ... of its resolution.

    Args:
        source: the raster's name for GDAL; its values are those of `bands`.
        path: the file to write.
        bands: (h, w) float32 each.
        pools: how each band is reduced.
        levels: number of overviews.
        creation: creation options of GDAL's COG driver.

    Raises:
        rasterio.errors.RasterioError: if the file cannot be made.
        OSError: if it cannot be written.

    """
    import rasterio
    from rasterio import shutil
    from rasterio.io import MemoryFile

    with ExitStack() as stack:
        names = []
        for _ in range(levels):
            bands = [halved(band, pool) for band, pool in zip(bands, pools, strict=True)]
            reduced = stack.enter_context(MemoryFile(ext=".tif"))
            height, width = bands[0].shape
            profile = {"driver": "GTiff", "dtype": "float32", "count": len(bands), "nodata": float("nan")}
            # where it lies follows from the whole raster
            placed = rasterio.Affine.scale(1.0, -1.0)
            with reduced.open(**profile, width=width, height=height, transform=placed) as out:
                out.write(np.stack(bands))
            names.append(reduced.name)
        virtual = stack.enter_context(MemoryFile(ext=".vrt"))
        shutil.copy(source, virtual.name, driver="VRT")
        tree = ElementTree.fromstring(virtual.read())
        for number, band in enumerate(tree.iter("VRTRasterBand"), start=1):
            for name in names:
                overview = ElementTree.SubElement(band, "Overview")
                ElementTree.SubElement(overview, "SourceFilename", relativeToVRT="0").text = name
                ElementTree.SubElement(overview, "SourceBand").text = str(number)
        given = "FORCE_USE_EXISTING" if names else "NONE"
        with MemoryFile(ElementTree.tostring(tree), ext=".vrt") as whole, MemoryFile(ext=".tif") as packed:
            shutil.copy(whole.name, packed.name, driver="COG", overviews=given, **creation)
            # by Python, since GDAL prints what fails on a full disk instead of telling it
            path.write_bytes(packed.getbuffer())
