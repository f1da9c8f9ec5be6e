"""The mosaic of a survey: height rasters on one grid, in square blocks of cells, each a GeoTIFF of its own.

Cells have whole numbers, counted from the CRS's origin eastwards and northwards, so that whichever tile a
point comes from, the same place falls into the same cell and neighbouring tiles merge exactly: the highest
of both, the lowest of both, the sum of both counts. A block's file holds its overviews, likewise highest,
lowest and sum, so that each level of the pyramid is what the points themselves give at its cell.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import InputError, OutputError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.core.version import __version__
from mtpcr_geo.crs.facts import facts_of
from mtpcr_geo.method.bev import Rasteriser

if TYPE_CHECKING:
    from pyproj import CRS

BLOCK_CELLS = 512
"""Cells along a block at the finest level."""
FACTORS = (1, 2, 4, 8, 16, 32)
"""Cells of the levels of the pyramid, as multiples of the finest."""
BANDS = ("top", "low", "count")
BLOCKS = "bev"
_SOURCES = "MTPCR_SOURCES"
_TIFF_BLOCK = 256

Place = tuple[int, int]
"""Number of a block: columns eastwards and rows northwards from the CRS's origin."""


@dataclass(frozen=True)
class Frame:
    """The cells of a survey, and the CRS in which they lie.

    Attributes:
        wkt: of the CRS, projected.
        cell_m: edge of the finest cell, metres.
        unit_m, height_unit_m: metres in a unit of the CRS, in plan and in height.

    """

    wkt: str
    cell_m: float
    unit_m: float = 1.0
    height_unit_m: float = 1.0

    @cached_property
    def crs(self) -> CRS:
        """The CRS of the tiles."""
        from pyproj import CRS

        return CRS.from_wkt(self.wkt)

    @cached_property
    def raster_wkt(self) -> str:
        """WKT of the CRS of the rasters: with a vertical datum where they are in its unit, metres."""
        facts = facts_of(self.crs)
        # a GeoTIFF with a CRS of three axes is read back without any
        if facts.horizontal is None or (facts.vertical is not None and self.height_unit_m == 1.0):
            return self.wkt
        return str(facts.horizontal.to_wkt())

    @property
    def block_m(self) -> float:
        """Edge of a block, metres."""
        return BLOCK_CELLS * self.cell_m

    def metric(self, xyz: Floats) -> Floats:
        """Take (n, 3) coordinates of the CRS to metres, rounded to 10 micrometres as in work frames."""
        scaled = xyz * np.array([self.unit_m, self.unit_m, self.height_unit_m])
        return np.asarray(np.round(scaled, 5))

    def grid_of(self, place: Place) -> Grid:
        """Return the finest grid of a block, metres from the CRS's origin."""
        column, row = place
        return Grid(column * self.block_m, (row + 1) * self.block_m, self.cell_m, BLOCK_CELLS, BLOCK_CELLS)


class BlockRasteriser:
    """Collects points into blocks that are made as points fall into them; bounds need not be known.

    Args:
        frame: the cells.
        most_blocks: beyond so many blocks it is refused.
        name: of the cloud, for messages.

    """

    def __init__(self, frame: Frame, most_blocks: int, name: str) -> None:
        self.frame, self.most, self.name = frame, most_blocks, name
        self.blocks: dict[Place, Rasteriser] = {}

    def add(self, xyz: Floats) -> None:
        """Add (n, 3) points in metres from the CRS's origin.

        Raises:
            InputError: if the points are spread over more blocks than memory holds.

        """
        column = np.floor(xyz[:, 0] / self.frame.cell_m)
        # what lies on a line between two rows belongs to the southern one, as in every `Grid`
        row = np.ceil(xyz[:, 1] / self.frame.cell_m) - 1.0
        cell = np.column_stack([column, row]).astype(np.int64)
        block = np.floor_divide(cell, BLOCK_CELLS)
        low = block.min(axis=0)
        number = (block[:, 1] - low[1]) * (int(np.ptp(block[:, 0])) + 1) + block[:, 0] - low[0]
        for one in np.unique(number):
            chosen = number == one
            first = block[np.argmax(chosen)]
            place = (int(first[0]), int(first[1]))
            if place not in self.blocks:
                if len(self.blocks) == self.most:
                    raise InputError(
                        f"{self.name} spreads over more than {self.most} blocks of {self.frame.block_m:g} m; "
                        "cut it into tiles, remove points far from the rest, or give a coarser --cell"
                    )
                # in units of cells: a whole number of them lies west and south of a block
                self.blocks[place] = Rasteriser(Grid(0.0, BLOCK_CELLS, 1.0, BLOCK_CELLS, BLOCK_CELLS))
            inside = cell[chosen] - first * BLOCK_CELLS + 0.5
            self.blocks[place].add(np.column_stack([inside, xyz[chosen, 2]]))

    def finish(self) -> dict[Place, Bev]:
        """Return the blocks, in order."""
        return {
            place: replace(self.blocks[place].finish(), grid=self.frame.grid_of(place))
            for place in sorted(self.blocks)
        }


def merge(parts: list[Bev]) -> Bev:
    """Merge rasters of one block: the highest, the lowest, the sum of the counts."""
    top, low, count = parts[0].top.copy(), parts[0].low.copy(), parts[0].count.copy()
    for part in parts[1:]:
        np.fmax(top, part.top, out=top)
        np.fmin(low, part.low, out=low)
        count += part.count
    return Bev(parts[0].grid, top, low, count)


@dataclass(frozen=True)
class Mosaic:
    """The blocks of a survey in a folder.

    Attributes:
        folder: of the survey.
        frame: the cells.

    """

    folder: Path
    frame: Frame

    def path_of(self, place: Place) -> Path:
        """Return the file of a block."""
        column, row = place
        return self.folder / BLOCKS / f"x{column}" / f"y{row}.tif"

    def places(self) -> list[Place]:
        """Return the blocks that there are, in order."""
        found = []
        for path in (self.folder / BLOCKS).glob("x*/y*.tif"):
            column, row = path.parent.name[1:], path.stem[1:]
            found.append((int(column), int(row)))
        return sorted(found)

    def sources_of(self, place: Place) -> str | None:
        """Return what a block was made of, as it was said when it was written; None where there is none."""
        path = self.path_of(place)
        if not path.is_file():
            return None
        import rasterio
        from rasterio.errors import RasterioError

        try:
            with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(path) as opened:
                return str(opened.tags().get(_SOURCES, ""))
        except RasterioError:
            return None  # it is made anew

    def write(self, place: Place, bev: Bev, sources: str) -> None:
        """Write a block with its overviews, whole or not at all.

        Args:
            place: number of the block.
            bev: its raster at the finest level.
            sources: what it was made of.

        Raises:
            OutputError: if it cannot be written.

        """
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError
        from rasterio.io import MemoryFile

        from mtpcr_geo.export import overviews

        path = self.path_of(place)
        part = path.with_name(f".{path.stem}.part-{os.getpid()}{path.suffix}")
        creation: dict[str, Any] = {
            "tiled": True,
            "blockxsize": _TIFF_BLOCK,
            "blockysize": _TIFF_BLOCK,
            "compress": "deflate",
            "zlevel": 6,
            "predictor": 3,
            "interleave": "band",
        }
        bands = [bev.top, bev.low, bev.count.astype(np.float32)]
        pools = [overviews.HIGHEST, overviews.LOWEST, overviews.SUM]
        tags = {
            "AREA_OR_POINT": "Area",
            "TIFFTAG_SOFTWARE": f"mtpcr_geo {__version__}",
            "HEIGHTS": "metres",
            _SOURCES: sources,
        }
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with (
                rasterio.Env(GDAL_PAM_ENABLED="NO"),
                warnings.catch_warnings(),
                MemoryFile(ext=".tif") as memory,
            ):
                # overviews lie where the whole raster does
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                with memory.open(**self._profile(bev.grid), **creation | {"compress": "none"}) as out:
                    out.update_tags(**tags)
                    for number, (band, name) in enumerate(zip(bands, BANDS, strict=True), start=1):
                        out.set_band_description(number, name)
                        out.write(band, number)
                overviews.copy_with_overviews(memory.name, part, bands, pools, len(FACTORS) - 1, **creation)
            os.replace(part, path)
        except (RasterioError, OSError) as error:
            part.unlink(missing_ok=True)
            raise OutputError(f"cannot write the block {path}: {error}") from error
        except BaseException:
            part.unlink(missing_ok=True)
            raise

    def remove(self, place: Place) -> None:
        """Remove a block that no tile reaches any more."""
        self.path_of(place).unlink(missing_ok=True)

    def read(self, bounds: Floats, factor: int) -> Bev:
        """Read the cells of a level that bounds touch, from the blocks that there are.

        Args:
            bounds: (2, 2) lowest and highest x and y, metres from the CRS's origin.
            factor: cell of the level as a multiple of the finest, one of `FACTORS`.

        Returns:
            The raster, in metres from the CRS's origin; its grid lies on whole cells of the level.

        Raises:
            InputError: if a block cannot be read.

        """
        cell = self.frame.cell_m * factor
        (west, south), (east, north) = np.asarray(bounds, np.float64) / cell
        # points on a line between cells lie in the eastern and in the southern one
        low = np.array([np.floor(west), np.ceil(south) - 1.0]).astype(int)
        high = np.maximum(np.array([np.floor(east) + 1.0, np.ceil(north)]).astype(int), low + 1)
        width, height = (int(n) for n in high - low)
        top = np.full((height, width), np.nan, np.float32)
        lowest = top.copy()
        count = np.zeros((height, width), np.uint32)
        side = BLOCK_CELLS // factor
        for place in self._between(low, high, side):
            if not self.path_of(place).is_file():
                continue
            # columns from the west, rows from the north, of the raster and of the block
            column0, row0 = place[0] * side - int(low[0]), int(high[1]) - (place[1] + 1) * side
            inner, outer = [], []
            for start, room in ((row0, height), (column0, width)):
                first, last = max(start, 0), min(start + side, room)
                outer.append(slice(first, last))
                inner.append(slice(first - start, last - start))
            values = self._window(place, factor, inner[0], inner[1])
            into = (outer[0], outer[1])
            top[into], lowest[into] = values[0], values[1]
            count[into] = values[2].astype(np.uint32)
        grid = Grid(float(low[0]) * cell, float(high[1]) * cell, cell, width, height)
        return Bev(grid, top, lowest, count)

    @staticmethod
    def _between(low: NDArray[Any], high: NDArray[Any], side: int) -> list[Place]:
        first, last = np.floor_divide(low, side), np.floor_divide(high - 1, side)
        return [
            (c, r)
            for c in range(int(first[0]), int(last[0]) + 1)
            for r in range(int(first[1]), int(last[1]) + 1)
        ]

    def _window(self, place: Place, factor: int, rows: slice, columns: slice) -> NDArray[np.float32]:
        import rasterio
        from rasterio.errors import RasterioError
        from rasterio.windows import Window

        path = self.path_of(place)
        level = {} if factor == 1 else {"overview_level": FACTORS.index(factor) - 1}
        window = Window(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
        try:
            with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(path, **level) as opened:
                return np.asarray(opened.read(window=window), np.float32)
        except RasterioError as error:
            raise InputError(
                f"cannot read the block {path} of the survey ({error}); remove it, and build the survey again"
            ) from error

    def _profile(self, grid: Grid) -> dict[str, Any]:
        from rasterio import Affine

        unit = self.frame.unit_m
        step = grid.cell / unit
        return {
            "driver": "GTiff",
            "dtype": "float32",
            "count": len(BANDS),
            "width": grid.width,
            "height": grid.height,
            "nodata": float("nan"),
            "transform": Affine(step, 0.0, grid.west / unit, 0.0, -step, grid.north / unit),
            "crs": self.frame.raster_wkt,
        }
