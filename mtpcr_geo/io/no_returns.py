"""Points that are no points: beams without a return, which many sensors write as the place of the sensor.

They are known by exact repetition, since a surface that is measured never gives the same coordinates again
and again: one triple of coordinates that many points have, far more than any other triple. Where that lies,
at (0, 0, 0) or where an export has moved it, plays no part; several scans in one cloud have several such
places.
"""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core.arrays import Floats, Mask

LOOKED_AT = 16_384
"""Points of each chunk that are looked at, chosen at random."""
FEWEST = 20
"""Points on one place among these from which on it may be one of no returns: about a thousandth."""
TIMES_USUAL = 10.0
"""How many times more than on nearly all other places that must be: coarse scales put points together too."""


class NoReturns:
    """Finds the places of no returns in a stream of points.

    Attributes:
        places: (k, 3) coordinates of those found so far.

    """

    def __init__(self, seed: int = 0) -> None:
        self.places: Floats = np.empty((0, 3))
        self._rng = np.random.default_rng(seed)
        self._before: Floats = np.empty((0, 3))

    def look(self, xyz: Floats) -> bool:
        """Look for places in (n, 3) further points; return whether new ones were found."""
        few = without(self._few(xyz), self.places)
        new = _repeated(np.vstack([self._before, few]))
        if new:
            self.places = np.vstack([self.places, *new])
            few = without(few, self.places)
        if len(few) >= len(self._before) // 2:
            # what is usual is told by the points before too, where a chunk has nothing but no returns
            self._before = few
        return bool(new)

    def _few(self, xyz: Floats) -> Floats:
        if len(xyz) <= LOOKED_AT:
            return xyz
        return np.asarray(xyz[self._rng.integers(0, len(xyz), LOOKED_AT)])


def without(xyz: Floats, places: Floats) -> Floats:
    """Leave out the points (n, 3) that lie exactly on one of (k, 3) places."""
    if not len(places):
        return xyz
    on = _at(xyz, places)
    return np.asarray(xyz[~on]) if on.any() else xyz


def _at(xyz: Floats, places: Floats) -> Mask:
    on = np.zeros(len(xyz), bool)
    for place in places:
        # nearly all points fail in the first column
        same = np.flatnonzero(xyz[:, 0] == place[0])
        on[same[(xyz[same, 1:] == place[1:]).all(axis=1)]] = True
    return on


def _repeated(xyz: Floats) -> list[Floats]:
    """Return the triples that far more of the points have than any usual one."""
    if len(xyz) < 2 * FEWEST or not _most_alike(xyz[:, 0]) >= FEWEST:
        return []
    order = np.lexsort(xyz.T[::-1])
    ordered = xyz[order]
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(ordered, axis=0) != 0).any(axis=1)]))
    times = np.diff(np.append(starts, len(ordered)))
    if len(times) < 2 * FEWEST:
        return []  # a few places only: nothing is usual
    usual = float(np.percentile(times, 98.0))
    many = times >= max(FEWEST, TIMES_USUAL * usual)
    return list(ordered[starts[many]])


def _most_alike(values: Floats) -> int:
    """Return how many of (n,) values are the same at most, n > 0: far faster than sorting triples."""
    ordered = np.sort(values)
    starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1], [True]]))
    return int(np.diff(starts).max())
