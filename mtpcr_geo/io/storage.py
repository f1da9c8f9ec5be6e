"""How coordinates are stored in the 32 bit integers of a LAS file: scale and offset that suit all points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import ComparesArrays, Floats
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import OutputError

Move = Callable[[Floats], Floats]
MOST_STEPS = 2**31 - 1
FEW_SHARE = 0.1
"""Share of the points that may be left out, where they lie too far from the others to be stored with them."""
_LOOKED_AT = 4_096  # points of each chunk by which the middle is found


class MisfitError(Exception):
    """A point does not fit the integers at the scale and offset taken at first."""


@dataclass(eq=False)
class Storage(ComparesArrays):
    """Scale and offset of a file to be written.

    Attributes:
        scales: (3,) size of the last digit.
        offsets: (3,) what is subtracted before; None for whole units in the middle of the first points.
        left_out: points that were left out since they do not fit, counted as they are written.

    """

    scales: Floats
    offsets: Floats | None
    left_out: int = 0


def settled(cloud: Cloud, move: Move | None, scales: Floats, coarsest: Floats | None) -> Storage:
    """Return a storage that suits all points, or all but a few, by a pass over them.

    Args:
        cloud: what is to be written.
        move: takes (n, 3) file coordinates to those to be written; None leaves them.
        scales: (3,) size of the last digit, as wanted.
        coarsest: (3,) what it may grow to; None if it must not.

    Raises:
        OutputError: if many points do not fit.
        InputError: if the cloud cannot be read.

    """
    # coordinates of a broken file may be of any size
    with np.errstate(over="ignore", invalid="ignore"):
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        looked = []
        for xyz in cloud.xyz_chunks():
            moved = xyz if move is None else move(xyz)
            low, high = np.minimum(low, moved.min(axis=0)), np.maximum(high, moved.max(axis=0))
            looked.append(moved[:: max(1, len(moved) // _LOOKED_AT)])
        some = np.concatenate(looked)
        middle, half = np.rint((low + high) / 2), (high - low) / 2 + 1.0
        grown = scales.copy()
        while coarsest is not None and ((half / grown > MOST_STEPS) & (grown < coarsest)).any():
            # each axis by itself: a wide plan shall not cost the heights their digits
            coarser = np.minimum(grown * 10, np.maximum(coarsest, scales))
            grown = np.where(half / grown > MOST_STEPS, coarser, grown)
        if (half / grown <= MOST_STEPS).all():
            return Storage(grown, middle)
        # beams without a return lie at one place, however many they are
        places = np.unique(some, axis=0)
        # the finer scale again: a few points far away shall not cost the others their digits
        for wanted in (scales, grown):
            offsets = np.rint(np.median(places, axis=0))
            misfit = (np.abs(places - offsets) / wanted > MOST_STEPS).any(axis=1)
            if misfit.mean() <= FEW_SHARE:
                return Storage(wanted, offsets)
        distance = float(np.abs(places - offsets).max())
    raise OutputError(
        f"{misfit.mean():.0%} of the points, up to {distance:.6g} from the others, do not fit a LAS file at "
        f"scale {grown.min():g}; give a coarser one (--scale; scale_x ... of writers.las in a pipeline), or "
        "take them apart"
    )
