"""Sliding: the motion in plan that the fit tells least, along a street or about a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.equations import BlockEquations
from mtpcr_geo.core.uncertainty import Uncertainty

CLEARLY = 3.0
"""Times that the weakest motion must be less certain than the surest to be called a weakness."""


@dataclass(frozen=True)
class Sliding:
    """The weakest motion in plan.

    Attributes:
        sigma_m: standard deviation of that motion, metres at the overlap's root mean square radius.
        ratio: times that it is less certain than the surest motion.
        turning: share of it that is a turn about the middle, 0 to 1; the rest is a shift.
        direction_deg: of its shift, from y (north) to x (east), 0 to 180.

    """

    sigma_m: float
    ratio: float
    turning: float
    direction_deg: float


def sliding_of(uncertainty: Uncertainty, equations: BlockEquations) -> Sliding:
    """Return the motion of yaw and plan shift that the fit tells least.

    Args:
        uncertainty: of the pose.
        equations: of the fit, for the extent of the overlap.

    """
    off = (equations.centres - equations.pivot) @ uncertainty.R_level.T
    arm = max(float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())), 1e-6)
    scale = np.array([arm, 1.0, 1.0])
    C: Floats = uncertainty.covariance[2:5, 2:5] * np.outer(scale, scale)
    values, axes = np.linalg.eigh(C)
    weakest = axes[:, -1]
    return Sliding(
        sigma_m=float(np.sqrt(max(values[-1], 0.0))),
        ratio=float(np.sqrt(values[-1] / max(values[0], 1e-300))),
        turning=float(weakest[0] ** 2),
        direction_deg=float(np.degrees(np.arctan2(weakest[1], weakest[2])) % 180.0),
    )


def weakness_text(sliding: Sliding, mapped: bool) -> str:
    """Return in words along what the fit could slide."""
    if sliding.turning > 0.5:
        return "turning about the middle of the overlap"
    return f"along {direction_text(sliding.direction_deg, mapped)}"


def direction_text(degrees: float, mapped: bool) -> str:
    """Name a direction in plan, counted from y (north) to x (east), such as "N 40° E".

    Args:
        degrees: 0 to 180.
        mapped: whether y is north.

    """
    rounded = round(degrees) % 180
    if not mapped:
        return f"{(90 - rounded) % 180}° from x"
    if rounded == 0:
        return "north to south"
    if rounded == 90:
        return "east to west"
    return f"N {rounded}° E" if rounded < 90 else f"N {180 - rounded}° W"
