"""Thinning a cloud by a lattice of voxels."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices


def first_in_voxels(xyz: Floats, edge: float, corner: Floats | None = None) -> Indices:
    """Return the row numbers of the first point of each voxel, ascending.

    Args:
        xyz: (n, 3) points, metres.
        edge: edge of a voxel, metres; above 0.
        corner: (3,) a corner of the lattice; the least coordinates of the points if not given.

    """
    if not len(xyz):
        return np.empty(0, np.int64)
    low, high = transforms.bounds(xyz)
    corner = low if corner is None else corner
    first = np.floor((low - corner) / edge).astype(np.int64)
    columns, rows, _ = np.floor((high - corner) / edge).astype(np.int64) - first + 1
    # one axis at a time: no (n, 3) array beside the points
    x, y, z = (np.floor((xyz[:, k] - corner[k]) / edge).astype(np.int64) - first[k] for k in range(3))
    _, number = np.unique((z * rows + y) * columns + x, return_index=True)
    return np.sort(number)
