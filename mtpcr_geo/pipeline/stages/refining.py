"""Refining the transform of a pair, its height held against the heights that all points of both clouds fill.

Tie points and the ground tell the height by the lowest points of cells. Where these lie below the ground, as
multipath does, all of them agree on a height at which nothing else of the clouds meets.
"""

from __future__ import annotations

from dataclasses import replace

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.types import Pair, Refinement
from mtpcr_geo.method.common_heights import common_heights_of
from mtpcr_geo.method.refine import RefineSettings, refine
from mtpcr_geo.method.settle import FEWEST_GROUND_CELLS
from mtpcr_geo.method.upright import points_near, seen_upright
from mtpcr_geo.verdict.evidence import agreement, middle_of_tie_points, tie_points_agreeing

CLEARLY = 1.5
"""Times as many common heights from which on another height is the right one: beside the right one, no other
has more than 0.7 on nine real pairs and thirty simulated ones, but up to 2.1 under a closed canopy."""
GROUND_KEPT = 0.1
"""Share of the cells of common ground agreeing before that must agree at another height."""


def refined_pair(pair: Pair, settings: RefineSettings) -> Refinement:
    """Refine the transform of a pair.

    Where the height is settled on the ground, and the lowest points turn out to be none, it is refined again
    from the height at which far more of both clouds meets.

    Args:
        pair: with a transform; tie points tell the middle of the overlap, and what agrees.
        settings: of the refinement.

    Raises:
        RegistrationError: if too little of the clouds is brought together.

    """
    found = _refined(pair, settings)
    if not settings.ground:
        return found
    raised = _raised(pair, found, settings)
    return found if raised is None else raised


def _refined(pair: Pair, settings: RefineSettings) -> Refinement:
    seen = seen_upright(pair)
    assert seen.T_target_source is not None
    found = refine(
        points_near(seen.source),
        points_near(seen.target),
        seen.T_target_source,
        settings,
        cell=pair.cell,
        agreeing=lambda T: tie_points_agreeing(seen, T),
        pivot=middle_of_tie_points(pair),
        R_upright=seen.target.T_level_work[:3, :3].T @ seen.source.T_level_work[:3, :3],
    )
    return found if seen is pair else found.in_frame(transforms.inverse(pair.target.T_level_work))


def _raised(pair: Pair, first: Refinement, settings: RefineSettings) -> Refinement | None:
    """Refine again from where far more of both clouds meets than at the height that a refinement ended at.

    Nothing is settled on the ground then, which had led elsewhere.

    Returns:
        None where the lowest points are ground, where no other height is clearly better, before and after
        that refinement, or where hardly any of the common ground would be left.

    """
    before = common_heights_of(pair, first.T)
    if before is None or not before.asked or before.elsewhere[0] < CLEARLY:
        return None
    up = transforms.translation(before.elsewhere[1] * pair.target.T_level_work[2, :3])
    try:
        found = _refined(pair.with_(T_target_source=up @ first.T), replace(settings, ground=False))
    except RegistrationError:
        return None
    after = common_heights_of(pair, found.T)
    if after is None or after.here < CLEARLY * before.here:
        return None
    # crowns from the air over undergrowth from the ground fill the same heights some metres off, but there
    # the lowest points of both meet nowhere
    ground = agreement(pair, first.T)[1]
    if ground >= FEWEST_GROUND_CELLS and agreement(pair, found.T)[1] < GROUND_KEPT * ground:
        return None
    return replace(found, T_before=first.T_before, raised=True)
