"""Results of the fits: the solved transform, height on ground, ICP and refinement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import ComparesArrays, Floats, Mask
from mtpcr_geo.core.equations import BlockEquations

IcpMethod = Literal["gicp", "point_to_plane", "point_to_point"]


@dataclass(frozen=True)
class SolveSettings:
    """How a transform is solved from tie points.

    Attributes:
        robust_start: begin from the yaw and shift that RANSAC finds; else from all tie points, as in the
            paper.
        upright: solve yaw and shift, trusting the levelling; else all six degrees of freedom.
        tries: pairs of tie points that RANSAC tries.
        seed: of RANSAC.

    """

    robust_start: bool = True
    upright: bool = True
    tries: int = 2000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Solution(ComparesArrays):
    """Result of the iterative SVD, in levelled coordinates.

    Attributes:
        T: 4x4 from source to target.
        inlier: (n,) tie points within the final threshold.
        iterations: rounds until nothing changed.
        threshold: final residual threshold, metres.
        settings: how it was solved.
        used: tie points it was solved from.

    """

    T: Floats
    inlier: Mask
    iterations: int
    threshold: float
    settings: SolveSettings = SolveSettings()
    used: int = 0

    def audit(self) -> dict[str, Any]:
        """Return the figures of the solution, for the audit."""
        return {
            "used": self.used,
            "inliers": int(self.inlier.sum()),
            "iterations": self.iterations,
            "threshold_m": self.threshold,
            "yaw_deg": float(np.degrees(transforms.yaw_of(self.T[:3, :3]))),
            "settings": {one.name: getattr(self.settings, one.name) for one in fields(self.settings)},
        }


@dataclass(frozen=True, eq=False)
class GroundFit(ComparesArrays):
    """Height, and tilt where wanted, settled on the ground that both clouds see.

    Attributes:
        T: 4x4 from source to target, work coordinates.
        cells: cells where both see the ground.
        agreeing: of these, cells that agree with the fit.
        rise_m: metres by which the source was raised; None where too little ground is seen.
        spread_m: robust spread of the agreeing cells' height differences, metres.
        tilt_deg: angle by which the source was tilted, degrees.
        followed: whether the transform was taken over.

    """

    T: Floats
    cells: int
    agreeing: int = 0
    rise_m: float | None = None
    spread_m: float | None = None
    tilt_deg: float = 0.0
    followed: bool = True

    def audit(self) -> dict[str, Any]:
        """Return the figures of the fit, for the audit."""
        if self.rise_m is None:
            return {"ground_cells": self.cells, "followed": self.followed}
        return {
            "ground_cells": self.cells,
            "ground_cells_agreeing": self.agreeing,
            "rise_m": self.rise_m,
            "ground_spread_m": self.spread_m,
            "tilt_deg": self.tilt_deg,
            "followed": self.followed,
        }


@dataclass(frozen=True)
class IcpRound:
    """One round of ICP.

    Attributes:
        max_correspondence_distance_m: farthest correspondence, metres.
        iterations: iterations done.
        inliers: points with a correspondence at the end.
        converged: whether it stood still.

    """

    max_correspondence_distance_m: float
    iterations: int
    inliers: int
    converged: bool


@dataclass(frozen=True)
class IcpTrial:
    """How well one candidate of the refinement fits.

    Attributes:
        surface_residual: how badly flat surfaces meet: 0 all meet, 1 none does.
        tie_points: tie points that agree with it in plan.

    """

    surface_residual: float
    tie_points: int


@dataclass(frozen=True, eq=False)
class IcpResult(ComparesArrays):
    """What ICP came to, and which of its runs was followed.

    Attributes:
        T: 4x4 from source to target, work coordinates.
        method: ICP variant.
        voxel_m: thinning, metres.
        points_source, points_target: points kept of each cloud.
        tried: the candidates by name: starts and runs of ICP.
        chosen: name of the candidate taken.
        followed: whether it is a run of ICP.
        lost_tie_points: whether a run whose surfaces met better was not followed, since it lost tie points.
        left_tie_points: whether the run that was followed lost them: few had agreed, and surfaces met far
            better.
        contested: whether surfaces and tie points contradict each other: either of these, by however little
            surfaces met better.
        rounds: rounds of the run that was followed.
        rotated_deg: angle by which it turned the start, degrees; None where none was followed.
        fine: the last round at a finer thinning, where the density bears one.
        fine_voxel_m: that thinning, metres.
        T_surfaces: 4x4 of the run under which surfaces meet best, whether it was followed or not.

    """

    T: Floats
    method: IcpMethod
    voxel_m: float
    points_source: int
    points_target: int
    tried: Mapping[str, IcpTrial]
    chosen: str
    followed: bool
    lost_tie_points: bool
    rounds: tuple[IcpRound, ...] = ()
    rotated_deg: float | None = None
    fine: IcpRound | None = None
    fine_voxel_m: float | None = None
    T_surfaces: Floats | None = None
    contested: bool = False
    left_tie_points: bool = False

    def audit(self) -> dict[str, Any]:
        """Return the figures of the runs, for the audit."""
        rounds: dict[str, Any] = {}
        if self.rotated_deg is not None:
            rounds = {"rounds": [vars(one) for one in self.rounds], "rotated_deg": self.rotated_deg}
        if self.fine is not None:
            rounds["fine"] = {"voxel_m": self.fine_voxel_m, **vars(self.fine)}
        return {
            "method": self.method,
            "voxel_m": self.voxel_m,
            "points_source": self.points_source,
            "points_target": self.points_target,
            "tried": {name: vars(trial) for name, trial in self.tried.items()},
            "chosen": self.chosen,
            "followed": self.followed,
            "lost_tie_points": self.lost_tie_points,
            "left_tie_points": self.left_tie_points,
            **rounds,
        }


@dataclass(frozen=True, eq=False)
class Refinement(ComparesArrays):
    """Result of the refinement.

    Attributes:
        T: 4x4 from source to target, work coordinates.
        T_before: the same before the refinement.
        ground_before: height and tilt settled before ICP, where that was asked for.
        icp: what ICP came to, where it ran.
        ground_after: height settled after ICP, where that was asked for.
        equations: of the last round of ICP, in blocks; None where none was followed.
        slid_m: how far ICP had slid in plan where plan and yaw were left as the tie points have them, metres;
            None where they were not.
        again: why clouds were matched and solved a second time before, or refined from another place than the
            tie points', for people; None where they were not.
        T_solved: 4x4 where the tie points had led, if the refinement began elsewhere; None if it began there.
        raised: whether it began again, without the ground, at the height at which far more of both clouds
            meets than where their lowest points had led.

    """

    T: Floats
    T_before: Floats
    ground_before: GroundFit | None = None
    icp: IcpResult | None = None
    ground_after: GroundFit | None = None
    equations: BlockEquations | None = None
    slid_m: float | None = None
    again: str | None = None
    T_solved: Floats | None = None
    raised: bool = False

    def audit(self) -> dict[str, Any]:
        """Return what each step did, for the audit."""
        steps: dict[str, GroundFit | IcpResult | None] = {
            "ground_before": self.ground_before,
            "icp": self.icp,
            "ground_after": self.ground_after,
        }
        found: dict[str, Any] = {name: step.audit() for name, step in steps.items() if step is not None}
        if self.raised:
            found["raised"] = True
        return found if self.slid_m is None else {**found, "slid_m": self.slid_m}

    def in_frame(self, A: Floats) -> Refinement:
        """Return the same refinement in another frame of the target.

        Args:
            A: 4x4 rigid transform from the target's coordinates so far to the new ones.

        """

        def grounded(fit: GroundFit | None) -> GroundFit | None:
            return None if fit is None else replace(fit, T=A @ fit.T)

        icp = self.icp
        if icp is not None:
            surfaces = None if icp.T_surfaces is None else A @ icp.T_surfaces
            icp = replace(icp, T=A @ icp.T, T_surfaces=surfaces)
        return replace(
            self,
            T=A @ self.T,
            T_before=A @ self.T_before,
            ground_before=grounded(self.ground_before),
            icp=icp,
            ground_after=grounded(self.ground_after),
            equations=None if self.equations is None else self.equations.in_frame(A),
            T_solved=None if self.T_solved is None else A @ self.T_solved,
        )
