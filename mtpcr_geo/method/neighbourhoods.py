"""The shape of a point's surroundings: how far they spread along their principal axes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats

_PLACES_AT_ONCE = 4096


def local_shapes(
    tree: Any, points: Floats, places: Floats, neighbours: int, threads: int
) -> tuple[Floats, Floats]:
    """Find the principal axes of the points around each place.

    Args:
        tree: small_gicp's KdTree of the points.
        points: (n, 3) metres.
        places: (m, 3) metres.
        neighbours: points around a place that are looked at.
        threads: for the search.

    Returns:
        (m, 3) spreads in rising order (square roots of the scatter's eigenvalues), and (m, 3, 3) axes in
        columns: of a flat place the first is its normal, of a thin one the last its direction.

    """
    index = np.asarray(tree.batch_knn_search(places, neighbours, threads)[0]).astype(np.int64)
    parts = [index[start : start + _PLACES_AT_ONCE] for start in range(0, len(index), _PLACES_AT_ONCE)]
    if len(parts) < 2 or threads < 2:
        shapes = [_shapes(points, part) for part in parts or [index]]
    else:
        with ThreadPoolExecutor(threads) as pool:
            shapes = list(pool.map(lambda part: _shapes(points, part), parts))
    spreads, axes = (np.concatenate(each) for each in zip(*shapes, strict=True))
    return spreads, axes


def _shapes(points: Floats, index: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Find spreads and axes of groups of points, (m, k) indices."""
    neighbourhood = points[index]
    neighbourhood -= neighbourhood.mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", neighbourhood, neighbourhood))
    return np.sqrt(np.maximum(values, 0.0)), axes


def spacings(xy: Floats) -> Floats:
    """Return the distance of each of (n, 2) points to its nearest neighbour, (n,), n at least 2."""
    import small_gicp

    flat = np.column_stack([xy, np.zeros(len(xy))])
    tree = small_gicp.KdTree(flat, 1)
    return np.asarray(np.sqrt(np.asarray(tree.batch_knn_search(flat, 2, 1)[1])[:, 1]))
