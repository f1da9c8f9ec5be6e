"""How probable it is that a scene without a true pose scores as well: the tail of the mirrored search."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial.laguerre import laggauss

TAIL = 10
"""Strongest distinct hypotheses of the mirrored source that the tail is fitted to."""
FEWEST = 3
LEAST_SCALE = 1e-3
NODES = 80
"""Points of the Gauss-Laguerre quadrature: beyond them the result no longer changes by a millionth."""


def null_probability(strength: float | None, mirrored: Sequence[float] | None) -> float | None:
    """Return the probability that the best of a search without a true pose is as strong.

    The hypotheses of the mirrored source are distinct poses that are all wrong. Their strongest are the upper
    order statistics of what chance and likeness give on this pair, over all yaws and shifts; above the next
    one their logarithms fall off exponentially (Hill 1975, Annals of Statistics 3(5)). How fast, and how many
    of another search would lie there, is known from a few only, and both are integrated out: with k above
    the base, excesses that sum to E, and u of a gamma distribution of order k, the best of another search
    stays below an excess v with the probability of the mean of (1 + exp(-u v / E))^-(k + 1).

    Args:
        strength: of the best hypothesis.
        mirrored: strengths of the mirrored source's hypotheses, in any order.

    Returns:
        0 to 1; None where there are too few hypotheses.

    """
    if strength is None or mirrored is None:
        return None
    top = np.sort(np.array([value for value in mirrored if value > 0.0], np.float64))[::-1][: TAIL + 1]
    if strength <= 0.0:
        return 1.0
    if len(top) < FEWEST:
        return None
    logs = np.log(top)
    base, above = logs[-1], logs[:-1]
    k = len(above)
    total = max(float((above - base).sum()), LEAST_SCALE * k)
    u, weight = laggauss(NODES)
    weight = weight * u ** (k - 1)
    beyond = np.exp(np.minimum(-u * (np.log(strength) - base) / total, 50.0))
    return float(-np.expm1(-(k + 1) * np.log1p(beyond)) @ weight / weight.sum())
