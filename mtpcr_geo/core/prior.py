"""What is known beforehand of where the source lies, in work coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mtpcr_geo.core.arrays import ComparesArrays, Floats

PriorSource = Literal["georef", "file", "matrix", "near", "yaw"]


@dataclass(frozen=True, eq=False)
class KnownPlace(ComparesArrays):
    """What is known beforehand of the source's pose, and how well.

    Attributes:
        given_by: what it was told by: the georeference, a file, a matrix, a place, or a yaw alone.
        middle: (3,) middle of the source, the mean of its sample, source work coordinates.
        place: (3,) where it lies, target work coordinates, metres; its height counts for nothing. None if
            that is not known.
        within_m: how far from there it may lie in plan, metres; None if no place is known.
        yaw: yaw of the transform between work coordinates, radians, counter-clockwise; None if not known.
        yaw_within: how far the yaw may be from that, radians; None if no yaw is known.
        T: the whole 4x4 between work coordinates, where that is known.

    """

    given_by: PriorSource
    middle: Floats
    place: Floats | None = None
    within_m: float | None = None
    yaw: float | None = None
    yaw_within: float | None = None
    T: Floats | None = None
