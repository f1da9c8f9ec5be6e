"""Thinning of points by voxels, in ways that depend only on the points and not on the frame they stand in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask

MAX_VOXELS = 30_000_000
DENSE_VOXELS = 2.5
"""Mean points a voxel above which voxels give their mean point, and below which all points are taken."""

AXES_POINTS = 50_000
REGION_VOXELS = 8.0
"""Edge of the blocks of a cloud that are thinned as a whole, in voxels: points outside change none inside."""
SHARES = 8
"""Shares of the points kept, from one to its double."""

_BLOCK = 131_072

LATTICE_M = 0.00037
"""Shift of the voxels off whole millimetres, on which points of a LAS scale lie."""


def near(points: Floats, others: Floats, distance: float) -> Mask:
    """Return which points may have one of the others within a distance.

    Args:
        points: (n, 3) metres.
        others: (m, 3) metres.
        distance: metres; voxels of at least this edge are compared, so a little farther ones pass too.

    Returns:
        (n,) False where there is certainly none.

    """
    (low_p, high_p), (low_o, high_o) = transforms.bounds(points), transforms.bounds(others)
    span = np.maximum(high_p, high_o) - np.minimum(low_p, low_o)
    edge = max(distance, float(np.cbrt(np.prod(span + 4 * distance) / MAX_VOXELS)))
    low = np.minimum(low_p, low_o) - 2 * edge
    shape = np.floor(span / edge).astype(int) + 5
    filled = np.zeros(tuple(shape.tolist()), dtype=np.bool_)
    for start in range(0, len(others), _BLOCK):
        filled[_voxels(others[start : start + _BLOCK], low, edge)] = True
    for axis in range(3):
        # voxels beside a filled one along each axis in turn: all 26 neighbours in the end
        ahead, behind = np.roll(filled, 1, axis), np.roll(filled, -1, axis)
        filled = filled | ahead | behind
    found = np.empty(len(points), bool)
    for start in range(0, len(points), _BLOCK):
        part = slice(start, start + _BLOCK)
        found[part] = filled[_voxels(points[part], low, edge)]
    return found


def _voxels(xyz: Floats, low: Floats, edge: float) -> tuple[NDArray[np.int64], ...]:
    return tuple(np.floor((xyz - low) / edge).astype(np.int64).T)


def own_axes(xyz: Floats) -> Floats:
    """Return the frame of a cloud's own principal axes, which goes along wherever the cloud is moved.

    The origin is the centroid. Axes run along greatest, middle and least spread, the first two to the side
    on which the points reach farther (third moments). Of points that spread alike in all directions the axes
    are arbitrary. Of many points every so many are looked at.

    Args:
        xyz: (n, 3) points, metres; n > 0.

    Returns:
        4x4 from the points' coordinates to those along their axes.

    """
    some = xyz[:: -(-len(xyz) // AXES_POINTS)]
    middle = transforms.centroid(some)
    some = some - middle
    axes = np.linalg.eigh(some.T @ some)[1][:, ::-1].T
    axes[((some @ axes.T) ** 3).sum(axis=0) < 0.0] *= -1.0
    axes[2] = np.cross(axes[0], axes[1])
    return transforms.compose(axes, -axes @ middle)


@dataclass(frozen=True)
class Thinned:
    """A thinned cloud.

    Attributes:
        points: (m, 3) metres.
        lots: (m,) from 0 to 1: points whose lots lie below a share are that share of them, spread evenly, and
            stay the same where others come or go.

    """

    points: Floats
    lots: Floats

    def at_most(self, points: int, of: int) -> Thinned:
        """Keep a share of the points, such that of a number of them at most as many as wanted are left.

        Shares move by steps, so that a few points more or less change no choice.

        Args:
            points: wanted.
            of: number of which they are to be.

        """
        if of <= points:
            return self
        share = 2.0 ** (np.floor(SHARES * np.log2(points / of)) / SHARES)
        kept = self.lots < share
        return Thinned(self.points[kept], self.lots[kept] / share)


def thinned(xyz: Floats, around: Mask, voxel: float) -> Thinned:
    """Thin the part of a cloud around some of its points, along the cloud's own axes, see `own_axes`.

    So it does not matter how the cloud is turned, nor hardly which points these are exactly. Dense clouds
    give one mean point a voxel. Where voxels would hold hardly more than a point each, the points are taken
    as they are, since another lattice of voxels would cut them otherwise.

    Args:
        xyz: (n, 3) points, metres.
        around: (n,) marks points; what lies within `REGION_VOXELS` of them is thinned.
        voxel: edge of a voxel, metres.

    """
    import small_gicp

    T_axes = own_axes(xyz)
    placed = transforms.apply(T_axes, xyz)
    number = np.flatnonzero(near(placed, placed[around], REGION_VOXELS * voxel))
    placed = placed[number]
    first = np.floor(transforms.bounds(placed)[0] / voxel) - 1
    corner = first * voxel + LATTICE_M
    placed -= corner
    thin = np.asarray(small_gicp.voxelgrid_sampling(placed, voxel, 1).points())[:, :3]
    if len(placed) < DENSE_VOXELS * len(thin):
        names, thin = number[:, None], placed
    else:
        names = (np.floor(thin / voxel) + first).astype(np.int64)
    points = transforms.apply(transforms.inverse(T_axes), thin + corner)
    return Thinned(points, _hash(names).astype(np.float64) * 2.0**-64)


def _hash(names: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Scatter (n, k) whole numbers over 64 bits: (n,)."""
    key = np.zeros(len(names), np.uint64)
    for column in names.T.astype(np.uint64):
        key = (key ^ column) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    return key


def one_per_voxel(xyz: Floats, voxel: float, rng: np.random.Generator, max_points: int) -> Floats:
    """Keep the first point of each voxel, and a random choice of those where they are too many.

    Args:
        xyz: (n, 3) points, metres.
        voxel: edge of a voxel, metres.
        rng: makes the random choice.
        max_points: points at most.

    Returns:
        (m, 3) metres, in the order given.

    """
    if len(xyz) > 1_500_000:
        xyz = xyz[rng.choice(len(xyz), 1_500_000, replace=False)]
    low, high = transforms.bounds(xyz)
    at = np.floor((xyz - low) / voxel).astype(np.int64)
    span = np.floor((high - low) / voxel).astype(np.int64) + 1
    _, first = np.unique((at[:, 0] * span[1] + at[:, 1]) * span[2] + at[:, 2], return_index=True)
    if len(first) > max_points:
        first = rng.choice(first, max_points, replace=False)
    return xyz[np.sort(first)]
