"""Drift: whether what is left after the fit bends along the source, as it does in a map that is not rigid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.equations import BlockEquations

FEWEST = 12
CLEAR = 4.0
"""Times its own standard error from which a bend is told."""


@dataclass(frozen=True)
class Drift:
    """The bend of what is left along the main axis of the overlap.

    Attributes:
        plan_m, height_m: by how much the middle departs from the line between both ends, metres, in plan
            and in height.
        length_m: of the overlap along that axis.
        clear: times its standard error of the clearer of both.

    """

    plan_m: float
    height_m: float
    length_m: float
    clear: float

    @property
    def told(self) -> bool:
        """Whether it is more than the blocks' own scatter gives."""
        return self.clear >= CLEAR


def drift_of(equations: BlockEquations, R_level: Floats, giving_way: float = 1.0) -> Drift | None:
    """Measure how the blocks' own shifts bend along the overlap.

    Each block is shifted to where it fits best by itself. A rigid error of the pose makes these shifts grow
    in step with the distance; a parabola through them is what no rigid motion mends.

    Args:
        equations: of the final fit.
        R_level: (3, 3) rotation from the target's work axes to the levelled ones.
        giving_way: times that correspondences let a block move less than it would.

    Returns:
        None where there are too few blocks.

    """
    if len(equations.H) < FEWEST:
        return None
    places = (equations.centres - equations.pivot) @ R_level.T
    values, axes = np.linalg.eigh(np.cov(places[:, :2].T))
    along = places[:, :2] @ axes[:, int(np.argmax(values))]
    half = max(float(np.ptp(along)) / 2.0, 1e-9)
    s = (along - (along.max() + along.min()) / 2.0) / half
    shift = np.array(
        [
            np.linalg.lstsq(h[3:, 3:], v[3:], rcond=1e-6)[0]
            for h, v in zip(equations.H, equations.b, strict=True)
        ]
    )
    shift = giving_way * shift @ R_level.T
    A = np.column_stack([np.ones(len(s)), places[:, :2] / half, s**2])
    weight = np.ones(len(s))
    x: Floats = np.zeros((A.shape[1], 3))
    for _ in range(5):
        x = np.asarray(np.linalg.lstsq(A * weight[:, None], shift * weight[:, None], rcond=None)[0])
        left = np.linalg.norm(shift - A @ x, axis=1)
        scale = 1.4826 * float(np.median(left)) + 1e-12
        weight = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2)
    residual = (shift - A @ x) * weight[:, None]
    variance = (residual**2).sum(axis=0) / max(float((weight**2).sum()) - A.shape[1], 1.0)
    spread = np.linalg.pinv((A * weight[:, None]).T @ (A * weight[:, None]))[-1, -1]
    error = np.sqrt(variance * spread) + 1e-12
    bend = x[-1]
    return Drift(
        plan_m=float(np.hypot(bend[0], bend[1])),
        height_m=float(abs(bend[2])),
        length_m=2.0 * half,
        clear=float(np.abs(bend / error).max()),
    )
