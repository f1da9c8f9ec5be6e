"""The one sentence that terminal, report, recording and ``run.json`` begin with."""

from __future__ import annotations

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
        reasons: of the verdict; the first is given where no probability is.
        mapped: whether the target's frame has east and north.

    """
    right = (
        f"the pose is right, within 5 degrees and 2 m, with {chance_text(probability)}"
        if probability is not None
        else reasons[0]
    )
    return f"{name.capitalize()}: {right}; {_accuracy(name, uncertainty, mapped)}."


def _accuracy(name: VerdictName, uncertainty: Uncertainty | None, mapped: bool) -> str:
    if name == "refused":
        return "a refused pose has no accuracy"
    if uncertainty is None:
        return "its accuracy is not known"
    known = uncertainty.metrics
    middle = f"{known['within_95_plan_m']:.2f} m in plan and {known['within_95_height_m']:.2f} m in height"
    far = f"{known['within_95_plan_far_m']:.2f} m and {known['within_95_height_far_m']:.2f} m"
    condition = "" if name == "accepted" else "if it is right, "
    weakest = direction_text(known["weakest_direction_deg"], mapped)
    return (
        f"{condition}95 % of the errors are below {middle} in the middle of the overlap, and below {far} at "
        f"the farthest point of the source (least sure along {weakest}; from a block jackknife of the final "
        f"fit to {uncertainty.fitted}, {uncertainty.blocks} blocks)"
    )
