"""Pairs of places about a pose: where near its place under the pose each place of the source is found.

A place that is sought in the whole target is found anywhere, and where overlap is small nearly all pairs of
nearest descriptors lie outside it. Sought near where a pose puts it, it is found there if the pose is right;
if not, its place in the neighbourhood is left to chance (guided matching; Hartley and Zisserman 2004, 4.8).
Nothing is chosen by whether it agrees with the pose, so that the share of those that do judges it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.match.likelihood import TEMPERATURE, Places

REACH_STEPS = 4.0
"""How far from where the pose puts it a place is sought, in steps between places: some fifty of them."""
LEAST_SEEN = 0.5
"""Share of the neighbourhood that the target must show: at its rim the right one may be missing."""
LEAST_SURE = 0.5
"""Probability, among those of the neighbourhood, that the place found is the one."""
BESIDE_STEPS = 1.5
"""Places no farther from the likeliest than this lie around it; the place sought lies between them."""
BLOCK_PAIRS = 500_000
"""Pairs whose descriptors are compared at once."""


@dataclass(frozen=True)
class PlacePairs:
    """Places of the source and where they were found in the target.

    Attributes:
        index: (n,) of the source's places.
        at: (n, 2) in the target, metres, to a part of the step between places.
        sure: (n,) probability among the places of the neighbourhood.
        off_m: (n,) how far they lie from where the pose puts them, metres.

    """

    index: NDArray[np.int64]
    at: Floats
    sure: Floats
    off_m: Floats

    def __len__(self) -> int:
        return len(self.index)


def places_about(source: Places, target: Places, T: Floats) -> PlacePairs:
    """Seek each place of the source near where a pose puts it in the target.

    Args:
        source: places that the pose may bring to the target, as seen in an orientation near its yaw.
        target: places on a lattice.
        T: 4x4 planar pose, metres.

    Returns:
        The pairs of those that stand out in their neighbourhood, agreeing with the pose or not.

    """
    none = PlacePairs(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty(0))
    if not len(source) or not len(target):
        return none
    reach = REACH_STEPS * target.step_m
    moved = source.at @ T[:2, :2].T + T[:2, 3]
    near = cKDTree(target.at).query_ball_point(moved, reach, return_sorted=True)
    counts = np.array([len(one) for one in near])
    index = np.flatnonzero(counts >= LEAST_SEEN * np.pi * REACH_STEPS**2)
    if not len(index):
        return none
    parts = np.array_split(index, max(1, -(-int(counts[index].sum()) // BLOCK_PAIRS)))
    found = [_sought(source, target, part, [near[k] for k in part]) for part in parts if len(part)]
    at, sure = (np.concatenate(column) for column in zip(*found, strict=True))
    kept = sure >= LEAST_SURE
    index, at, sure = index[kept], at[kept], sure[kept]
    return PlacePairs(index, at, sure, np.hypot(*(at - moved[index]).T))


def agreeing_share(pairs: PlacePairs, within_m: float) -> float | None:
    """Return the share of pairs no farther off the pose than so many metres; None where there are none."""
    return float((pairs.off_m < within_m).mean()) if len(pairs) else None


def reach_m(target: Places) -> float:
    """Return how far from its place under a pose a place is sought, metres."""
    return REACH_STEPS * target.step_m


def within_reach(source: Floats, target: Floats, T: Floats, reach: float) -> NDArray[np.bool_]:
    """Mark pairs that a pose brings within reach of each other.

    Args:
        source, target: (n, 2) metres.
        T: 4x4 planar pose, metres.
        reach: metres.

    """
    moved = transforms.apply(T, np.column_stack([source, np.zeros(len(source))]))[:, :2]
    return np.asarray(np.hypot(*(moved - target).T) < reach)


def _sought(
    source: Places, target: Places, index: NDArray[np.int64], near: list[list[int]]
) -> tuple[Floats, Floats]:
    """Return where places are found among those near by, (n, 2), and how sure that is, (n,)."""
    counts = np.array([len(one) for one in near])
    first = np.cumsum(counts) - counts
    partner = np.concatenate([np.asarray(one, np.int64) for one in near])
    number = np.repeat(np.arange(len(index)), counts)
    likeness = np.einsum(
        "kd,kd->k", target.descriptors[partner], source.descriptors[index[number]], dtype=np.float64
    )
    likeness /= TEMPERATURE
    best = np.maximum.reduceat(likeness, first)
    weight = np.exp(likeness - best[number])
    # the first of equals
    at_best = np.flatnonzero(likeness == best[number])
    chosen = at_best[np.unique(number[at_best], return_index=True)[1]]
    around = np.hypot(*(target.at[partner] - target.at[partner[chosen]][number]).T)
    beside = np.where(around <= BESIDE_STEPS * target.step_m, weight, 0.0)
    whole = np.add.reduceat(beside, first)
    at = np.add.reduceat(beside[:, None] * target.at[partner], first) / whole[:, None]
    return at, whole / np.add.reduceat(weight, first)
