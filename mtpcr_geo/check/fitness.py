"""What keeps two clouds, sound in themselves, from being registered: extent, density, relief, vertical."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.check.findings import Finding, Role
from mtpcr_geo.check.points import Measured
from mtpcr_geo.check.upright import TILTED_DEG
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import choose_cell, make_bev
from mtpcr_geo.method.levelling import level
from mtpcr_geo.method.overlap import overlap_of
from mtpcr_geo.method.scales import MIN_PATCH_CELLS, ground_cell_for
from mtpcr_geo.method.shortcomings import (
    FLAT_SHARE,
    cells_short,
    filled_share,
    is_flat,
    is_mostly_holes,
    relief_m,
)
from mtpcr_geo.verdict.findings import FEWEST_GROUND_CELLS

HARDLY_ANY_ACROSS = 2.5 * MIN_PATCH_CELLS
"""Cells across a cloud below which hardly more than two patches fit beside each other. Of a dense forest
plot, discs of 37 cells were accepted, and discs or thinned clouds of 14 to 24 refused."""
LEANS_DEG = 2.0


@dataclass(frozen=True)
class Fitness:
    """One cloud as a registration would see it.

    Attributes:
        role: which cloud it is.
        measured: it, in metres.
        points: in the whole cloud, of which the sample may be a part.
        local: whether no CRS tells its vertical.

    """

    role: Role
    measured: Measured
    points: int
    local: bool

    @property
    def thinned(self) -> float:
        """By how much the points of the sample are farther apart than those of the cloud."""
        return float(np.sqrt(max(self.points / max(len(self.measured.sample), 1), 1.0)))


def fitness_findings(sides: list[Fitness]) -> Iterator[Finding]:
    """Yield what would keep clouds from being registered, in the cells that a registration would choose.

    Args:
        sides: one cloud or both.

    """
    cell = cell_for(sides)
    smaller = min(sides, key=lambda side: side.measured.area_m2)
    sparser = min(side.measured.per_m2 for side in sides)
    extent = float(np.sqrt(smaller.measured.area_m2))
    hardly = extent / cell < HARDLY_ANY_ACROSS
    spread = float(np.sqrt(np.prod(smaller.measured.extent[:2])))
    short = cells_short(cell, extent, "cloud" if len(sides) < 2 else smaller.role, sparser, spread)
    if short is not None:
        what, _, fix = short.partition(": ")
        risk = "too few for the result to be sure" if hardly else "few for the result to be sure"
        yield Finding("warning" if hardly else "note", "cells-few", smaller.role, f"{what}, {risk}", fix)
    for side in sides:
        if not (hardly and side is smaller):
            yield from raster_findings(make_bev(side.measured.sample, cell * side.thinned), side.role)
        if side.local:
            yield from vertical_findings(side)


def cell_for(sides: list[Fitness]) -> float:
    """Return the cell that a registration would choose, metres."""
    extent = float(np.sqrt(min(side.measured.area_m2 for side in sides)))
    return choose_cell([side.measured.per_m2 for side in sides], extent)


def raster_findings(bev: Bev, role: Role) -> Iterator[Finding]:
    """Yield whether a raster has nothing that stands out, or consists of holes."""
    if is_mostly_holes(bev):
        yield Finding(
            "warning",
            "sparse",
            role,
            f"only {filled_share(bev):.1%} of the cells of {bev.grid.cell:g} m where it lies hold points",
            "give the cloud unthinned, if there is one, or a coarser cell (--cell)",
        )
    elif is_flat(bev):
        yield Finding(
            "warning",
            "flat",
            role,
            f"nothing in it stands out: {FLAT_SHARE:.0%} of its cells of {bev.grid.cell:g} m lie within "
            f"{relief_m(bev):.2f} m of their surroundings",
            "give a part of the place with trees, buildings or banks",
        )


def vertical_findings(side: Fitness) -> Iterator[Finding]:
    """Yield how a cloud leans whose vertical no CRS tells, or that nothing in it tells."""
    found = level(side.measured.sample, "auto", georeferenced=False)
    if found.method == "none":
        yield Finding(
            "note",
            "vertical-unknown",
            side.role,
            f"nothing in it tells which way is up ({found.why}): it is taken as it stands, and a lean can "
            "only be found later, by the refinement",
            f"name its CRS (--{side.role}-crs) if it has one; --level none if it is upright",
        )
    elif LEANS_DEG <= found.tilt_deg < TILTED_DEG:
        by = {
            "plane": "its ground plane",
            "floor": "the sheet of its lowest points",
            "verticals": "its walls, poles and trunks",
        }.get(found.method, "itself")
        yield Finding(
            "note",
            "leans",
            side.role,
            f"by {by} it leans by {found.tilt_deg:.1f} degrees: a registration takes that for level at first",
            "give --level none if it is upright as it stands",
        )


def ground_findings(source: Floats, target: Floats, cell: float) -> Iterator[Finding]:
    """Yield whether too little ground is seen in both to compare its heights, where their CRSs put them.

    Args:
        source, target: (n, 3) and (m, 3) samples in one frame, metres.
        cell: of the rasters, metres.

    """
    overlap = overlap_of(source, target, ground_cell_for(cell))
    seen = len(overlap.ground_steps()[1])
    if seen < FEWEST_GROUND_CELLS:
        yield Finding(
            "note",
            "ground-unseen",
            "both",
            f"where they overlap by their CRSs both see the ground in {seen} cells of {overlap.grid.cell:g} "
            f"m (wanted {FEWEST_GROUND_CELLS}): heights will rest on what stands on it, and are not checked",
        )
