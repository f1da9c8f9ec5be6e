"""The height of a refined transform, held against the heights that all points of both clouds fill.

Tie points and the ground tell the height by the lowest points of cells. Where these lie below the ground, as
multipath does, all of them agree on a height at which nothing else of the clouds meets.
"""

from __future__ import annotations

from dataclasses import replace

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.types import Pair, Refinement
from mtpcr_geo.method.common_heights import common_heights_of
from mtpcr_geo.method.refine import RefineSettings
from mtpcr_geo.pipeline.stages.feedback import refined_pair

CLEARLY = 1.5
"""Times as many common heights from which on another height is the right one: beside the right one, no other
has more than 0.7 on nine real pairs and thirty simulated ones."""


def raised(pair: Pair, refined: Refinement, settings: RefineSettings) -> Refinement | None:
    """Refine again from where far more of both clouds meets than at the height that a refinement ended at.

    Nothing is settled on the ground then, which had led elsewhere.

    Args:
        pair: solved.
        refined: what its refinement came to.
        settings: of that.

    Returns:
        None where the lowest points are ground, or no other height is clearly better, before and after that
        refinement.

    """
    before = common_heights_of(pair, refined.T)
    if before is None or not before.asked or before.elsewhere[0] < CLEARLY:
        return None
    up = transforms.translation(before.elsewhere[1] * pair.target.T_level_work[2, :3])
    try:
        found = refined_pair(pair.with_(T_target_source=up @ refined.T), replace(settings, ground=False))
    except RegistrationError:
        return None
    after = common_heights_of(pair, found.T)
    if after is None or after.here < CLEARLY * before.here:
        return None
    return found
