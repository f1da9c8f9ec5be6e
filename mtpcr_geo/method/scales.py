"""Lengths that follow from the data: density, extent and overlap decide, between limits written down here.

No length in metres decides anything by itself: a plot of 20 m and a tile of kilometres go through the same
rules. Cells are chosen by `mtpcr_geo.method.bev.choose_cell`, the rest here. The extent that counts is that
of the smaller cloud, as the edge of a square of its occupied area.

==================  =======================================  ===============
length              rule                                     limits
==================  =======================================  ===============
cell                so that a cell of the sparser cloud      0.25 to 8 m
                    holds 1.2 points, but no finer than
                    1/200 of the extent, or 1 m
patch               1/4 of the extent, at least 12 cells     at most 24 m; more, up to
                    and 40 that are filled in both           1/2 the extent, if sparse
search radius       1/4 of a patch, at least 3 cells         at most 6 m
block               1/5 of the tie points' extent,           at most 40 m
                    at least a cell
least overlap       1/5 of the smaller area                  at most 400 m2
terrain cell        1/8 of the extent, at least 4 cells      1 to 8 m, or 1/40 of
                                                             the extent, to 32 m
same pose           half a patch                             1 to 12 m
ground cell         twice the raster's cell                  0.5 to 2 m
tolerance           a cell                                   at least 0.5 m
==================  =======================================  ===============
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import OCCUPANCY_CELL_M, coarsen

FINEST_OF_LEARNED_M = 0.5
"""Finest cell of rasters for learned matchers: their weights know hardly any finer."""
MAX_PATCH_M, MIN_PATCH_CELLS = 24.0, 12
FEWEST_FILLED_IN_PATCH = 40
"""Cells filled in both rasters that a patch should hold: fewer do not tell one place from the next."""
FILL_BLOCK = 8
"""Cells along the blocks within which the share of filled cells counts: larger gaps are not of a raster."""
MAX_SEARCH_RADIUS_M, MIN_SEARCH_RADIUS_CELLS = 6.0, 3
MAX_BLOCK_M, BLOCKS_PER_EXTENT = 40.0, 5.0
MAX_LEAST_OVERLAP_M2, LEAST_OVERLAP_SHARE = 400.0, 0.2
MIN_TERRAIN_CELL_M, MAX_TERRAIN_CELL_M = 1.0, 8.0
TERRAIN_CELLS_ACROSS, MAX_WIDE_TERRAIN_CELL_M = 40.0, 32.0
MIN_SAME_POSE_M, MAX_SAME_POSE_M = 1.0, 12.0
MIN_GROUND_CELL_M, MAX_GROUND_CELL_M = 0.5, 2.0
MIN_TOLERANCE_M = 0.5


@dataclass(frozen=True)
class Scales:
    """Lengths of the search and of the judgement, from two rasters.

    Attributes:
        cell_m: cell of the rasters, metres.
        extent_m: edge of a square of the smaller cloud's occupied area, metres.
        patch_m: edge of the patches of local matches, metres.
        search_radius_m: how far a patch may lie from where a hypothesis puts it, metres.
        least_overlap_m2: smallest overlap considered, square metres.
        terrain_cell_m: cell in which the shape of the ground is compared, metres.
        same_pose_m: poses closer than this are one, metres.
        fill: share of the cells that would be filled in both rasters where both have points.

    """

    cell_m: float
    extent_m: float
    patch_m: float
    search_radius_m: float
    least_overlap_m2: float
    terrain_cell_m: float
    same_pose_m: float
    fill: float = 1.0

    @property
    def tolerance_m(self) -> float:
        """Plan distance within which a match agrees with a pose, metres: the rasters resolve no better."""
        return tolerance_for(self.cell_m)


def occupied_area(bev: Bev) -> float:
    """Return the area of the cells of about 2 m that hold points, square metres: gaps between rings count."""
    coarse = coarsen(bev, max(1, round(OCCUPANCY_CELL_M / bev.grid.cell)))
    return float((coarse.count > 0).sum()) * coarse.grid.cell**2


def filled_share(bev: Bev) -> float:
    """Return the share of filled cells in blocks of 8 x 8 cells that hold any, 0..1."""
    filled = bev.count > 0
    rows, columns = (-(-n // FILL_BLOCK) * FILL_BLOCK for n in filled.shape)
    padded = np.zeros((rows, columns), bool)
    padded[: filled.shape[0], : filled.shape[1]] = filled
    blocks = padded.reshape(rows // FILL_BLOCK, FILL_BLOCK, columns // FILL_BLOCK, FILL_BLOCK).sum(
        axis=(1, 3)
    )
    held = blocks > 0
    return float(blocks[held].mean()) / FILL_BLOCK**2 if held.any() else 0.0


def scales_of(source: Bev, target: Bev) -> Scales:
    """Derive the lengths of search and judgement from two rasters; see the table above."""
    areas = [occupied_area(bev) for bev in (source, target)]
    fill = filled_share(source) * filled_share(target)
    return scales_for(max(source.grid.cell, target.grid.cell), min(areas), fill)


def scales_for(cell: float, area_m2: float, fill: float = 1.0) -> Scales:
    """Derive the same from numbers.

    Args:
        cell: of the rasters, metres.
        area_m2: occupied area of the smaller cloud, square metres.
        fill: share of the cells that are filled in both rasters where both have points.

    """
    extent = float(np.sqrt(max(area_m2, cell**2)))
    fewest = MIN_PATCH_CELLS * cell
    filled = min(float(np.sqrt(FEWEST_FILLED_IN_PATCH / max(fill, 0.01))) * cell, extent / 2.0)
    patch = max(min(extent / 4.0, MAX_PATCH_M), fewest, filled)
    return Scales(
        cell_m=cell,
        extent_m=extent,
        patch_m=patch,
        search_radius_m=max(min(patch / 4.0, MAX_SEARCH_RADIUS_M), MIN_SEARCH_RADIUS_CELLS * cell),
        least_overlap_m2=min(LEAST_OVERLAP_SHARE * area_m2, MAX_LEAST_OVERLAP_M2),
        terrain_cell_m=float(
            np.clip(
                max(extent / 8.0, 4.0 * cell),
                MIN_TERRAIN_CELL_M,
                max(
                    MAX_TERRAIN_CELL_M,
                    4.0 * cell,
                    min(extent / TERRAIN_CELLS_ACROSS, MAX_WIDE_TERRAIN_CELL_M),
                ),
            )
        ),
        fill=fill,
        same_pose_m=float(np.clip(patch / 2.0, MIN_SAME_POSE_M, MAX_SAME_POSE_M)),
    )


def block_for(xy: np.ndarray, cell: float) -> float:
    """Choose the edge of the blocks in which tie points are held out, metres.

    Args:
        xy: (n, 2) tie points, metres.
        cell: of the rasters, metres.

    """
    if len(xy) < 2:
        return MAX_BLOCK_M
    spans = np.percentile(xy, 95, axis=0) - np.percentile(xy, 5, axis=0)
    return float(np.clip(np.sqrt(max(np.prod(spans), 0.0)) / BLOCKS_PER_EXTENT, cell, MAX_BLOCK_M))


def tolerance_for(cell: float) -> float:
    """Return the plan distance within which a match agrees with a pose, metres: rasters resolve no better."""
    return max(cell, MIN_TOLERANCE_M)


def ground_cell_for(cell: float) -> float:
    """Choose the cell in which both clouds' ground is compared, metres, from the rasters' cell.

    Overlaps of many kilometres are compared in larger ones, see `mtpcr_geo.method.overlap.overlap_of`.
    """
    return float(np.clip(2.0 * cell, MIN_GROUND_CELL_M, MAX_GROUND_CELL_M))
