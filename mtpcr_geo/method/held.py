"""Holding a refinement to the tie points where surfaces slide along each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Refinement

SLIDES_CELLS = 0.5
"""Cells that a refinement may move a scene that repeats itself in plan: about how exact its tie points are.
On sites of rows and trees ICP went 0.1 to 0.3 m from them where both were as good, and 0.4 to 0.7 m where it
had slid."""
SLIDES_ALIKE = 0.87
"""Share of the surfaces' residual under the tie points that is left where ICP slid, at the least: rows meet a
little better somewhere along themselves (0.91 where it slid by 0.6 m, 0.87 to 1.00 on eight sites where it
did not), and surfaces that meet clearly better (0.56 and 0.83, where tie points were 1.7 and 0.26 m off) tell
more than a few tie points."""


def held_to_tie_points(refinement: Refinement, pivot: Floats, R_level: Floats, within_m: float) -> Refinement:
    """Return a refinement that leaves plan and yaw as the tie points have them, if it went far from there.

    Along rows of trees, vines or panels surfaces meet wherever the clouds slide to, and hardly better in one
    place than in another. Tie points, each the peak of a patch that sees gaps and single trees, do not slide,
    and are exact to a part of a cell.

    Args:
        refinement: of a scene that repeats itself.
        pivot: (3,) middle of the tie points, source work coordinates.
        R_level: (3, 3) rotation that levels the target.
        within_m: how far it may go in plan, metres.

    """
    T, before = refinement.T, refinement.T_before
    start = transforms.apply(before, pivot[None])[0]
    went = R_level @ (transforms.apply(T, pivot[None])[0] - start)
    slid = float(np.hypot(went[0], went[1]))
    if slid <= within_m or _share_left(refinement) < SLIDES_ALIKE:
        return refinement
    turned = R_level @ T[:3, :3] @ before[:3, :3].T @ R_level.T
    tilted = transforms.yaw_matrix(-transforms.yaw_of(turned)) @ turned
    R = R_level.T @ tilted @ R_level @ before[:3, :3]
    place = start + R_level.T @ np.array([0.0, 0.0, went[2]])
    return replace(refinement, T=transforms.compose(R, place - R @ pivot), slid_m=slid)


def _share_left(refinement: Refinement) -> float:
    """Return the share of the surfaces' residual under the tie points that ICP left; 1 where unknown."""
    icp = refinement.icp
    if icp is None or not icp.followed:
        return 1.0
    starts = [icp.tried[name].surface_residual for name in ("tie_points", "ground") if name in icp.tried]
    return icp.tried[icp.chosen].surface_residual / max(min(starts), 1e-12) if starts else 1.0
