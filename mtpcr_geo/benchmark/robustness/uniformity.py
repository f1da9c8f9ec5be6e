"""Whether the null's probabilities mean what they say: of runs without an answer, p in 100 lie below p %."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.robustness.runner import Row
from mtpcr_geo.verdict.null import null_probability

LEVELS = (0.5, 0.2, 0.1, 0.05, 0.02)
MOST = 1.5
"""Times p that the share below p may be."""


def null_uniformity(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Return for each p the share of runs without an answer whose probability under the null is below it.

    Args:
        rows: of any suites; those with a right answer, and those without a mirrored search, are left out.

    Returns:
        Lines with ``p``, ``runs``, ``share_below``, and ``times_p``: what is wanted is `MOST` at most. The
        line of the old measure beside it: the share whose significance in digits is beyond -log10 p.

    """
    values, digits = [], []
    for row in rows:
        metrics = row["metrics"] or {}
        if row["has_truth"]:
            continue
        found = null_probability(
            metrics.get("strength"), (metrics.get("matcher") or {}).get("mirrored_strengths")
        )
        if found is not None:
            values.append(found)
            digits.append(metrics.get("neg_log10_p") or 0.0)
    if not values:
        return []
    probability, old = np.array(values), 10.0 ** -np.array(digits)
    return [
        {
            "p": p,
            "runs": len(values),
            "share_below": float((probability < p).mean()),
            "times_p": float((probability < p).mean() / p),
            "digits_share_below": float((old < p).mean()),
        }
        for p in LEVELS
    ]
