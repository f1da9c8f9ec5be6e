"""The one sentence that terminal, report, recording and ``run.json`` begin with."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mtpcr_geo.core.types import VerdictName
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.verdict.findings import chance_text
from mtpcr_geo.verdict.sliding import direction_text


def sentence_of(
    name: VerdictName,
    probability: float | None,
    uncertainty: Uncertainty | None,
    reasons: Sequence[str],
    *,
    mapped: bool = True,
) -> str:
    """Return verdict, probability, and accuracy in the overlap and at its farthest, and how that is known.

    Args:
        name: of the verdict.
        probability: of being right; None where it is not known.
        uncertainty: of the pose; None where it is not known.
        reasons: of the verdict; the first is given where it is not accepted, or no probability is known.
        mapped: whether the target's frame has east and north.

    """
    chance = "" if probability is None else chance_text(probability)
    if name == "accepted" and chance:
        judged = f"the pose is right, within 5 degrees and 2 m, with {chance}"
    else:
        # what it fails by; the advice that follows it stands with the reasons
        judged = reasons[0].partition("; ")[0]
        if chance and "probability" not in judged:
            judged += f", though without regard to that the evidence gives {chance} of being right"
    return f"{name.capitalize()}: {judged}; {_accuracy(name, uncertainty, mapped)}."


def centimetres(value_m: float) -> str:
    """Print a bound in metres to the centimetre above it: what is below it is below what is printed."""
    return f"{max(math.ceil(100.0 * value_m - 1e-9), 1) / 100.0:.2f}"


def _accuracy(name: VerdictName, uncertainty: Uncertainty | None, mapped: bool) -> str:
    if name == "refused":
        return "no accuracy is claimed for a refused pose"
    if uncertainty is None:
        return "its accuracy is not known"
    known = uncertainty.metrics
    plan, height, plan_far, height_far = (
        centimetres(known[f"within_95_{one}_m"]) for one in ("plan", "height", "plan_far", "height_far")
    )
    middle, far = f"{plan} m in plan and {height} m in height", f"{plan_far} m and {height_far} m"
    condition = "" if name == "accepted" else "if it is right, "
    weakest = direction_text(known["weakest_direction_deg"], mapped)
    return (
        f"{condition}95 % of the errors are below {middle} in the middle of the overlap, and below {far} at "
        f"the farthest point of the source (least sure along {weakest}; from a block jackknife of the final "
        f"fit to {uncertainty.fitted}, {uncertainty.blocks} blocks)"
    )
