"""Thinning the points of an overlap in ways that hang on the points, and not on the frame they stand in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms

Floats = NDArray[np.float64]

MOST_CUBES = 30_000_000
DENSE_CUBES = 2.5
"""Points a cube of the thinning above which cubes give their mean point, and below which all are taken."""

LATTICE_M = 0.00037
"""Shift of the thinning's cubes off whole millimetres, where points of a LAS scale lie in numbers."""


def near(points: Floats, others: Floats, reach: float) -> NDArray[np.bool_]:
    """Return which points may have one of the others within reach, by cubes of that edge."""
    (low_p, high_p), (low_o, high_o) = transforms.bounds(points), transforms.bounds(others)
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


def thinned(xyz: Floats, number: NDArray[np.int64], voxel: float, most: int) -> Floats:
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

    first = np.floor(transforms.bounds(xyz)[0] / voxel) - 1
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
