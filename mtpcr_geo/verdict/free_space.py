"""Free space: where one cloud sees bare ground at the place of what stands in the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Image, Mask
from mtpcr_geo.method.ground import ground_cells
from mtpcr_geo.method.overlap import Overlap

SOLID_ABOVE_M = 2.5
"""Metres above the ground from which a cell without anything lower counts as solid: a storey."""
INSIDE_CELLS = 1
"""Cells by which a solid is shrunk, so that eaves and half a cell of misfit are no conflict."""
ROOF_SPREAD_M = 3.0
"""Most spread of heights in a solid cell, rise within it: a roof, and no crown."""
FEWEST_CELLS = 20
BARE_BELOW_M = 1.0
"""Height above the ground up to which a cell and its neighbours show that nothing stands there."""
FEWEST_OBJECT_CELLS = 50
"""Cells of objects in one cloud from which the share that the other misses tells something."""


@dataclass(frozen=True)
class FreeSpace:
    """Cells of solids that both clouds see.

    Attributes:
        cells: cells inside a solid of one cloud that the other fills.
        conflicts: of these, cells in which the other sees the ground.
        missing: share of one cloud's objects (what stands higher than 2.5 m) at whose place the other sees
            bare ground only, in the direction in which it is less; None where there are too few objects.

    """

    cells: int
    conflicts: int
    missing: float | None = None

    @property
    def share(self) -> float | None:
        """Share of conflicts; None where there are too few cells to tell."""
        return self.conflicts / self.cells if self.cells >= FEWEST_CELLS else None


def free_space_of(overlap: Overlap) -> FreeSpace:
    """Count the cells in which one cloud sees the ground where the other has a building.

    A scan that saw the ground of a place saw through the air above it; a roof cannot stand there.
    Buildings that came or went between the surveys are conflicts too, so it is a warning and no proof.

    Args:
        overlap: both clouds on one grid under the pose.

    """
    cells = conflicts = 0
    grounds = [ground_cells(bev.low, overlap.grid.cell) for bev in (overlap.source, overlap.target)]
    bevs = (overlap.source, overlap.target)
    for mine, other in ((0, 1), (1, 0)):
        floor = _floor(bevs[mine].low, grounds[mine])
        solid = _inside(bevs[mine].low, bevs[mine].top, floor, grounds[mine])
        filled = solid & (bevs[other].count > 0)
        with np.errstate(invalid="ignore"):
            bare = filled & grounds[other] & (bevs[other].top - floor < SOLID_ABOVE_M / 2.0)
        cells += int(filled.sum())
        conflicts += int(bare.sum())
    return FreeSpace(cells, conflicts, missing_share(overlap, grounds))


def missing_share(overlap: Overlap, grounds: Sequence[Mask]) -> float | None:
    """Return the share of objects of one cloud at whose place the other sees bare ground only.

    Trees and buildings do not come and go by the dozen between two surveys. A scanner on the ground may not
    see what stands above it, but what it sees stands in the aerial scan too: of both directions the one with
    the lesser share counts. Under true poses of real pairs it is 0.01 at most, 0.07 in woodland thinned
    between the epochs; of a symmetrical site turned by half a turn, whose houses fit but not its trees, 0.2.

    Args:
        overlap: both clouds on one grid under the pose.
        grounds: (h, w) cells of the ground of source and target.

    Returns:
        0 to 1; None where neither has objects enough in cells that the other fills.

    """
    bevs = (overlap.source, overlap.target)
    heights = []
    for bev, ground in zip(bevs, grounds, strict=True):
        above = bev.top - _floor(bev.low, ground)
        heights.append(np.where((bev.count > 0) & np.isfinite(above), above, np.float32(-1.0)))
    both = (bevs[0].count > 0) & (bevs[1].count > 0)
    shares = []
    for mine, other in ((0, 1), (1, 0)):
        objects = both & (heights[mine] > SOLID_ABOVE_M)
        highest = cv2.dilate(heights[other].astype(np.float32), np.ones((3, 3), np.uint8))
        count = int(objects.sum())
        if count >= FEWEST_OBJECT_CELLS:
            shares.append(float((objects & (highest < BARE_BELOW_M)).sum()) / count)
    return min(shares, default=None)


def _inside(low: Image, top: Image, floor: Image, ground: Mask) -> Mask:
    """Mark the cells whose lowest point is a storey above the ground, and all around which are such too."""
    with np.errstate(invalid="ignore"):
        high = ~ground & (low - floor > SOLID_ABOVE_M) & (top - low < ROOF_SPREAD_M)
    window = np.ones((2 * INSIDE_CELLS + 1, 2 * INSIDE_CELLS + 1), np.uint8)
    return np.asarray(cv2.erode(high.astype(np.uint8), window) > 0)


def _floor(low: Image, ground: Mask) -> Image:
    """Return the height of the nearest ground to each cell, (h, w) metres; NaN where there is none."""
    if not ground.any():
        return np.full(low.shape, np.nan, np.float32)
    _, label = cv2.distanceTransformWithLabels(
        (~ground).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    heights = np.zeros(int(label.max()) + 1, np.float32)
    heights[label[ground]] = low[ground]
    return np.asarray(heights[label], np.float32)
