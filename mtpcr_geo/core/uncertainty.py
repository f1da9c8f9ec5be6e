"""How uncertain a pose is: a covariance about a pivot, and what it means at any place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mtpcr_geo.core.arrays import ComparesArrays, Floats

NORMAL_95 = 1.959964
"""Half width, in standard deviations, of the interval that holds 95 % of a normal distribution."""
PLANE_95 = 2.447747
"""The same of the circle that holds 95 % of one in the plane whose deviations are equal."""


@dataclass(frozen=True, eq=False)
class Uncertainty(ComparesArrays):
    """Covariance of the error of a pose, as a correction about a pivot.

    Attributes:
        covariance: (6, 6) of (rx, ry, rz, tx, ty, tz), radians and metres: rotations about axes through the
            pivot, and shifts, along x, y and up of the levelled target (east, north, up where it has a CRS).
        pivot: (3,) middle of what the pose was fitted to, in the target's work coordinates, metres.
        R_level: (3, 3) rotation from the target's work axes to the levelled ones.
        far: (3,) the registered source's point that lies farthest from the pivot in plan, target work
            coordinates, metres.
        blocks: blocks of the overlap that it was taken from.
        correspondences: their points.
        fitted: what was fitted: "surfaces" or "tie points".

    """

    covariance: Floats
    pivot: Floats
    R_level: Floats
    far: Floats
    blocks: int
    correspondences: int
    fitted: str

    def at(self, places: Floats) -> Floats:
        """Return the covariance of position (n, 3, 3), square metres, at places of the registered source.

        Args:
            places: (n, 3) target work coordinates, metres.

        Returns:
            Along x, y and up of the levelled target.

        """
        x, y, z = ((np.atleast_2d(places) - self.pivot) @ self.R_level.T).T
        J = np.zeros((len(x), 3, 6))
        J[:, 0, 1], J[:, 0, 2] = z, -y
        J[:, 1, 0], J[:, 1, 2] = -z, x
        J[:, 2, 0], J[:, 2, 1] = y, -x
        J[:, [0, 1, 2], [3, 4, 5]] = 1.0
        return np.asarray(J @ self.covariance @ J.transpose(0, 2, 1))

    def sigmas(self, places: Floats) -> tuple[Floats, Floats]:
        """Return the expected error over the source's extent.

        Args:
            places: (n, 3) points of the registered source, target work coordinates, metres.

        Returns:
            (n,) standard deviation in plan along the direction in which it is largest, and (n,) standard
            deviation of height, metres.

        """
        C = self.at(places)
        return np.sqrt(_largest(C[:, :2, :2])[0]), np.sqrt(C[:, 2, 2])

    def within_95(self, places: Floats) -> tuple[Floats, Floats]:
        """Return what 95 % of the errors stay below at each place, in plan and height: (n,), (n,) metres."""
        C = self.at(places)
        return circle_95(C[:, :2, :2]), NORMAL_95 * np.sqrt(C[:, 2, 2])

    @property
    def sigma_yaw_deg(self) -> float:
        """Standard deviation of the yaw, degrees."""
        return float(np.degrees(np.sqrt(self.covariance[2, 2])))

    @property
    def sigma_tilt_deg(self) -> float:
        """Standard deviation of the tilt about the level axis about which it is largest, degrees."""
        return float(np.degrees(np.sqrt(_largest(self.covariance[None, :2, :2])[0][0])))

    @property
    def weakest_deg(self) -> float:
        """Direction in plan in which the middle is least certain: from y (north) to x (east), 0 to 180."""
        axis = _largest(self.covariance[None, 3:5, 3:5])[1][0]
        return float(np.degrees(np.arctan2(axis[0], axis[1])) % 180.0)

    @property
    def metrics(self) -> dict[str, Any]:
        """The figures by their names in ``run.json``."""
        places = np.array([self.pivot, self.far])
        plan, height = self.sigmas(places)
        plan_95, height_95 = self.within_95(places)
        return {
            "sigma_plan_m": float(plan[0]),
            "sigma_height_m": float(height[0]),
            "sigma_yaw_deg": self.sigma_yaw_deg,
            "sigma_tilt_deg": self.sigma_tilt_deg,
            "sigma_plan_far_m": float(plan[1]),
            "sigma_height_far_m": float(height[1]),
            "within_95_plan_m": float(plan_95[0]),
            "within_95_height_m": float(height_95[0]),
            "within_95_plan_far_m": float(plan_95[1]),
            "within_95_height_far_m": float(height_95[1]),
            "weakest_direction_deg": self.weakest_deg,
            "uncertainty_blocks": self.blocks,
        }


def circle_95(C: Floats) -> Floats:
    """Return the radius of the circle that holds 95 % of each normal distribution (n, 2, 2), (n,).

    A cubic in the ratio of the standard deviations, after Leenhouts (1985, Navigation 32(1)), exact to 0.2 %.
    """
    largest, _ = _largest(C)
    smallest = np.maximum(np.trace(C, axis1=1, axis2=2) - largest, 0.0)
    ratio = np.sqrt(smallest / np.maximum(largest, 1e-300))
    return np.asarray(
        np.sqrt(largest) * (1.960790 + ratio * (0.004071 + ratio * (0.114276 + ratio * 0.371625)))
    )


def _largest(C: Floats) -> tuple[Floats, Floats]:
    """Return the largest eigenvalue of (n, 2, 2) matrices, (n,), and its unit vector, (n, 2)."""
    values, axes = np.linalg.eigh(C)
    return np.maximum(values[:, -1], 0.0), axes[:, :, -1]
