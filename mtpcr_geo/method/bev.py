"""Bird's-eye-view height rasters: highest z, lowest z and count per cell (Eq. 2), and their cells (Eq. 1).

MT-PCR multiplies each cloud by a resolution RES (Eq. 1), so that a pixel of its image is ``1 / RES`` metres;
here coordinates stay metres and ``1 / RES`` is the cell of the raster, which is the same thing. The paper's
pixels are (i, j): i counts columns eastwards and j rows *northwards*; images have north up, so that
row = height - 1 - j.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev

Resolution = Literal["common", "eq1", "eq1_occupied"]
Convention = Literal["centre", "ceil"]
"""Which points a cell holds: those around its centre, or by the ceiling as Eq. 2 is printed."""

FINEST_EQ1_CELL_M, COARSEST_EQ1_CELL_M = 0.1, 20.0
MAX_CELLS = 64_000_000
"""Cells beyond which a raster is refused: 0.8 GiB for the three bands."""

BLOCK = 32_768
"""Points that are brought onto a grid at a time."""

OCCUPANCY_CELL_M = 2.0
SAMPLED_PER_CELL = 4.0
"""Mean points of a sample that the occupied cells hold at least: of fewer, many would seem empty."""
FINEST_AUTO_CELL_M = 0.25
CELLS_PER_EXTENT = 200.0
FINEST_BY_EXTENT_M = 1.0
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
    # a cell holds its western and its northern edge
    west, south = np.floor(minimum[0] / cell), np.ceil(minimum[1] / cell) - 1
    east, north = np.floor(np.asarray(maximum[:2]) / cell) + 1
    width, height = int(east - west), int(north - south)
    if width * height > MAX_CELLS:
        raise RegistrationError(
            f"a raster of {width} x {height} cells of {cell:g} m is too large: {MAX_CELLS:,} cells are the "
            "most; give a coarser cell (option cell), crop the cloud to the place it shares with the other "
            "one, or remove points far from the rest"
        )
    return Grid(float(west * cell), float(north * cell), cell, width, height)


def fitting_cell(
    minimum: Floats, maximum: Floats, cell: float, most: int = MAX_CELLS, coarsest: float = np.inf
) -> float:
    """Double a cell until a grid over given bounds has so many cells at most.

    Args:
        minimum, maximum: (2,) or (3,) bounds, metres.
        cell: the cell to begin with, metres.
        most: cells at most.
        coarsest: it is not doubled beyond this, metres, whatever the grid has then.

    Returns:
        The edge of the cell, metres.

    """
    while 2.0 * cell <= coarsest and np.prod((maximum[:2] - minimum[:2]) / cell + 1.0) > most:
        cell *= 2.0
    return cell


class Rasteriser:
    """Collects points into a height raster, chunk by chunk: memory is that of the raster.

    Args:
        grid: where the raster lies; points outside it are left out.
        convention: "centre": a cell holds what lies between its edges; "ceil": column i holds
            ``ceil((x - xmin) / cell) = i`` and row j likewise, as Eq. 2 is printed, on a `ceil_grid`.

    """

    def __init__(self, grid: Grid, convention: Convention = "centre") -> None:
        self.grid = grid
        self.convention = convention
        size = grid.width * grid.height
        self._top = np.full(size, -np.inf, np.float32)
        self._low = np.full(size, np.inf, np.float32)
        self._count = np.zeros(size, np.uint32)

    def add(self, xyz: Floats) -> None:
        """Add (n, 3) points in the grid's metres."""
        # block by block it takes less memory, and less time
        for start in range(0, len(xyz), BLOCK):
            self._add(xyz[start : start + BLOCK])

    def _add(self, xyz: Floats) -> None:
        grid = self.grid
        column, row = grid.cells(xyz) if self.convention == "centre" else _cells_by_ceiling(grid, xyz)
        inside = grid.holds(column, row)
        cell = row * grid.width + column
        z = xyz[:, 2].astype(np.float32)
        if not inside.all():
            cell, z = cell[inside], z[inside]
        np.maximum.at(self._top, cell, z)
        np.minimum.at(self._low, cell, z)
        np.add.at(self._count, cell, np.uint32(1))

    def finish(self) -> Bev:
        """Return the raster of everything added so far."""
        empty = self._count == 0
        top = np.where(empty, np.float32(np.nan), self._top).reshape(self.grid.shape)
        low = np.where(empty, np.float32(np.nan), self._low).reshape(self.grid.shape)
        return Bev(self.grid, top, low, self._count.reshape(self.grid.shape))


def ceil_grid(minimum: Floats, maximum: Floats, cell: float) -> Grid:
    """Lay the grid of Eq. 2 as printed: column i holds ``ceil((x - xmin) / cell) = i``, from 0.

    Column 0 holds what lies exactly at xmin and nothing else; likewise row j = 0.

    Args:
        minimum, maximum: (2,) or (3,) bounds of the points, metres.
        cell: edge of a cell, metres.

    """
    width, height = (np.ceil((np.asarray(maximum[:2]) - minimum[:2]) / cell) + 1).astype(int)
    north = float(minimum[1]) + (int(height) - 1) * cell
    return Grid(float(minimum[0]) - cell, north, cell, int(width), int(height))


def _cells_by_ceiling(grid: Grid, xyz: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    west = grid.west + grid.cell
    south = grid.north - (grid.height - 1) * grid.cell
    i = np.ceil((xyz[:, 0] - west) / grid.cell).astype(np.int64)
    j = np.ceil((xyz[:, 1] - south) / grid.cell).astype(np.int64)
    return i, grid.height - 1 - j


def rasterise(chunks: Iterable[Floats], grid: Grid, convention: Convention = "centre") -> Bev:
    """Rasterise streamed (n, 3) points, metres, on a grid (Eq. 2; see `Rasteriser` for the convention)."""
    rasteriser = Rasteriser(grid, convention)
    for chunk in chunks:
        rasteriser.add(chunk)
    return rasteriser.finish()


def make_bev(xyz: Floats, cell: float, convention: Convention = "centre") -> Bev:
    """Rasterise a cloud held in memory over its own bounds.

    Args:
        xyz: (n, 3) levelled points, metres.
        cell: edge of a cell, metres.
        convention: which points a cell holds, see `Rasteriser`.

    Raises:
        RegistrationError: if the raster would not fit into memory at that cell size.

    """
    lay = grid_around if convention == "centre" else ceil_grid
    return rasterise([xyz], lay(*transforms.bounds(xyz), cell), convention)


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

    def joined(band: NDArray[Any], fill: float, pick: np.ufunc) -> NDArray[Any]:
        # whole rows first, then columns of the few rows left: both run along memory, where a reduction over
        # the short axes of blocks takes four times as long
        padded = np.full((height * factor, width * factor), fill, band.dtype)
        inner = padded[row0 : row0 + grid.height, column0 : column0 + grid.width]
        np.copyto(inner, band, where=~np.isnan(band) if band.dtype.kind == "f" else True)
        rows = pick.reduce(padded.reshape(height, factor, width * factor), axis=1, dtype=band.dtype)
        whole = rows[:, ::factor].copy()
        for column in range(1, factor):
            pick(whole, rows[:, column::factor], out=whole)
        return np.asarray(whole)

    count = joined(bev.count, 0, np.add)
    top = joined(bev.top, -np.inf, np.maximum)
    low = joined(bev.low, np.inf, np.minimum)
    empty = count == 0
    top[empty] = np.nan
    low[empty] = np.nan
    coarse = Grid(grid.west - column0 * grid.cell, grid.north + row0 * grid.cell, cell, width, height)
    return Bev(coarse, top, low, count)


@dataclass(frozen=True)
class Coverage:
    """How densely a cloud covers the ground.

    Attributes:
        points: points in the whole cloud.
        occupied_m2: area of its occupied cells of 2 m, square metres; of larger ones, where it was measured
            in a sparse sample or is very wide.
        box_m2: area of its levelled bounding box, square metres.

    """

    points: int
    occupied_m2: float
    box_m2: float

    @property
    def per_m2(self) -> float:
        """Points per occupied square metre."""
        return self.points / self.occupied_m2


def coverage_of(xyz: Floats, levelled: Floats | None = None, points: int | None = None) -> Coverage:
    """Measure how densely a cloud covers the ground.

    In a sample of a cloud the occupied cells hold `SAMPLED_PER_CELL` points on average at least; cells of 2 m
    are doubled until they do. Else the gaps of the sample, which the cloud does not have, would not count as
    covered, and all of its points would seem to lie in the rest. Cells are larger too, up to the coarsest of
    rasters, where 2 m would be too many.

    Args:
        xyz: (n, 3) the cloud, or a uniform sample of it, metres.
        levelled: (n, 3) the same, levelled, for the bounding box; `xyz` itself if None.
        points: number of points in the whole cloud; n if None.

    Raises:
        RegistrationError: if the cloud is too wide for cells of `COARSEST_AUTO_CELL_M`.

    """
    low, high = transforms.bounds(xyz[:, :2])
    cell = fitting_cell(low, high, OCCUPANCY_CELL_M, coarsest=COARSEST_AUTO_CELL_M)
    bev = rasterise([xyz], grid_around(low, high, cell))
    filled = int(np.count_nonzero(bev.count))
    sampled = points is not None and points > len(xyz)
    while sampled and len(xyz) < SAMPLED_PER_CELL * filled and max(bev.grid.shape) > 1:
        bev = coarsen(bev, 2)
        filled = int(np.count_nonzero(bev.count))
    occupied = filled * bev.grid.cell**2
    low, high = (low, high) if levelled is None else transforms.bounds(levelled[:, :2])
    return Coverage(len(xyz) if points is None else points, occupied, float(np.prod(high - low)))


@dataclass(frozen=True)
class Cells:
    """Cells chosen for the rasters of some clouds.

    Attributes:
        cells_m: edge of each cloud's cells, metres.
        gamma_m: the gamma of Eq. 1, metres, where the cells follow from it.

    """

    cells_m: tuple[float, ...]
    gamma_m: float | None = None


def choose_cells(
    coverages: Sequence[Coverage],
    *,
    cell: float | None = None,
    finest: float | None = None,
    resolution: Resolution = "common",
    gamma: float | None = None,
) -> Cells:
    """Choose the cells of the rasters: one for all, or one each by Eq. 1.

    Args:
        coverages: of the clouds.
        cell: the cell that is wanted, metres; chosen from the densities if None.
        finest: no finer cell is chosen than this, metres, and the extent of the clouds plays no part; if
            None, it does.
        resolution: "common" for one cell; "eq1" and "eq1_occupied" for a cell of each cloud's own, from
            points per area of the bounding box, as printed, or of the occupied ground.
        gamma: the gamma of Eq. 1, metres; see `usual_gamma` if None.

    Raises:
        RegistrationError: if Eq. 1 gives a cell of no use.

    """
    densities = [one.per_m2 for one in coverages]
    extent = float(np.sqrt(min(one.occupied_m2 for one in coverages)))
    by_size = {"extent_m": extent} if finest is None else {"extent_m": 0.0, "finest": finest}
    usual = cell or choose_cell(densities, **by_size)
    if resolution == "common":
        return Cells((usual,) * len(coverages))
    areas = [one.box_m2 if resolution == "eq1" else one.occupied_m2 for one in coverages]
    per_area = tuple(one.points / area for one, area in zip(coverages, areas, strict=True))
    gamma = gamma or usual_gamma(per_area, usual)
    res = [resolution_of(one.points, area, gamma) for one, area in zip(coverages, areas, strict=True)]
    return Cells(tuple(cell_of(one) for one in res), gamma)


def choose_cell(
    densities: Sequence[float], extent_m: float = np.inf, finest: float = FINEST_AUTO_CELL_M
) -> float:
    """Choose one cell size for both rasters, metres, in steps of a quarter (below 1 m) or half a metre.

    A cell of the sparser cloud holds 1.2 points; but small sites are cut into some 200 cells across at most,
    and sites of 200 m and more into cells of 1 m at the finest.

    Args:
        densities: points per occupied square metre of each cloud.
        extent_m: edge of a square of the smaller cloud's occupied area, metres.
        finest: no finer than this, metres.

    """
    by_density = float(np.sqrt(POINTS_PER_CELL / min(densities)))
    wanted = max(by_density, min(extent_m / CELLS_PER_EXTENT, FINEST_BY_EXTENT_M))
    step = 0.25 if wanted < 0.875 else 0.5
    return float(np.clip(np.round(wanted / step) * step, finest, COARSEST_AUTO_CELL_M))


def resolution_of(count: int, area_m2: float, gamma: float) -> float:
    """Return RES, pixels per metre (Eq. 1): ``count * gamma / area``.

    The printed area is that of the bounding box; `Coverage` has the occupied one
    too, which is our variant. As ``count / area`` is per square metre and RES per metre, the unit of
    gamma is the metre.

    Args:
        count: points in the cloud.
        area_m2: area it covers, square metres.
        gamma: the paper's hyperparameter, metres; it has no value there.

    """
    return count * gamma / area_m2


def usual_gamma(densities: tuple[float, ...], cell: float) -> float:
    """Choose gamma, metres, where the user gives none: both cells then have the geometric mean ``cell``.

    Densities differ a hundredfold between surveys, and RES grows in step with them, so no single value
    serves: 0.1 m suits ten points per square metre, and makes 30 m cells of 0.3.

    Args:
        densities: points per square metre of each cloud.
        cell: the cell that one would choose for both, metres.

    """
    return float(1.0 / (cell * np.exp(np.mean(np.log(densities)))))


def cell_of(res: float) -> float:
    """Return the cell ``1 / RES`` in metres.

    Raises:
        RegistrationError: if it is of no use: below 0.1 m or above 20 m.

    """
    cell = 1.0 / res
    if not FINEST_EQ1_CELL_M <= cell <= COARSEST_EQ1_CELL_M:
        raise RegistrationError(
            f"Eq. 1 gives a cell of {cell:.3g} m, outside {FINEST_EQ1_CELL_M:g} to "
            f"{COARSEST_EQ1_CELL_M:g} m; give another gamma, or --no-res"
        )
    return cell
