"""Rigid transforms as 4x4 float64 matrices, acting on row-wise (n, 3) arrays of metres.

A variable ``T_to_from`` takes coordinates of frame ``from`` to frame ``to``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Points = NDArray[np.float64]


def apply(T_to_from: Matrix, xyz: Points) -> Points:
    """Move points: (n, 3) coordinates in ``from`` become (n, 3) coordinates in ``to``."""
    return by_blocks(lambda some: _apply(T_to_from, some), np.asarray(xyz, np.float64))


_BLOCK = 32_768  # rows whose columns fit into a processor's cache


def by_blocks(move: Callable[[Points], Points], xyz: Points) -> Points:
    """Move points some thousand at a time, which for long arrays takes half the time.

    Args:
        move: takes (k, 3) points to (k, 3), each by itself.
        xyz: (n, 3) points; any other shape is moved at once.

    """
    if xyz.ndim != 2 or len(xyz) <= _BLOCK:
        return move(xyz)
    moved = np.empty(xyz.shape)
    for start in range(0, len(xyz), _BLOCK):
        moved[start : start + _BLOCK] = move(xyz[start : start + _BLOCK])
    return moved


def _apply(T_to_from: Matrix, xyz: Points) -> Points:
    moved = np.empty(xyz.shape)
    # written out: BLAS is ten times slower on long arrays of three columns, and sums as it likes
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    for i, (a, b, c, t) in enumerate(T_to_from[:3]):
        moved[..., i] = a * x + b * y + c * z + t
    return moved


def compose(R: Matrix, t: Points) -> Matrix:
    """Build a 4x4 transform from a (3, 3) rotation and a (3,) translation."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def translation(t: Points | tuple[float, float, float]) -> Matrix:
    """Build the 4x4 transform that adds ``t`` (3,)."""
    return compose(np.eye(3), np.asarray(t, np.float64))


def inverse(T: Matrix) -> Matrix:
    """Invert a rigid transform exactly: the rotation is transposed, nothing is solved for."""
    R = T[:3, :3]
    return compose(R.T, -R.T @ T[:3, 3])


def yaw_matrix(yaw: float) -> Matrix:
    """Rotate about the vertical by ``yaw`` radians, counter-clockwise seen from above: (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def tilt_matrix(axis_azimuth: float, tilt: float) -> Matrix:
    """Rotate by ``tilt`` radians about a horizontal axis at ``axis_azimuth`` radians from x: (3, 3)."""
    return axis_angle_matrix(np.array([np.cos(axis_azimuth), np.sin(axis_azimuth), 0.0]), tilt)


def axis_angle_matrix(axis: Points, angle: float) -> Matrix:
    """Rotate by ``angle`` radians about a unit ``axis`` (3,), by Rodrigues' formula: (3, 3)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K))


def about(pivot: Points, R: Matrix) -> Matrix:
    """Rotate by ``R`` (3, 3) about ``pivot`` (3,): the pivot stays where it is."""
    return compose(R, pivot - R @ pivot)


def rotation_angle(R: Matrix) -> float:
    """Angle of a (3, 3) rotation in radians, accurate for tiny angles too.

    Equals ``arccos((trace - 1) / 2)``, which loses half its digits near zero; the skew part does not.
    """
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(np.linalg.norm(skew), np.trace(R) - 1.0))


def rotation_to_up(up: Points) -> Matrix:
    """Smallest rotation (3, 3) that takes the unit vector ``up`` (3,) to +z; half a turn about x from -z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-15:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return axis_angle_matrix(axis / sine, float(np.arctan2(sine, up[2])))


def angle_deg(a: Points, b: Points) -> float:
    """Angle between two vectors (3,), degrees, accurate for tiny angles too."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def yaw_of(R: Matrix) -> float:
    """Yaw of a (3, 3) rotation in radians: the turn about the vertical of its x axis."""
    return float(np.arctan2(R[1, 0], R[0, 0]))


def tilt_of(R: Matrix) -> float:
    """Tilt of a (3, 3) rotation in radians: the angle by which it turns the vertical."""
    return float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))


def orthonormal(R: Matrix) -> Matrix:
    """Nearest proper rotation to a (3, 3) matrix, in the Frobenius sense."""
    U, _, Vt = np.linalg.svd(R)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return np.asarray(U @ D @ Vt)


def bounds(xyz: Points) -> tuple[Points, Points]:
    """Return the least and greatest coordinates of (n, k) points, each (k,).

    Column by column, which for long thin arrays is many times faster than along the first axis.
    """
    columns = range(xyz.shape[1])
    return np.array([xyz[:, i].min() for i in columns]), np.array([xyz[:, i].max() for i in columns])


def centroid(xyz: Points) -> Points:
    """Return the mean of (n, k) points, (k,); column by column, like `bounds`."""
    return np.array([xyz[:, i].mean() for i in range(xyz.shape[1])])
