"""What the wrappers of learned methods share: clouds brought to the sizes that the weights know.

Such a network thins its input by a grid whose cell doubles from stage to stage, and compares all points of
the coarsest stage with each other, in memory that grows with the square of their number.
"""

from __future__ import annotations

import numpy as np


def thinned(xyz: np.ndarray, edge: float) -> np.ndarray:
    """Return the mean of the points in each cube of an edge, (n, 3)."""
    cells = np.floor((xyz - xyz.min(axis=0)) / edge).astype(np.int64)
    _, place, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    place = place.reshape(-1)
    sums = [np.bincount(place, xyz[:, axis], len(count)) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None]


def fitted_scale(clouds: list[np.ndarray], scale: float, coarsest: float, most: int) -> float:
    """Return the least divisor, from `scale` up by tenths, at which no cloud fills more than `most` cells.

    Args:
        clouds: (n, 3) each, metres.
        scale: what coordinates are divided by at least.
        coarsest: edge of the cells of the coarsest stage, in divided coordinates.
        most: cells, that is points of the coarsest stage, allowed for each cloud.

    """
    clouds = [thinned(xyz, coarsest * scale / 4) for xyz in clouds]
    while max(len(thinned(xyz, coarsest * scale)) for xyz in clouds) > most:
        scale *= 1.1
    return scale
