"""What two clouds lack, where nothing comes of them: extent, density, or anything that stands out.

`what_is_missing` says it of two rasters, for errors and verdicts; `cells_short` and `is_flat` are what it
rests on, and what a check asks beforehand.
"""

from __future__ import annotations

import cv2
import numpy as np

from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import FINEST_AUTO_CELL_M, POINTS_PER_CELL
from mtpcr_geo.method.images import channels
from mtpcr_geo.method.scales import MIN_PATCH_CELLS, occupied_area

FEW_CELLS_ACROSS = 4 * MIN_PATCH_CELLS
"""Cells across a cloud below which the patches of local matches are larger than a quarter of it, and few."""
FLAT_M = 0.1
"""Height above the surroundings that counts as noise; as in `mtpcr_geo.match.search`."""
FLAT_SHARE = 0.99
HOLES_WITHIN, MOSTLY_HOLES = 3, 0.1
SPREAD = 1.5
"""Times that a cloud is wider than a square of its occupied cells, from which on it is mostly empty."""
COARSER = 1.5
"""Times that a cell exceeds what the density bears, from which on a finer one is worth trying."""


def what_is_missing(source: Bev, target: Bev) -> str | None:
    """Say what keeps two rasters from giving many matches, and what to do; None where nothing is seen to.

    Args:
        source, target: both rasters.

    """
    for role, bev in (("source", source), ("target", target)):
        if is_mostly_holes(bev):
            return (
                f"only {filled_share(bev):.1%} of the {role}'s cells of {bev.grid.cell:g} m hold points: "
                "give it unthinned, or a coarser cell (option cell)"
            )
        if is_flat(bev):
            return (
                f"the {role} is flat ({FLAT_SHARE:.0%} of its cells lie within {relief_m(bev):.2f} m of "
                "their surroundings), so that nothing stands out to match: give clouds with trees, buildings "
                "or banks"
            )
    cell = max(source.grid.cell, target.grid.cell)
    area = {"source": occupied_area(source), "target": occupied_area(target)}
    per_m2 = min(
        float(bev.count.sum()) / max(area[role], 1e-9)
        for role, bev in (("source", source), ("target", target))
    )
    role = "source" if area["source"] <= area["target"] else "target"
    return cells_short(cell, float(np.sqrt(area[role])), role, per_m2)


def cells_short(
    cell_m: float, extent_m: float, role: str, per_m2: float, spread_m: float = 0.0
) -> str | None:
    """Say why a cloud is only few cells across, and what to do; None where they are enough.

    Args:
        cell_m: cell of the rasters, metres.
        extent_m: edge of a square of the smaller cloud's occupied area, metres.
        role: which cloud that is.
        per_m2: points per occupied square metre of the sparser cloud.
        spread_m: edge of a square of the ground over which that cloud is spread, holes included, metres.

    """
    across = extent_m / cell_m
    if across >= FEW_CELLS_ACROSS:
        return None
    size = f"the {role} is about {extent_m:.0f} m across, {across:.0f} cells of {cell_m:g} m"
    if spread_m > SPREAD * extent_m:
        size = (
            f"the {role} is spread over {spread_m:.0f} x {spread_m:.0f} m, and holds points in no more cells "
            f"of {cell_m:g} m than a square of {across:.0f} x {across:.0f} has"
        )
    borne = max(float(np.sqrt(POINTS_PER_CELL / max(per_m2, 1e-9))), FINEST_AUTO_CELL_M)
    if cell_m > COARSER * borne:
        return f"{size}, and the points bear cells of {borne:.2g} m: give a finer cell (option cell)"
    if cell_m > FINEST_AUTO_CELL_M:
        return f"{size}, and the points ({per_m2:.2g} per m2) bear none finer: give denser or larger clouds"
    return f"{size} (the finest): give a larger part of the place"


def is_flat(bev: Bev) -> bool:
    """Return whether nothing in a raster stands out from its surroundings by more than noise."""
    return not is_mostly_holes(bev) and relief_m(bev) < FLAT_M


def is_mostly_holes(bev: Bev) -> bool:
    """Return whether so few cells hold points that no shape is seen, nor whether there is one."""
    return filled_share(bev) < MOSTLY_HOLES


def filled_share(bev: Bev) -> float:
    """Return the share of cells that hold points, of those within three cells of any that does."""
    filled = (bev.count > 0).astype(np.uint8)
    around = cv2.dilate(filled, np.ones((2 * HOLES_WITHIN + 1,) * 2, np.uint8))
    return float(filled.sum()) / max(float(around.sum()), 1.0)


def relief_m(bev: Bev) -> float:
    """Return the height above or below their surroundings within which 99 % of the cells lie, metres."""
    seen = channels(bev)
    height = np.abs(seen.stack[0][seen.mask > 0])
    return float(np.quantile(height, FLAT_SHARE)) if height.size else 0.0
