"""Height, and tilt where wanted, settled on the ground that both clouds show."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import GroundFit
from mtpcr_geo.method.overlap import OVERLAP_CELL_M, Overlap, overlap_of

FEWEST_GROUND_CELLS = 30
CORRELATED_CELLS = 50
GROUND_NOISE_M = 0.5
LEVEL_SIGMA_DEG = 1.0
SCATTER_SHARE, SCATTER_M = 0.5, 0.03


def settle_on_ground(
    source: Floats,
    target: Floats,
    T_start: Floats,
    *,
    tilt: bool,
    overlap: Overlap | None = None,
    cell: float = OVERLAP_CELL_M,
) -> GroundFit:
    """Correct the height, and if wanted the tilt, so that both clouds' ground agrees.

    Canopy and facades bias the height of a fit to everything; the lowest surface does not. A plane is
    fitted to the ground's height differences with weights that fade for what does not agree.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.
        T_start: 4x4 from source to target.
        tilt: whether to correct the tilt too, where the ground extends far enough to tell it.
        overlap: both clouds on one grid under ``T_start``, if at hand.
        cell: in which the ground is compared, metres, where the overlap is not at hand.

    """
    if overlap is None:
        overlap = overlap_of(transforms.apply(T_start, source), target, cell)
    xy, step = overlap.ground_steps()
    if len(step) < FEWEST_GROUND_CELLS:
        return GroundFit(T_start, len(step))
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
    return GroundFit(
        T,
        cells=len(step),
        agreeing=int(close.sum()),
        rise_m=float(x[0]),
        spread_m=spread,
        tilt_deg=float(np.degrees(transforms.rotation_angle(R))),
    )


def beyond_scatter(settled: GroundFit) -> bool:
    """Return whether the ground's rise is more than what the borders of its cells can cause.

    The lowest of a cell lies the lower the denser the cloud and the steeper the ground, by a part of the
    cells' own scatter. A fit to all points knows the height better than that.
    """
    if settled.rise_m is None or settled.spread_m is None:
        return False
    return bool(abs(settled.rise_m) > min(SCATTER_SHARE * settled.spread_m, SCATTER_M))
