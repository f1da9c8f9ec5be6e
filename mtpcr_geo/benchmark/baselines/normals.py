"""Normals with one side, for programs that want them; small_gicp's have none.

Roofs and ground point up. Of a steep surface the sign of z says nothing: a facade points downhill, from the
higher of the surfaces around it to the lower, which is from the house to the street, whether it was seen
from the air (roof behind, ground in front) or from the ground (nothing behind, ground in front).
"""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core.arrays import Floats

NEIGHBOURS = 20
STEEP = 0.3
"""Of the z of a unit normal: below it (72 degrees from level) a surface has no upper side."""
_CELL_M = 1.0
_BLUR_CELLS = 2.0


def oriented_normals(xyz: Floats) -> Floats:
    """Return a unit normal for each point, outward; up where the points around it tell nothing.

    Args:
        xyz: (n, 3) metres, z up, near the origin.

    Returns:
        (n, 3).

    """
    import small_gicp

    if len(xyz) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(xyz), 1))
    cloud = small_gicp.PointCloud(np.ascontiguousarray(xyz))
    small_gicp.estimate_normals(cloud, num_neighbors=min(NEIGHBOURS, len(xyz)), num_threads=1)
    normals = np.asarray(cloud.normals())[:, :3].copy()
    lengths = np.linalg.norm(normals, axis=1)
    lost = ~(lengths > 0.0)
    normals[lost], lengths[lost] = (0.0, 0.0, 1.0), 1.0
    normals /= lengths[:, None]
    out = np.sign(normals[:, 2])
    steep = np.abs(normals[:, 2]) < STEEP
    downhill = (normals[:, :2] * _downhill(xyz)).sum(axis=1)
    out = np.where(steep & (downhill != 0.0), np.sign(downhill), out)
    return normals * np.where(out == 0.0, 1.0, out)[:, None]


def _downhill(xyz: Floats) -> Floats:
    """Return for each point the direction in plan, (n, 2), in which the surfaces around it fall."""
    from scipy.ndimage import gaussian_filter

    low = xyz[:, :2].min(axis=0)
    cells = ((xyz[:, :2] - low) / _CELL_M).astype(np.int64)
    shape = tuple(cells.max(axis=0) + 1)
    top = np.full(shape, -np.inf)
    np.maximum.at(top, (cells[:, 0], cells[:, 1]), xyz[:, 2])
    seen = np.isfinite(top)
    height = np.where(seen, top - xyz[:, 2].min(), 0.0)
    x, y = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    # covariance of height and place among the cells around, empty ones left out

    def mean(values: Floats) -> Floats:
        return np.asarray(gaussian_filter(values * seen, _BLUR_CELLS, mode="constant", truncate=3.0))

    weight = np.maximum(mean(np.ones(shape)), 1e-12)
    h = mean(height) / weight
    rise = [mean(height * axis) / weight - h * mean(axis.astype(float)) / weight for axis in (x, y)]
    return -np.stack([one[cells[:, 0], cells[:, 1]] for one in rise], axis=1)
