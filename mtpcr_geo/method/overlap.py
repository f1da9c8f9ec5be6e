"""Where two clouds in one frame cover the same ground, and how their surfaces compare there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.groups import Groups
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import BLOCK, MAX_CELLS, fitting_cell, grid_around, rasterise
from mtpcr_geo.method.ground import connected_ground

OVERLAP_CELL_M = 2.0
MOST_OVERLAP_CELLS = MAX_CELLS // 4
"""Cells of the grid of an overlap at most: some images of as many are held for each cloud."""
LOW_RADIUS_M = 6.0
LOW_ABOVE_M = 0.7
SLOPE_RADIUS_M = 8.0
GROUND_LAYER_M = 0.3
GROUND_BLOCK = 262_144
"""Points whose layer is told at a time: each time the whole grid is gone over."""
MOST = 0.7
"""Share of a cloud on a grid above which no second array is made of it."""
STEEPEST = 1.0
"""Slope, rise over run, beyond which steps count as walls and not as ground."""
BLOCKS, FEWEST_BLOCKS, FEWEST_IN_BLOCK = 100, 12, 4
"""Blocks in which the shapes of two grounds are compared, where there is room; the fewest that tell; and the
fewest cells of ground in one."""
LARGEST_BLOCK_M = 16.0


@dataclass(frozen=True)
class CommonGround:
    """Heights of the ground in cells where both clouds see it.

    Attributes:
        xy: (n, 2) centres of the cells, metres.
        source, target: (n,) heights of either cloud's ground there, metres.
        cell: edge of a cell, metres.

    """

    xy: Floats
    source: Floats
    target: Floats
    cell: float

    @property
    def step(self) -> Floats:
        """Target minus source heights, (n,) metres."""
        return np.asarray(self.target - self.source)

    def shape(self) -> GroundShape:
        """Compare the shapes of both grounds, in blocks large enough that grass and brush average out.

        A block's height is the median of its cells. Relief is what is left of the heights after one plane:
        two slopes that fall alike are no sign of one place.
        """
        side = min(np.sqrt(len(self.xy) / BLOCKS) * self.cell, LARGEST_BLOCK_M)
        side = float(max(side, np.sqrt(2.0 * FEWEST_IN_BLOCK) * self.cell))
        column, row = np.floor(self.xy / side).astype(np.int64).T
        groups = Groups.of(column, row, FEWEST_IN_BLOCK)
        if len(groups) < FEWEST_BLOCKS:
            return GroundShape(len(groups), np.inf, 0.0, 0.0)
        xy = np.column_stack([groups.means(axis) for axis in self.xy.T])
        reliefs = [_robust_spread(_without_plane(xy, groups.medians(z))) for z in (self.source, self.target)]
        steps = groups.medians(self.step)
        spread = _robust_spread(steps)
        # the median of n values of a normal distribution spreads by 1.25 sigma / sqrt(n)
        beside = np.zeros(len(self.xy))
        beside[groups.order] = np.abs(self.step[groups.order] - steps[groups.number])
        noise = float(np.median(1.25 * 1.4826 * groups.medians(beside) / np.sqrt(groups.sizes)))
        return GroundShape(len(groups), spread, float(np.sqrt(np.mean(np.square(reliefs)))), noise)


@dataclass(frozen=True)
class GroundShape:
    """How the shapes of both grounds compare.

    Attributes:
        blocks: number of blocks compared.
        spread_m: robust standard deviation of their height differences about the median, metres; infinite
            where too few blocks could be compared.
        relief_m: robust standard deviation of the heights themselves about a plane, metres. Of places that
            have nothing to do with each other the heights differ by about 1.4 times this.
        noise_m: what the spread would be if all of it came of the scatter of the cells within the blocks,
            metres.

    """

    blocks: int
    spread_m: float
    relief_m: float
    noise_m: float


@dataclass(frozen=True)
class Overlap:
    """Both clouds on one grid.

    Attributes:
        grid: the common grid.
        source, target: their rasters.
        shared: (h, w) cells that both fill, or that lie within one cell of both.
        points: of both clouds, (n, 3) and (m, 3) metres, what lies on the grid and hardly more.

    """

    grid: Grid
    source: Bev
    target: Bev
    shared: Mask
    points: tuple[Floats, Floats]

    @property
    def area_m2(self) -> float:
        """Area that both clouds cover, square metres; the same whichever is the source.

        It is the mean of the areas of either cloud's filled cells in the shared part: a sparse one fills few.
        """
        filled = [float((self.shared & (bev.count > 0)).sum()) for bev in (self.source, self.target)]
        return (filled[0] + filled[1]) / 2.0 * self.grid.cell**2

    def share_of(self, bev: Bev) -> float:
        """Share of one raster's filled cells that lie in the overlap."""
        filled = bev.count > 0
        return float((filled & self.shared).sum()) / max(int(filled.sum()), 1)

    def select(self, xyz: Floats) -> Mask:
        """Return which (n, 3) points lie in the overlap."""
        found = np.zeros(len(xyz), bool)
        for start in range(0, len(xyz), BLOCK):
            near = start + self.grid.near(xyz[start : start + BLOCK])
            column, row = self.grid.cells(xyz[near])
            inside = self.grid.holds(column, row)
            found[near[inside]] = self.shared[row[inside], column[inside]]
        return found

    def common_ground(self) -> CommonGround:
        """Return the heights of the ground where both clouds see it.

        Cells count whose lowest points lie low among their neighbours in both clouds: not on roofs, not
        in crowns.
        """
        cell = self.grid.cell
        both = (self.source.count > 0) & (self.target.count > 0)
        slopes = []
        for bev in (self.source, self.target):
            lowest = _lowest_near(bev.low, cell)
            slopes.append(_slope(lowest, cell))
            both &= connected_ground(bev.low, _lies_low(bev.low, lowest, slopes[-1], cell), cell)
        row, column = np.nonzero(both)
        xy = self.grid.to_metres(np.column_stack([column, row]).astype(np.float64))
        heights = [
            _ground(xyz, bev, slope)
            for xyz, bev, slope in zip(self.points, (self.source, self.target), slopes, strict=True)
        ]
        return CommonGround(xy, heights[0][both], heights[1][both], self.grid.cell)

    def ground_steps(self) -> tuple[Floats, Floats]:
        """Compare the heights of the ground where both see it.

        Returns:
            (n, 2) cell centres in metres, and (n,) target minus source heights in metres.

        """
        ground = self.common_ground()
        return ground.xy, ground.step


def overlap_of(
    source: Floats, target: Floats, cell: float = OVERLAP_CELL_M, margin_cells: int = 1
) -> Overlap:
    """Lay both clouds on one grid over the part they may share.

    Args:
        source, target: (n, 3) and (m, 3) metres in one frame.
        cell: edge of a cell, metres; doubled until the grid has `MOST_OVERLAP_CELLS` at most, which cells of
            2 m are for a square of 8 km. What came of it is the grid's.
        margin_cells: cells by which a filled cell counts around itself.

    """
    (low_s, high_s), (low_t, high_t) = transforms.bounds(source), transforms.bounds(target)
    low, high = np.maximum(low_s, low_t) - 2 * cell, np.minimum(high_s, high_t) + 2 * cell
    high = np.maximum(high, low + cell)
    cell = fitting_cell(low, high, cell, MOST_OVERLAP_CELLS)
    grid = grid_around(low, high, cell)
    source, target = (_nearby(grid, xyz) for xyz in (source, target))
    s, t = rasterise([source], grid), rasterise([target], grid)
    window = np.ones((2 * margin_cells + 1, 2 * margin_cells + 1), np.uint8)
    near = [cv2.dilate((bev.count > 0).astype(np.uint8), window) > 0 for bev in (s, t)]
    return Overlap(grid, s, t, near[0] & near[1], (source, target))


def _nearby(grid: Grid, xyz: Floats) -> Floats:
    """Return what of (n, 3) points lies on a grid and hardly more; all, where that is most of them."""
    near = grid.near(xyz)
    return xyz if len(near) > MOST * len(xyz) else np.asarray(xyz[near])


def _ground(xyz: Floats, bev: Bev, slope: NDArray[np.float32]) -> Floats:
    """Return the mean height of the lowest layer of each cell, (h, w) metres, NaN where empty.

    The single lowest point lies the lower the denser and the noisier a cloud is; the mean of what lies
    little above it does not. On a slope the layer is as much thicker as the ground rises within the cell.
    """
    grid, low = bev.grid, bev.low.ravel()
    thick = (GROUND_LAYER_M + slope * grid.cell).ravel()
    size = grid.width * grid.height
    count, total = np.zeros(size), np.zeros(size)
    for start in range(0, len(xyz), GROUND_BLOCK):
        some = xyz[start : start + GROUND_BLOCK]
        column, row = grid.cells(some)
        inside = grid.holds(column, row)
        cell = row[inside] * grid.width + column[inside]
        above = some[inside, 2] - low[cell]
        layer = above <= thick[cell]
        count += np.bincount(cell[layer], minlength=size)
        total += np.bincount(cell[layer], above[layer], minlength=size)
    with np.errstate(invalid="ignore"):
        return np.asarray(bev.low.astype(np.float64) + (total / count).reshape(grid.shape))


def _slope(lowest: NDArray[np.float32], cell: float) -> NDArray[np.float32]:
    """Return the slope of the ground over some cells, rise over run, (h, w); 0 where it is not known.

    Args:
        lowest: (h, w) lowest heights near by, metres, see `_lowest_near`.
        cell: edge of a cell, metres.

    """
    if not np.isfinite(lowest).any():
        return np.zeros(lowest.shape, np.float32)
    known = np.isfinite(lowest).astype(np.float32)
    base = np.where(known > 0, lowest - np.float32(np.nanmedian(lowest)), np.float32(0))
    sigma = max(SLOPE_RADIUS_M / cell, 1.0)
    weight = cv2.GaussianBlur(known, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    smooth = cv2.GaussianBlur(base, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    smooth = smooth / np.maximum(weight, np.float32(1e-3))
    east, north = (
        cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=3, borderType=cv2.BORDER_REPLICATE) for dx in (1, 0)
    )
    slope = np.minimum(np.hypot(east, north) / np.float32(8 * cell), np.float32(STEEPEST))
    return np.asarray(slope, np.float32)


def _lowest_near(low: NDArray[np.float32], cell: float) -> NDArray[np.float32]:
    """Return the lowest height within some metres of each cell, NaN where there is none."""
    radius = max(1, round(LOW_RADIUS_M / cell))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    height = np.where(np.isfinite(low), low, np.float32(np.inf))
    lowest = cv2.erode(height, window, borderType=cv2.BORDER_REPLICATE)
    return np.where(np.isfinite(lowest), lowest, np.float32(np.nan)).astype(np.float32)


def _lies_low(
    low: NDArray[np.float32], lowest: NDArray[np.float32], slope: NDArray[np.float32], cell: float
) -> Mask:
    """Mark cells whose lowest point is little above the lowest near by, as far as the ground's slope goes.

    Args:
        low: (h, w) lowest heights, metres, NaN where empty.
        lowest: (h, w) lowest heights near by, metres, see `_lowest_near`.
        slope: (h, w) of the ground, rise over run.
        cell: edge of a cell, metres.

    """
    radius = max(1, round(LOW_RADIUS_M / cell))
    allowed = np.float32(LOW_ABOVE_M) + slope * np.float32(radius * cell)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(low) & (low - lowest < allowed))


def _without_plane(xy: Floats, z: Floats) -> Floats:
    """Take the least-squares plane from (n,) heights at (n, 2) places."""
    A = np.column_stack([np.ones(len(xy)), xy - xy.mean(axis=0)])
    return np.asarray(z - A @ np.linalg.lstsq(A, z, rcond=None)[0])


def _robust_spread(values: Floats) -> float:
    """Return the standard deviation of (n,) values as their median deviation tells it."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
