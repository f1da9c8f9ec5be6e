"""The floor of a cloud: the sheet of lowest points that lies under everything else, seen along any direction.

Ground is found by what it is for: something lies on it and nothing beneath it. Seen along the vertical, the
lowest points of coarse cells lie near one plane, over much of the cloud's area; seen along any other
direction they are scattered, few, or both. So a floor tells up from down, and upright clouds from those with
y up.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.transforms import angle_deg, centroid, rotation_to_up
from mtpcr_geo.method.downsample import one_per_voxel

CELLS_ACROSS = 30
"""Cells along the edge of a square of the cloud's extent in which lowest points are taken."""
NEAR_PER_EXTENT = 1 / 60
"""Distance from the plane within which a cell's lowest point counts as on it, over the extent."""
FEWEST_CELLS = 12
ROUNDS = 8
FIT_ROUNDS = 10
VOXELS_ACROSS, POINTS, MANY_POINTS = 150.0, 20_000, 60_000
"""Voxels along the extent, and points of them that are looked at: few, and many where few show no floor.
Among tall trees a scanner on the ground has most of its points on stems and crowns."""
APART_DEG = 10.0
"""Floors that are no farther apart are one."""
STILL_DEG = 0.02
MOST_CELLS = 10_000_000
"""Cells of a grid above which only those with points are numbered: two sites far apart span any number."""
LEAST_UNEVEN = 1e-3
"""Spread over extent below which floors count as equally even."""


@dataclass(frozen=True)
class Floor:
    """The sheet of lowest points along a direction.

    Attributes:
        up: (3,) unit normal, pointing to where the other points are.
        cells: cells whose lowest point is near it: its area, in cells of 1/30 of the extent.
        share: of the cells seen.
        spread_m: robust spread of the lowest points about it, metres.
        extent_m: of the cloud, metres.
        above: of the points well off the plane, the share above it; 1/2 where there are none. On a plain it
            alone tells up from down.

    """

    up: Floats
    cells: int
    share: float
    spread_m: float
    extent_m: float
    above: float

    @property
    def quality(self) -> float:
        """Area over unevenness, times the share above it: what floors are ranked by."""
        return self.cells * self.above / (self.spread_m / self.extent_m + LEAST_UNEVEN)

    @property
    def even(self) -> bool:
        """Whether it is a sheet at all: most lowest points lie near one plane."""
        return self.spread_m <= self.extent_m * NEAR_PER_EXTENT


def extent_of(xyz: Floats) -> float:
    """Return the middle one of a cloud's three extents, metres, whichever way it is turned; strays left out.

    It is the width of what is seen from above, where a cloud is wider than it is high.
    """
    xyz = xyz[:: max(1, len(xyz) // POINTS)]
    _, axes = np.linalg.eigh(np.cov((xyz - np.median(xyz, axis=0)).T))
    low, high = np.percentile(xyz @ axes, [2.0, 98.0], axis=0)
    return float(max(np.sort(high - low)[1], 1e-3))


def floor_along(xyz: Floats, about: Floats, extent: float) -> Floor:
    """Find the floor seen along a direction, and follow its plane until it stands still.

    Args:
        xyz: (n, 3) thinned points, metres.
        about: (3,) unit vector, roughly up.
        extent: of the cloud, metres, see `extent_of`.

    """
    xyz = xyz - centroid(xyz)
    cell, near = extent / CELLS_ACROSS, extent * NEAR_PER_EXTENT
    up = about
    found = Floor(about, 0, 0.0, float("inf"), extent, 0.5)
    for _ in range(ROUNDS):
        R = rotation_to_up(up)
        turned = xyz @ R.T
        lowest = _lowest(turned, cell)
        if len(lowest) < FEWEST_CELLS:
            return found
        slope, level, rest = _plane(lowest, extent)
        on = np.abs(rest) < near
        spread = 1.4826 * float(np.median(np.abs(rest)))
        normal = np.array([-slope[0], -slope[1], 1.0])
        new = R.T @ (normal / np.linalg.norm(normal))
        well_off = max(4.0 * spread, LEAST_UNEVEN * extent)
        height = turned @ normal - level
        above, below = (height > well_off).sum(), (height < -well_off).sum()
        share = float((above + 1) / (above + below + 2))
        found = Floor(new, int(on.sum()), float(on.mean()), spread, extent, share)
        moved, up = angle_deg(up, new), new
        if moved < STILL_DEG:
            break
    return found


def _lowest(xyz: Floats, cell: float) -> Floats:
    """Return the lowest point of each cell, (m, 3), the outermost hundredth of the points left out."""
    columns = np.ascontiguousarray(xyz.T[:2])
    limits = [np.percentile(column, [0.5, 99.5]) for column in columns]
    inside = np.ones(len(xyz), bool)
    for column, (low, high) in zip(columns, limits, strict=True):
        inside &= (column >= low) & (column <= high)
    xyz = xyz[inside]
    key = _cell_numbers(np.floor((xyz[:, :2] - [low for low, _ in limits]) / cell))
    z = np.ascontiguousarray(xyz[:, 2])
    # hardly any points may all be left out
    lowest = np.full(int(key.max(initial=-1)) + 1, np.inf)
    np.minimum.at(lowest, key, z)
    low_ones = np.flatnonzero(z == lowest[key])
    _, first = np.unique(key[low_ones], return_index=True)
    return np.asarray(xyz[low_ones[first]])


def _cell_numbers(cells: Floats) -> NDArray[np.int64]:
    """Return a number for each cell (n, 2), in the order of columns and rows, without room for empty ones."""
    across = cells.max(axis=0, initial=0.0) + 1.0
    if across.prod() <= MOST_CELLS:
        column, row = cells.astype(np.int64).T
        return np.asarray(column * int(across[1]) + row)
    column, row = (np.unique(one, return_inverse=True)[1].astype(np.int64) for one in cells.T)
    numbers = np.unique(column * (int(row.max(initial=0)) + 1) + row, return_inverse=True)[1]
    return np.asarray(numbers, np.int64)


def _plane(lowest: Floats, extent: float) -> tuple[Floats, float, Floats]:
    """Fit a plane to lowest points: its slope (2,), its height at the origin, and (m,) heights above it.

    What lies above it counts less than what lies below: cells that see no ground show canopy or a roof.
    """
    A = np.column_stack([np.ones(len(lowest)), lowest[:, :2]])
    weight = np.ones(len(lowest))
    x: Floats = np.zeros(3)
    rest: Floats = np.zeros(len(lowest))
    for _ in range(FIT_ROUNDS):
        fit = np.linalg.lstsq(A * weight[:, None], lowest[:, 2] * weight, rcond=None)[0]
        x = np.asarray(fit, np.float64)
        rest = np.asarray(lowest[:, 2] - A @ x, np.float64)
        scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-4 * extent)
        weight = 1.0 / (1.0 + (np.where(rest > 0, rest, rest / 2.0) / scale) ** 2)
    return x[1:], float(x[0]), rest


def floors_of(xyz: Floats, extent: float, rng: np.random.Generator) -> tuple[Floor, ...]:
    """Find the distinct floors of a cloud, from both ends of each axis, best first.

    Args:
        xyz: (n, 3) points, metres.
        extent: of the cloud, metres, see `extent_of`.
        rng: thins the points.

    """
    thin = one_per_voxel(xyz, extent / VOXELS_ACROSS, rng, MANY_POINTS)
    few = thin if len(thin) <= POINTS else thin[np.sort(rng.choice(len(thin), POINTS, replace=False))]
    found = _floors(few, extent)
    if len(thin) > POINTS and not found[0].even:
        found = _floors(thin, extent)
    distinct: list[Floor] = []
    for floor in found:
        if all(angle_deg(floor.up, other.up) > APART_DEG for other in distinct):
            distinct.append(floor)
    return tuple(distinct)


def _floors(thin: Floats, extent: float) -> list[Floor]:
    """Find the floors of thinned points from both ends of each axis, best first."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])[[2, 5, 0, 1, 3, 4]]
    with ThreadPoolExecutor(usable_cores()) as threads:
        floors = threads.map(lambda axis: floor_along(thin, axis, extent), axes)
        return sorted(floors, key=lambda floor: -floor.quality)
