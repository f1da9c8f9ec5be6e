"""What was known beforehand against what was found: whether they go together, and which to keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.types import Pair
from mtpcr_geo.method.icp import Surfaces
from mtpcr_geo.method.refine import SAME_FIT
from mtpcr_geo.method.scales import tolerance_for
from mtpcr_geo.method.upright import points_near
from mtpcr_geo.verdict.evidence import agreement

_NAMES = {"georef": "the clouds' CRSs put", "file": "the prior given puts", "matrix": "the prior given puts"}


@dataclass(frozen=True)
class PriorComparison:
    """How much agrees with what was found, and with the pose known beforehand.

    Attributes:
        found: tie points, and cells of ground, that agree with the transform found.
        prior: the same of the one known beforehand.
        found_residual: how badly surfaces meet under the transform found, 0 to 1; None if there are too few.
        prior_residual: the same of the one known beforehand.

    """

    found: tuple[int, int]
    prior: tuple[int, int]
    found_residual: float | None = None
    prior_residual: float | None = None

    @property
    def keep_prior(self) -> bool:
        """Whether at least as much agrees with the prior in every way.

        Tie points and ground agree within a cell or half a metre, which a prior that is off by 0.4 m does
        too; surfaces tell centimetres.
        """
        if self.prior[0] < self.found[0] or self.prior[1] < self.found[1]:
            return False
        if self.found_residual is None or self.prior_residual is None:
            return True
        return self.prior_residual <= SAME_FIT * self.found_residual


def prior_or_found(pair: Pair, tolerance: float | None = None) -> PriorComparison:
    """Compare what was found with the pose known beforehand, by how much agrees with each.

    Args:
        pair: solved, with a prior, rasters and tie points.
        tolerance: plan distance within which a tie point agrees, metres; one cell if None.

    Raises:
        ValueError: if the pair has no prior or no transform.

    """
    if pair.T_prior is None or pair.T_target_source is None:
        raise ValueError("a comparison needs a prior and a transform")
    poses = (pair.T_target_source, pair.T_prior)
    found, prior = (agreement(pair, T, tolerance) for T in poses)
    try:
        surfaces = Surfaces(points_near(pair.source), points_near(pair.target), pair.T_target_source)
    except RegistrationError:
        return PriorComparison(found, prior)
    return PriorComparison(found, prior, *(surfaces.surface_residual(T) for T in poses))


def departure(pair: Pair) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return how far a result is from what was known beforehand, and where it contradicts that.

    Args:
        pair: with a transform.

    Returns:
        Metrics, and a sentence for each contradiction: a result beyond what was said to be possible by more
        than the rasters resolve.

    """
    known, T = pair.known, pair.T_target_source
    if known is None or T is None:
        return {}, ()
    metrics: dict[str, Any] = {}
    contradictions = []
    slack = tolerance_for(pair.cell)
    R_level = pair.target.T_level_work[:3, :3]
    if known.place is not None and known.within_m is not None:
        gap = R_level @ (transforms.apply(T, known.middle[None])[0] - known.place)
        distance = metrics["prior_distance_m"] = float(np.hypot(gap[0], gap[1]))
        if distance > known.within_m + slack:
            where = _NAMES.get(known.given_by, "the place given puts")
            contradictions.append(
                f"the middle of the source comes to lie {distance:.1f} m from where {where} it, more than "
                f"the {known.within_m:.3g} m said to be possible"
            )
    if known.yaw is not None and known.yaw_within is not None:
        turn = transforms.yaw_of(T[:3, :3]) - known.yaw
        if known.T is not None:
            turned, prior = pair.levelled(T), pair.levelled(known.T)
            turn = transforms.yaw_of(turned[:3, :3]) - transforms.yaw_of(prior[:3, :3])
        angle = abs(float(np.arctan2(np.sin(turn), np.cos(turn))))
        metrics["prior_yaw_difference_deg"] = float(np.degrees(angle))
        arm = float(np.sqrt(((pair.source.sample - known.middle)[:, :2] ** 2).sum(axis=1).mean()))
        if angle > known.yaw_within + slack / max(arm, slack):
            contradictions.append(
                f"the source is turned {np.degrees(angle):.1f} degrees from the yaw known, more than the "
                f"{np.degrees(known.yaw_within):.3g} said to be possible"
            )
    return metrics, tuple(contradictions)
