"""Refinement: ICP on thinned points of the overlap, with the height settled on the ground."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo import geometry
from mtpcr_geo.errors import RegistrationError
from mtpcr_geo.overlap import Overlap, overlap_of

Floats = NDArray[np.float64]
Method = Literal["gicp", "point_to_plane", "point_to_point", "none"]

Motion = Literal["rigid", "yaw", "translation"]

_SMALL_GICP_NAMES = {"gicp": "GICP", "point_to_plane": "PLANE_ICP", "point_to_point": "ICP"}
FEWEST_POINTS = 200
FIRST_REACH_M = 3.0
MOST_CUBES = 30_000_000
STILL_RAD = 4e-6
STILL_M = 1e-4
DENSE_CUBES = 2.5
"""Points a cube of the thinning above which cubes give their mean point, and below which all are taken."""

LATTICE_M = 0.00037
"""Shift of the thinning's cubes off whole millimetres, where points of a LAS scale lie in numbers."""
FEWEST_GROUND_CELLS = 30
CORRELATED_CELLS = 50
GROUND_NOISE_M = 0.5
LEVEL_SIGMA_DEG = 1.0
SCATTER_SHARE, SCATTER_M = 0.5, 0.03


@dataclass(frozen=True)
class Refinement:
    """Result of the refinement.

    Attributes:
        T: 4x4 from source to target, work coordinates.
        report: what was done, for the audit.

    """

    T: Floats
    report: dict[str, Any] = field(default_factory=dict)


def icp(
    source: Floats,
    target: Floats,
    T_start: Floats,
    *,
    method: Method = "gicp",
    voxel_m: float = 0.5,
    reach_m: tuple[float, ...] = (3.0, 1.5, 0.75),
    most_points: int = 30_000,
    neighbours: int = 10,
    iterations: int = 30,
    threads: int = 2,
) -> Refinement:
    """Refine by iterative closest points on the overlap (small_gicp).

    The optimiser runs on one thread: sums over several would differ in their last bits from run to run.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.
        T_start: 4x4 start, source to target.
        method: "gicp" (plane to plane), "point_to_plane", or "point_to_point" (the paper's citation).
        voxel_m: thinning, metres.
        reach_m: farthest correspondence of each round, metres.
        most_points: of the source after thinning; the target, which costs less, may have three times as many.
        neighbours: points that tell a surface's direction.
        iterations: at most, each round.
        threads: for thinning and surfaces.

    Raises:
        RegistrationError: if the clouds hardly overlap under the start.

    """
    import small_gicp

    moved = geometry.apply(T_start, source)
    overlap = overlap_of(moved, target)
    of_source, of_target = (np.flatnonzero(overlap.select(xyz)) for xyz in (moved, target))
    s, t = moved[of_source], target[of_target]
    if min(len(s), len(t)) >= FEWEST_POINTS:
        near_s, near_t = _near(s, t, reach_m[0]), _near(t, s, reach_m[0])
        of_source, of_target = of_source[near_s], of_target[near_t]
        s, t = source[of_source], target[of_target]
    if min(len(s), len(t)) < FEWEST_POINTS:
        raise RegistrationError(
            f"only {min(len(s), len(t))} points of one cloud lie in the overlap, too few to refine"
        )
    pivot = np.floor(t.mean(axis=0))
    # each cloud is thinned in its own frame, so that a hair's breadth at the start changes no point
    s = geometry.apply(T_start, _thinned(source[of_source], of_source, voxel_m, most_points))
    t = _thinned(t, of_target, voxel_m, 3 * most_points)
    ps, pt = small_gicp.PointCloud(s - pivot), small_gicp.PointCloud(t - pivot)
    tree = small_gicp.KdTree(pt, threads)
    if method != "point_to_point":
        small_gicp.estimate_normals_covariances(ps, small_gicp.KdTree(ps, threads), neighbours, threads)
        small_gicp.estimate_normals_covariances(pt, tree, neighbours, threads)
    X, rounds = np.eye(4), []
    for reach in reach_m:
        # what a round leaves is taken up by the next; only the last must stand still
        patience = 1.0 if reach == reach_m[-1] else 25.0
        result = small_gicp.align(
            pt,
            ps,
            tree,
            X,
            registration_type=_SMALL_GICP_NAMES[method],
            max_correspondence_distance=reach,
            num_threads=1,
            max_iterations=iterations,
            rotation_epsilon=patience * STILL_RAD,
            translation_epsilon=patience * STILL_M,
        )
        X = np.array(result.T_target_source)
        rounds.append(
            {
                "reach_m": reach,
                "iterations": int(result.iterations),
                "inliers": int(result.num_inliers),
                "converged": bool(result.converged),
            }
        )
    X[:3, :3] = geometry.orthonormal(X[:3, :3])
    T = geometry.translation(pivot) @ X @ geometry.translation(-pivot) @ T_start
    report = {
        "method": method,
        "voxel_m": voxel_m,
        "points_source": int(ps.size()),
        "points_target": int(pt.size()),
        "rounds": rounds,
        "moved_m": float(np.linalg.norm(X[:3, 3])),
        "turned_deg": float(np.degrees(geometry.rotation_angle(X[:3, :3]))),
    }
    return Refinement(T, report)


def _near(points: Floats, others: Floats, reach: float) -> NDArray[np.bool_]:
    """Tell which points may have one of the others within reach, by cubes of that edge."""
    (low_p, high_p), (low_o, high_o) = geometry.bounds(points), geometry.bounds(others)
    span = np.maximum(high_p, high_o) - np.minimum(low_p, low_o)
    edge = max(reach, float(np.cbrt(np.prod(span + 4 * reach) / MOST_CUBES)))
    low = np.minimum(low_p, low_o) - 2 * edge
    shape = np.floor(span / edge).astype(int) + 5
    filled = np.zeros(tuple(shape.tolist()), dtype=np.bool_)
    filled[tuple(np.floor((others - low) / edge).astype(np.int64).T)] = True
    for axis in range(3):
        # cubes beside a filled one along each axis in turn: all 26 neighbours in the end
        ahead, behind = np.roll(filled, 1, axis), np.roll(filled, -1, axis)
        filled = filled | ahead | behind
    return np.asarray(filled[tuple(np.floor((points - low) / edge).astype(np.int64).T)])


def _thinned(xyz: Floats, number: NDArray[np.int64], voxel: float, most: int) -> Floats:
    """Thin (n, 3) points to at most so many, (m, 3), in a way that hangs on the points and not on the frame.

    Dense clouds give one mean point a cube. Where cubes would hold hardly more than a point each, the
    points are taken as they are, since a lattice of cubes in another CRS would cut them otherwise. What is
    too many is left out by a hash of the cube, or of the point's number: if one comes or goes, the choice
    among all others stays.

    Args:
        xyz: points, metres.
        number: (n,) the points' numbers in their cloud.
        voxel: edge of a cube, metres.
        most: points at most.

    """
    import small_gicp

    first = np.floor(geometry.bounds(xyz)[0] / voxel) - 1
    corner = first * voxel + LATTICE_M
    thin = np.asarray(small_gicp.voxelgrid_sampling(xyz - corner, voxel, 1).points())[:, :3]
    if len(xyz) < DENSE_CUBES * len(thin):
        names, thin = number[:, None], xyz - corner
    else:
        names = (np.floor(thin / voxel) + first).astype(np.int64)
    if len(thin) > most:
        thin = thin[np.sort(np.argpartition(_hash(names), most)[:most])]
    return thin + corner


def _hash(names: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Scatter (n, k) whole numbers over 64 bits: (n,)."""
    key = np.zeros(len(names), np.uint64)
    for column in names.T.astype(np.uint64):
        key = (key ^ column) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return key


def reaches_for(cell: float) -> tuple[float, ...]:
    """Choose the rounds' reaches for clouds rasterised at ``cell`` metres: 3 m, halved to the spacing."""
    reaches = [FIRST_REACH_M]
    while reaches[-1] / 2 >= 0.75 * cell:
        reaches.append(reaches[-1] / 2)
        if len(reaches) == 3:
            break
    if len(reaches) == 1:
        reaches.append(FIRST_REACH_M / 2)
    return tuple(reaches)


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
        overlap = overlap_of(geometry.apply(T_start, source), target)
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
        R = geometry.axis_angle_matrix(np.array([x[2], -x[1], 0.0]) / slope, float(np.arctan(slope)))
    T = geometry.translation((0.0, 0.0, float(x[0]))) @ geometry.about(pivot, R) @ T_start
    report = {
        "ground_cells": len(step),
        "ground_cells_agreeing": int(close.sum()),
        "rise_m": float(x[0]),
        "ground_spread_m": spread,
        "tilt_deg": float(np.degrees(geometry.rotation_angle(R))),
    }
    return Refinement(T, report)


def beyond_scatter(settled: Refinement) -> bool:
    """Tell whether the ground's rise is more than where the borders of its cells run can make of it.

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
        R = geometry.yaw_matrix(geometry.yaw_of(T[:3, :3] @ R_upright.T)) @ R_upright
    return geometry.compose(R, T[:3, :3] @ pivot + T[:3, 3] - R @ pivot)
