"""Normal equations of a fit, in blocks of the overlap: what its uncertainty is taken from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import ComparesArrays, Floats


@dataclass(frozen=True, eq=False)
class BlockEquations(ComparesArrays):
    """Linearised least squares of a fit, summed over spatial blocks of the overlap.

    A correction ``x = (rx, ry, rz, tx, ty, tz)``, radians about the axes through the pivot and metres, moves
    a point ``p`` of the registered source to ``p + r x (p - pivot) + t``; the block's best one solves
    ``H x = b``.

    Attributes:
        T: 4x4 at which the equations are linearised, from source to target work coordinates.
        pivot: (3,) middle of what was fitted, target work coordinates, metres.
        centres: (k, 3) middles of the blocks, likewise.
        H, b: (k, 6, 6) and (k, 6).
        counts: (k,) correspondences of each.
        variance: of one correspondence, in the units of H: mean weighted square of what is left.
        quarters: (q, 6) corrections that each quarter of the overlap asks for by itself.
        quarter_centres: (q, 3) middles of the quarters, target work coordinates, metres.
        gap_m: median distance between corresponding points, metres.
        fitted: what was fitted: "surfaces" or "tie points".

    """

    T: Floats
    pivot: Floats
    centres: Floats
    H: Floats
    b: Floats
    counts: Floats
    variance: float
    quarters: Floats
    quarter_centres: Floats
    gap_m: float
    fitted: str

    def inverse(self) -> BlockEquations:
        """Return the equations of the inverse fit, in which the target moves."""
        T = transforms.inverse(self.T)
        # a correction after T undoes one before the inverse; its axes turn with it
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = -T[:3, :3]
        pivot, *_ = transforms.apply(T, self.pivot[None])
        return BlockEquations(
            T=T,
            pivot=pivot,
            centres=transforms.apply(T, self.centres),
            H=A @ self.H @ A.T,
            b=self.b @ A.T,
            counts=self.counts,
            variance=self.variance,
            quarters=self.quarters @ A.T,
            quarter_centres=transforms.apply(T, self.quarter_centres),
            gap_m=self.gap_m,
            fitted=self.fitted,
        )

    def in_frame(self, A: Floats) -> BlockEquations:
        """Return the same equations in another frame of the target.

        Args:
            A: 4x4 rigid transform from the target's coordinates so far to the new ones.

        """
        Q = np.kron(np.eye(2), A[:3, :3])
        pivot, *_ = transforms.apply(A, self.pivot[None])
        return replace(
            self,
            T=A @ self.T,
            pivot=pivot,
            centres=transforms.apply(A, self.centres),
            H=Q @ self.H @ Q.T,
            b=self.b @ Q.T,
            quarters=self.quarters @ Q.T,
            quarter_centres=transforms.apply(A, self.quarter_centres),
        )
