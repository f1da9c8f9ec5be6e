"""The poses that a doubtful verdict names, as transforms that can be drawn."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair, Rival


def rival_pose(pair: Pair, rival: Rival) -> Floats:
    """Return the 4x4 of a rival, from source to target work coordinates.

    Args:
        pair: with tie points and the transform that the rival is told against.
        rival: by where it puts the middle of the tie points, and its turn.

    """
    assert pair.T_target_source is not None
    assert pair.tie_points is not None
    T = pair.levelled(pair.T_target_source)
    middle = transforms.apply(T, pair.tie_points.source.mean(axis=0, keepdims=True))[0]
    turn = transforms.about(middle, transforms.yaw_matrix(np.radians(rival.turn_deg)))
    moved = transforms.translation((rival.east_m, rival.north_m, 0.0)) @ turn @ T
    return np.asarray(transforms.inverse(pair.target.T_level_work) @ moved @ pair.source.T_level_work)
