"""How a scanner or its program wrote a local cloud: in which unit, and with which axis up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.units import UNITS, Axes, Unit

_ROTATIONS: dict[Axes, tuple[tuple[int, int, int], ...]] = {
    "z-up": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y-up": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x-up": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "z-down": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y-down": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x-down": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
assert set(_ROTATIONS) == set(get_args(Axes))


@dataclass(frozen=True)
class Scanner:
    """What is declared of a local cloud's coordinates.

    Attributes:
        unit: their unit; None where nothing is declared, which is taken as metres.
        axes: which of them points up; they are right-handed.

    """

    unit: Unit | None = None
    axes: Axes = "z-up"

    @property
    def metres(self) -> float:
        """Metres a unit."""
        return 1.0 if self.unit is None else UNITS[self.unit][0]

    @property
    def unit_name(self) -> str:
        """Name of the unit."""
        return UNITS[self.unit or "m"][1]

    @property
    def is_plain(self) -> bool:
        """Return whether it declares metres, or nothing, and z up."""
        return self.metres == 1.0 and self.axes == "z-up"


def rotation_of(axes: Axes) -> Floats:
    """Return the (3, 3) rotation from coordinates with those axes to such with z up; quarter turns only."""
    return np.array(_ROTATIONS[axes], np.float64)


PLAIN = Scanner()

FARTHEST_LOCAL_M = 20_000.0
"""Extent in plan beyond which no local cloud is in metres."""
THINNEST_PER_M2, WIDE_M = 0.01, 3_000.0
"""Points per square metre below which a local cloud wider than this is not in metres."""
TALLEST_M, TALL_SHARE = 1_000.0, 0.3
"""Height beyond which, at that share of the plan, a local cloud is not in metres."""
SMALLEST_M = 1.0
"""Extent in plan below which a cloud is no place, in metres."""
_LIKELY_M = (3.0, 3_000.0)


def unit_by_size(size: Floats, points: int) -> Unit | None:
    """Return the unit in which a local cloud seems to be, judged by metres; None where metres do.

    Feet and inches cannot be told from metres by size.

    Args:
        size: (3,) extent of nearly all its points, in its units, in any order of axes.
        points: their number.

    """
    *_, second, plan = np.sort(size).tolist()
    height = float(np.min(size))
    thin = points < THINNEST_PER_M2 * plan * second and plan > WIDE_M
    tall = height > TALLEST_M and height > TALL_SHARE * plan
    if thin or tall or plan > FARTHEST_LOCAL_M:
        units: tuple[Unit, ...] = ("mm", "cm")
        return next((unit for unit in units if plan * UNITS[unit][0] <= _LIKELY_M[1]), "mm")
    if 0.0 < plan < SMALLEST_M and plan * 1000.0 >= _LIKELY_M[0]:
        return "km"
    return None


def check_unit(name: str, role: str, xyz: Floats, points: int) -> None:
    """Refuse a local cloud that cannot be in metres, where no unit is declared.

    Args:
        name: of the cloud.
        role: "source" or "target".
        xyz: (n, 3) a sample of it, in its units.
        points: of the whole cloud.

    Raises:
        InputError: naming the unit in which it seems to be, and the option that takes it so.

    """
    size = np.subtract(*np.percentile(xyz, [99.5, 0.5], axis=0))
    unit = unit_by_size(size, points)
    if unit is None:
        return
    across, really = (
        " x ".join(f"{one:,.0f}" if one >= 100 else f"{one:.3g}" for one in size * metres)
        for metres in (1.0, UNITS[unit][0])
    )
    raise InputError(
        f"{name} looks like {UNITS[unit][1]}s: as metres it would span {across} m with {points:,} points, as "
        f"{UNITS[unit][1]}s {really} m; give --{role}-unit {unit}, or --{role}-unit m if it is in metres"
    )
