"""Whether true errors lie within the stated uncertainty.

The truth of real pairs is itself known only so well: both clouds of an airborne pair lie in one frame as
exactly as their survey was adjusted, and which pose is right within that, nobody knows. That uncertainty of
the truth (its rotation as that shift over the radius of the whole pair's overlap) is added to the stated one,
and both stand in the row; simulated clouds have an exact truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.uncertainty import NORMAL_95, circle_95
from mtpcr_geo.method.jackknife import correction_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from mtpcr_geo.benchmark.robustness.cases import CaseClouds
    from mtpcr_geo.registration import Registration

SPACE_95 = 2.795483
"""Radius, in standard deviations, of the sphere that holds 95 % of a normal distribution in space."""
KINDS = ("plan", "height", "yaw", "tilt", "far")


def coverage_of(found: Registration, clouds: CaseClouds) -> dict[str, Any]:
    """Compare the error of a pose with its stated uncertainty.

    Args:
        found: a registration with a transform.
        clouds: with a truth, and how well that is known.

    Returns:
        sigma_*
            as the verdict states them.
        truth_m, truth_height_m
            standard deviation of the truth along each axis in plan, and in height, metres.
        plan_of_95, height_of_95, yaw_of_95, tilt_of_95
            error over the half width of the region of 95 % of both uncertainties: 1 or less is inside. Plan
            and height are those of the middle of what was fitted; plan and tilt are ellipses.
        far_of_95
            the same, in space, at the source's point that lies farthest from there.

    """
    stated, pair = found.verdict.uncertainty, found.pair
    if stated is None or pair is None or pair.T_target_source is None or clouds.T_target_source is None:
        return {}
    truth = clouds.known
    names = (
        "sigma_plan_m", "sigma_height_m", "sigma_yaw_deg", "sigma_tilt_deg", "sigma_plan_far_m",
        "sigma_height_far_m",
    )  # fmt: skip
    row: dict[str, Any] = {name: stated.metrics[name] for name in names}
    row |= {"truth_m": truth.plan_m, "truth_height_m": truth.height_m}
    # arrays are given in metres, so that work coordinates are theirs but for the origins
    T_true = (
        transforms.translation(-pair.target.link.origin)
        @ clouds.T_target_source
        @ transforms.translation(pair.source.link.origin)
    )
    x = correction_of(T_true @ transforms.inverse(pair.T_target_source), stated.pivot)
    x = np.concatenate([stated.R_level @ x[:3], stated.R_level @ x[3:]])
    C = stated.covariance + truth.covariance
    away = stated.R_level @ (stated.far - stated.pivot)
    J = np.zeros((3, 6))
    J[:, :3] = -_cross(away)
    J[:, 3:] = np.eye(3)
    row["plan_of_95"] = _of_region(x[3:5], C[3:5, 3:5])
    row["height_of_95"] = float(abs(x[5]) / (NORMAL_95 * np.sqrt(C[5, 5])))
    row["yaw_of_95"] = float(abs(x[2]) / (NORMAL_95 * np.sqrt(C[2, 2])))
    row["tilt_of_95"] = _of_region(x[:2], C[:2, :2])
    far, C_far = J @ x, J @ C @ J.T
    row["far_of_95"] = float(np.sqrt(far @ np.linalg.solve(C_far, far)) / SPACE_95)
    return row


def covered(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return for each kind of error the runs, and the share that lies within the region of 95 %.

    Args:
        rows: of right runs; those without an uncertainty are left out.

    """
    rows = list(rows)
    lines = []
    for kind in KINDS:
        values = np.array([row[f"{kind}_of_95"] for row in rows if row.get(f"{kind}_of_95") is not None])
        if len(values):
            lines.append(
                {
                    "error": kind,
                    "runs": len(values),
                    "within_95": float((values <= 1.0).mean()),
                    "median_of_95": float(np.median(values)),
                    "largest_of_95": float(values.max()),
                }
            )
    return lines


def _of_region(x: Floats, C: Floats) -> float:
    """Return the length of x over the radius of the circle of 95 %, or over the ellipse's where less."""
    on_ellipse = float(np.sqrt(x @ np.linalg.solve(C, x) / 5.991465))
    return min(on_ellipse, float(np.linalg.norm(x) / circle_95(C[None])[0]))


def _cross(v: Floats) -> Floats:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
