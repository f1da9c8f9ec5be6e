"""The uncertainty of a pose as ``run.json`` and ``transform.json`` hold it."""

from __future__ import annotations

from typing import Any

from mtpcr_geo.core.types import Pair, Verdict
from mtpcr_geo.verdict.probability import shipped

ORDER = "rotations about x, y and up through the pivot (radians), then shifts along them (metres)"


def uncertainty_facts(pair: Pair) -> dict[str, Any] | None:
    """Return covariance, pivot and farthest point of a judged pair; None where they are not known.

    The pivot is given in work coordinates and in those of the result.
    """
    verdict = pair.verdict
    if verdict is None or verdict.uncertainty is None:
        return None
    stated = verdict.uncertainty
    link = pair.frame.output or pair.target.link
    return {
        "covariance": stated.covariance,
        "order": ORDER,
        "axes": stated.R_level,
        "pivot_work": stated.pivot,
        "pivot": link.to_file(stated.pivot[None])[0],
        "farthest": link.to_file(stated.far[None])[0],
        "from": f"block jackknife of the final fit to {stated.fitted}",
        "blocks": stated.blocks,
        "correspondences": stated.correspondences,
    }


def check_facts(verdict: Verdict | None) -> list[dict[str, str]]:
    """Return the checks of a verdict as rows."""
    return [
        {
            "check": one.name,
            "value": one.value,
            "wanted": one.wanted,
            "status": one.status,
            "meaning": one.meaning,
        }
        for one in (verdict.checks if verdict is not None else ())
    ]


def calibrated(verdict: Verdict) -> str | None:
    """Return the date of the model that gave the probability; None where there is no probability."""
    return None if verdict.metrics.get("probability") is None else str(shipped().about.get("date"))
