"""What refinement and verdict look at: the points about the overlap, and the target upright.

Whatever looks at the ground, or at what stands on it, needs z up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair, Side


def seen_upright(pair: Pair) -> Pair:
    """Return a pair in which the target's levelled coordinates stand for its work coordinates.

    The transform and the refinement are taken along. The target's link and the work frame are not, so that
    nothing of it may be written.

    Args:
        pair: levelled.

    Returns:
        The pair itself where the target is upright as it is.

    """
    T_level = pair.target.T_level_work
    if np.array_equal(T_level, np.eye(4)):
        return pair
    target = pair.target
    upright = replace(
        target,
        sample=target.levelled_sample,
        levelling=replace(target.levelling, T_level_work=np.eye(4)),
        near=None if target.near is None else transforms.apply(T_level, target.near),
    )
    return pair.with_(
        target=upright,
        T_target_source=None if pair.T_target_source is None else T_level @ pair.T_target_source,
        refinement=None if pair.refinement is None else pair.refinement.in_frame(T_level),
    )


def points_near(side: Side) -> Floats:
    """Return a side's points about the other cloud, (n, 3) work coordinates: its sample, or denser ones."""
    return side.sample if side.near is None else side.near
