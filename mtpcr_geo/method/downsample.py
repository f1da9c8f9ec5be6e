"""Thinning of points by voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask

MAX_VOXELS = 30_000_000
DENSE_VOXELS = 2.5
"""Mean points a voxel above which voxels give their mean point, and below which all points are taken."""

REGION_VOXELS = 8.0
"""Edge of the blocks of a cloud that are thinned as a whole, in voxels."""
SHARES = 8
"""Steps of the share of the points kept, from one share to its double."""

_BLOCK = 131_072

LATTICE_M = 0.00037
"""Shift of the voxels off the axes, on which points of an exact grid lie."""
LOTS_A_VOXEL = 10
"""Cells along a voxel in which points that are taken as they are draw one lot: were they finer, a hair's
shift of the axes would draw others; were they coarser, neighbours would come and go together."""


def near(points: Floats, others: Floats, distance: float) -> Mask:
    """Return which points may have one of the others within a distance.

    Args:
        points: (n, 3) metres; n > 0.
        others: (m, 3) metres; m > 0.
        distance: metres; voxels of at least this edge are compared, so a little farther ones pass too.

    Returns:
        (n,) False where there is certainly none.

    """
    (low_p, high_p), (low_o, high_o) = transforms.bounds(points), transforms.bounds(others)
    low, high = np.maximum(low_p, low_o) - distance, np.minimum(high_p, high_o) + distance
    found = np.zeros(len(points), bool)
    if (low > high).any():
        return found
    edge = _edge_of(low, high, distance)
    # voxels stand where they stand whatever the bounds are
    first = np.floor(low / edge).astype(np.int64) - 1
    shape = np.floor(high / edge).astype(np.int64) - first + 2
    filled = np.zeros(tuple(shape.tolist()), dtype=np.bool_)
    for start in range(0, len(others), _BLOCK):
        some = others[start : start + _BLOCK]
        filled[_voxels(some[between(some, low, high)], first, edge)] = True
    for axis in range(3):
        # voxels beside a filled one along each axis in turn: all 26 neighbours in the end
        ahead, behind = np.roll(filled, 1, axis), np.roll(filled, -1, axis)
        filled = filled | ahead | behind
    for start in range(0, len(points), _BLOCK):
        some = points[start : start + _BLOCK]
        inside = np.flatnonzero(between(some, low, high))
        found[start + inside] = filled[_voxels(some[inside], first, edge)]
    return found


def _edge_of(low: Floats, high: Floats, least: float) -> float:
    """Return the edge of voxels between two corners, of which there are at most `MAX_VOXELS`."""
    edge = least
    while np.prod(np.floor((high - low) / edge) + 5.0) > MAX_VOXELS:
        edge *= 1.2
    return edge


def between(xyz: Floats, low: Floats, high: Floats) -> Mask:
    """Return which of (n, 3) points lie between two corners, (3,) each, all in the same coordinates: (n,)."""
    inside = np.ones(len(xyz), bool)
    for axis in range(3):
        inside &= (xyz[:, axis] >= low[axis]) & (xyz[:, axis] <= high[axis])
    return inside


def _voxels(xyz: Floats, first: NDArray[np.int64], edge: float) -> tuple[NDArray[np.int64], ...]:
    return tuple((np.floor(xyz / edge).astype(np.int64) - first).T)


def own_axes(xyz: Floats) -> Floats:
    """Return the frame of a cloud's own principal axes, which goes along wherever the cloud is moved.

    The origin is the centroid. Axes run along greatest, middle and least spread, the first two to the side
    on which the points reach farther (third moments). Of points that spread alike in two directions, such as
    those of a square or round plot, the axes hang on single points.

    Args:
        xyz: (n, 3) points, metres; n > 0.

    Returns:
        4x4 from the points' coordinates to those along their axes.

    """
    middle = transforms.centroid(xyz)
    scatter, reach = np.zeros((3, 3)), np.zeros(3)
    for start in range(0, len(xyz), _BLOCK):
        part = xyz[start : start + _BLOCK] - middle
        scatter += part.T @ part
    axes = np.linalg.eigh(scatter)[1][:, ::-1].T
    for start in range(0, len(xyz), _BLOCK):
        placed = axes @ (xyz[start : start + _BLOCK] - middle).T
        reach += np.einsum("ij,ij,ij->i", placed, placed, placed)
    axes[reach < 0.0] *= -1.0
    axes[2] = np.cross(axes[0], axes[1])
    return transforms.compose(axes, -axes @ middle)


@dataclass(frozen=True)
class Thinned:
    """A thinned cloud.

    Attributes:
        points: (m, 3) metres.
        lots: (m,) from 0 to 1, by chance: points whose lots lie below a share are about that share of them.
            A point's lot follows from where it lies along the cloud's own axes: it keeps it in another order
            of the points, and where others come or go, as long as the lattice stays.

    """

    points: Floats
    lots: Floats

    def reduced(self, points: int, of: int) -> Thinned:
        """Keep a share of the points, such that of a number of them about as many as wanted stay, or less.

        Shares are powers of the eighth root of a half, so that a few points more or less mostly change no
        choice.

        Args:
            points: wanted, to within the square root of that.
            of: number of points that they are to be the rest of.

        """
        if of <= points:
            return self
        share = 2.0 ** (np.floor(SHARES * np.log2(points / of)) / SHARES)
        kept = self.lots < share
        return Thinned(self.points[kept], self.lots[kept] / share)


def thinned(xyz: Floats, around: Mask, voxel: float, T_axes: Floats | None = None) -> Thinned:
    """Thin the part of a cloud around some of its points, along the cloud's own axes, see `own_axes`.

    It does not matter how the cloud is turned, and little which points at the edge are among them. Dense
    clouds give one mean point a voxel. Where voxels would hold hardly more than a point each, the points are
    taken as they are, since another lattice of voxels would cut them otherwise. Nor does it matter in which
    order the points come.

    Args:
        xyz: (n, 3) points, metres.
        around: (n,) marks points, one at least; blocks of `REGION_VOXELS` that hold one, and those beside
            them, are thinned.
        voxel: edge of a voxel, metres.
        T_axes: 4x4, the cloud's own axes where they are known already.

    """
    import small_gicp

    T_axes = own_axes(xyz) if T_axes is None else T_axes
    block = REGION_VOXELS * voxel
    low, high = transforms.bounds(xyz[around])
    far = 2.0 * np.sqrt(3.0) * block
    number = np.flatnonzero(between(xyz, low - far, high + far))
    placed = transforms.apply(T_axes, xyz[number])
    beside = near(placed, placed[around[number]], block)
    number, placed = number[beside], placed[beside]
    first = np.floor(transforms.bounds(placed)[0] / voxel) - 1
    corner = first * voxel + LATTICE_M
    placed -= corner
    thin = np.asarray(small_gicp.voxelgrid_sampling(placed, voxel, 1).points())[:, :3]
    if len(placed) < DENSE_VOXELS * len(thin):
        points = xyz[number]
        names = np.floor(placed * (LOTS_A_VOXEL / voxel)) + first * LOTS_A_VOXEL
    else:
        points = transforms.apply(transforms.inverse(T_axes), thin + corner)
        names = np.floor(thin / voxel) + first
    return Thinned(points, _hash(names.astype(np.int64)).astype(np.float64) * 2.0**-64)


def _hash(names: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Scatter (n, k) whole numbers over 64 bits: (n,)."""
    key = np.zeros(len(names), np.uint64)
    for column in names.T.astype(np.uint64):
        key = (key ^ column) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    # names that run on, times a constant, are spread evenly and not by chance: mixed twice more
    for constant, shift in ((0xBF58476D1CE4E5B9, 27), (0x94D049BB133111EB, 31)):
        key *= np.uint64(constant)
        key ^= key >> np.uint64(shift)
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
