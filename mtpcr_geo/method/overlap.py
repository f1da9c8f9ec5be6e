"""Where two clouds in one frame cover the same ground, and how their surfaces compare there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import grid_around, rasterise

OVERLAP_CELL_M = 2.0


@dataclass(frozen=True)
class Overlap:
    """Both clouds on one grid of 2 m cells.

    Attributes:
        grid: the common grid.
        source, target: their rasters.
        shared: (h, w) cells that both fill, or that lie within one cell of both.

    """

    grid: Grid
    source: Bev
    target: Bev
    shared: Mask

    @property
    def area_m2(self) -> float:
        """Area of the cells of the source that the target covers too, square metres."""
        return float((self.shared & (self.source.count > 0)).sum()) * self.grid.cell**2

    def share_of(self, bev: Bev) -> float:
        """Share of one raster's filled cells that lie in the overlap."""
        filled = bev.count > 0
        return float((filled & self.shared).sum()) / max(int(filled.sum()), 1)

    def select(self, xyz: Floats) -> Mask:
        """Return which (n, 3) points lie in the overlap."""
        column, row = self.grid.cells(xyz)
        inside = self.grid.holds(column, row)
        found = np.zeros(len(xyz), bool)
        found[inside] = self.shared[row[inside], column[inside]]
        return found

    def ground_steps(self) -> tuple[Floats, Floats]:
        """Compare lowest heights where both look at the ground.

        Cells count whose lowest points lie low among their neighbours in both clouds: not on roofs, not
        in crowns.

        Returns:
            (n, 2) cell centres in metres, and (n,) target minus source heights in metres.

        """
        both = (self.source.count > 0) & (self.target.count > 0)
        both &= _lies_low(self.source.low) & _lies_low(self.target.low)
        row, column = np.nonzero(both)
        xy = self.grid.to_metres(np.column_stack([column, row]).astype(np.float64))
        step = (self.target.low - self.source.low)[both].astype(np.float64)
        return xy, step


def overlap_of(source: Floats, target: Floats, cell: float = OVERLAP_CELL_M, reach: int = 1) -> Overlap:
    """Lay both clouds, (n, 3) and (m, 3) metres in one frame, on one grid over the part they may share."""
    (low_s, high_s), (low_t, high_t) = transforms.bounds(source), transforms.bounds(target)
    low, high = np.maximum(low_s, low_t) - 2 * cell, np.minimum(high_s, high_t) + 2 * cell
    grid = grid_around(low, np.maximum(high, low + cell), cell)
    s, t = rasterise([source], grid), rasterise([target], grid)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    near = [cv2.dilate((bev.count > 0).astype(np.uint8), window) > 0 for bev in (s, t)]
    return Overlap(grid, s, t, near[0] & near[1])


def _lies_low(low: NDArray[np.float32], above: float = 0.7) -> Mask:
    """Cells whose lowest point is little above the lowest within 3 cells."""
    filled = np.where(np.isnan(low), np.float32(np.inf), low)
    lowest = cv2.erode(filled, np.ones((7, 7), np.uint8), borderType=cv2.BORDER_REPLICATE)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(filled) & (filled - lowest < above))
