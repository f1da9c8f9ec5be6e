"""Refinement: height settled on the ground, ICP followed where surfaces and tie points agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.method.icp import Descent, Method, Rounds, Surfaces
from mtpcr_geo.method.overlap import Overlap, overlap_of

Floats = NDArray[np.float64]
Motion = Literal["rigid", "yaw", "translation"]

FEWEST_GROUND_CELLS = 30
CORRELATED_CELLS = 50
GROUND_NOISE_M = 0.5
LEVEL_SIGMA_DEG = 1.0
SCATTER_SHARE, SCATTER_M = 0.5, 0.03
CLEARLY = 1.01
"""Times that the residual after ICP must exceed a start's for the start to be taken: on bare, sparse ground
they are equal but for chance, and results would jump with it."""


@dataclass(frozen=True)
class Refinement:
    """Result of the refinement.

    Attributes:
        T: 4x4 from source to target, work coordinates.
        report: what was done, for the audit.

    """

    T: Floats
    report: dict[str, Any] = field(default_factory=dict)


def follow_icp(
    surfaces: Surfaces,
    starts: dict[str, Floats],
    *,
    rounds: dict[str, Rounds],
    agreeing: Callable[[Floats], int],
    keep_tie_points: float,
    method: Method = "gicp",
    iterations: int = 30,
) -> Refinement:
    """Run ICP with several reaches, and take what the surfaces fit best, the starts themselves among it.

    A far reach catches starts that are off by metres, but on open ground it lets the clouds slide; a near
    one does not. Neither is right where crops or bushes grew between the surveys and hold the least squares
    off the ground, which `Surfaces.residual` sees through. In plan only the tie points have seen anything
    on open
    ground, so what loses them is not followed.

    Args:
        surfaces: of both clouds.
        starts: 4x4 from source to target work coordinates by name; ICP starts from the last.
        rounds: the runs of ICP to try, by name.
        agreeing: counts the tie points that a transform brings together.
        keep_tie_points: share of the tie points agreeing at the last start that must still agree; 0
            follows ICP always.
        method: of `Surfaces.descend`.
        iterations: at most, each round.

    """
    *_, last = starts
    runs = {
        name: surfaces.descend(starts[last], one, method=method, iterations=iterations)
        for name, one in rounds.items()
    }
    tried = {name: T for name, T in starts.items() if keep_tie_points > 0} | {
        name: run.T for name, run in runs.items()
    }
    wanted = keep_tie_points * agreeing(starts[last])
    surface_residual = {name: surfaces.surface_residual(T) for name, T in tried.items()}
    tie_points = {name: agreeing(T) for name, T in tried.items()}
    kept = [name for name in tried if name == last or tie_points[name] >= wanted]
    best = min(kept, key=lambda name: surface_residual[name] * (1.0 if name in runs else CLEARLY))
    lost = [name for name in runs if name not in kept and surface_residual[name] < surface_residual[best]]
    report = {
        "method": method,
        "voxel_m": surfaces.voxel_m,
        "points_source": surfaces.sizes[0],
        "points_target": surfaces.sizes[1],
        "tried": {
            name: {"surface_residual": surface_residual[name], "tie_points": tie_points[name]}
            for name in tried
        },
        "chosen": best,
        "followed": best in runs,
        "lost_tie_points": bool(lost),
        **_moved(runs, best, starts[last]),
    }
    return Refinement(tried[best], report)


def _moved(runs: dict[str, Descent], best: str, T_start: Floats) -> dict[str, Any]:
    """Return what the run that was followed did; nothing if none was."""
    if best not in runs:
        return {}
    turn = runs[best].T[:3, :3] @ T_start[:3, :3].T
    return {"rounds": runs[best].rounds, "turned_deg": float(np.degrees(transforms.rotation_angle(turn)))}


def settle_on_ground(
    source: Floats, target: Floats, T_start: Floats, *, tilt: bool, overlap: Overlap | None = None
) -> Refinement:
    """Correct the height, and if wanted the tilt, so that both clouds' ground agrees.

    Canopy and facades bias the height of a fit to everything; the lowest surface does not. A plane is
    fitted to the ground's height differences with weights that fade for what does not agree.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.
        T_start: 4x4 from source to target.
        tilt: whether to correct the tilt too, where the ground extends far enough to tell it.
        overlap: both clouds on one grid under ``T_start``, if at hand.

    """
    if overlap is None:
        overlap = overlap_of(transforms.apply(T_start, source), target)
    xy, step = overlap.ground_steps()
    if len(step) < FEWEST_GROUND_CELLS:
        return Refinement(T_start, {"ground_cells": len(step)})
    centre = xy.mean(axis=0)
    offset = xy - centre
    A = np.column_stack([np.ones(len(step)), offset]) if tilt else np.ones((len(step), 1))
    # neighbouring cells err together, and clouds come levelled to about a degree: both bound the tilt
    prior = np.zeros((A.shape[1], A.shape[1]))
    if tilt:
        prior[1, 1] = prior[2, 2] = CORRELATED_CELLS * GROUND_NOISE_M**2 / np.radians(LEVEL_SIGMA_DEG) ** 2
    x = np.zeros(A.shape[1])
    x[0] = np.median(step)
    scale = 1.0
    for scale in (2.0, 1.0, 0.6, 0.4, 0.3, 0.3, 0.3, 0.3):
        residual = step - A @ x
        weight = 1.0 / (1.0 + (residual / scale) ** 2) ** 2
        x = np.linalg.solve((A * weight[:, None]).T @ A + prior, (A * weight[:, None]).T @ step)
    residual = step - A @ x
    close = np.abs(residual) < 3 * scale
    spread = 1.4826 * float(np.median(np.abs(residual[close]))) if close.any() else float("nan")
    pivot = np.array([centre[0], centre[1], float(np.nanmedian(overlap.source.low))])
    R = np.eye(3)
    slope = float(np.hypot(x[1], x[2])) if tilt else 0.0
    if slope > 1e-12:
        # raising the ground towards +x means turning about -y, and towards +y about +x
        R = transforms.axis_angle_matrix(np.array([x[2], -x[1], 0.0]) / slope, float(np.arctan(slope)))
    T = transforms.translation((0.0, 0.0, float(x[0]))) @ transforms.about(pivot, R) @ T_start
    report = {
        "ground_cells": len(step),
        "ground_cells_agreeing": int(close.sum()),
        "rise_m": float(x[0]),
        "ground_spread_m": spread,
        "tilt_deg": float(np.degrees(transforms.rotation_angle(R))),
    }
    return Refinement(T, report)


def beyond_scatter(settled: Refinement) -> bool:
    """Return whether the ground's rise is more than where the borders of its cells run can make of it.

    The lowest of a cell lies the lower the denser the cloud and the steeper the ground, by a part of the
    cells' own scatter. A fit to all points knows the height better than that.
    """
    report = settled.report
    if "rise_m" not in report:
        return False
    return bool(abs(report["rise_m"]) > min(SCATTER_SHARE * report["ground_spread_m"], SCATTER_M))


def constrain(T: Floats, motion: Motion, pivot: Floats, R_upright: Floats) -> Floats:
    """Hold a transform to fewer degrees of freedom, keeping where it takes the overlap.

    Args:
        T: 4x4 from source to target, work coordinates.
        motion: "rigid" keeps all six, "yaw" drops the tilt, "translation" drops the yaw too.
        pivot: (3,) middle of the overlap, source coordinates: it goes where T takes it.
        R_upright: (3, 3) rotation that both levellings make; what yaw is counted from.

    """
    if motion == "rigid":
        return T
    R = R_upright
    if motion == "yaw":
        R = transforms.yaw_matrix(transforms.yaw_of(T[:3, :3] @ R_upright.T)) @ R_upright
    return transforms.compose(R, T[:3, :3] @ pivot + T[:3, 3] - R @ pivot)
