"""Stray points: far flyers, and multipath far below ground or behind what is seen.

They are known by two things together: they lie outside the body of the cloud by more than its size, and
hardly any other point lies near them. Towers, masts, cables and far walls lie outside the body as well, but
in company. The result is a box around all that is no stray, by which a stream of points is filtered.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from mtpcr_geo.core.arrays import Floats, Mask

FEWEST_POINTS = 1_000
"""Points below which nothing is usual enough for anything to be called a stray."""
BODY = (1.0, 99.0)
"""Percentiles of each coordinate between which the body of a cloud lies."""
BODY_POINTS = 200_000
"""Points, evenly chosen of all, that tell where the body lies."""
BEYOND = 1.0
"""Sizes of the body from its edge, on each axis, within which no point is a stray."""
FLATTEST = 0.05
"""Height of the body over its width at the least: flat ground has towers on it."""
COMPANY_SHARE = 1e-4
COMPANY_LEAST = 5
"""Points around one, in a neighbourhood of three quarters of `BEYOND`, with which it is no stray: so many, or
this share of all."""
MOST_SHARE = 0.01
"""Share of strays above which there are none: what is so common is part of the place."""


def stray_box(xyz: Floats) -> Floats | None:
    """Return the box (2, 3) beyond which points are strays; None where nothing can be told.

    Args:
        xyz: (n, 3) a cloud or a uniform sample of it, in any units with x and y alike.

    """
    if len(xyz) < FEWEST_POINTS:
        return None
    low, high = np.percentile(xyz[:: max(1, len(xyz) // BODY_POINTS)], BODY, axis=0)
    size = high - low
    size[:2] = size[:2].max()
    size[2] = max(size[2], FLATTEST * size[0])
    if not (size > 0).all():
        return None
    box = np.stack([low - BEYOND * size, high + BEYOND * size])
    outside = beyond(xyz, box)
    if not outside.any():
        return box
    edge = BEYOND * size / 4
    company = _in_company(xyz, outside, edge)
    if (~company).sum() > MOST_SHARE * len(xyz):
        return None
    kept = xyz[outside][company]
    if len(kept):
        # the outermost points of a cloud may be missing in its sample
        box[0] = np.minimum(box[0], kept.min(axis=0) - edge)
        box[1] = np.maximum(box[1], kept.max(axis=0) + edge)
    return box


def beyond(xyz: Floats, box: Floats) -> Mask:
    """Return which of (n, 3) points lie outside a box (2, 3)."""
    outside = np.zeros(len(xyz), bool)
    # column by column it takes half the time
    for column, low, high in zip(xyz.T, *box, strict=True):
        outside |= column < low
        outside |= column > high
    return outside


def within(xyz: Floats, box: Floats | None) -> Floats:
    """Leave out the points (n, 3) beyond a box; None leaves out none."""
    if box is None:
        return xyz
    out = beyond(xyz, box)
    return np.asarray(xyz[~out]) if out.any() else xyz


def _in_company(xyz: Floats, outside: Mask, edge: Floats) -> Mask:
    """Return which of the points outside have company, of all points in the 27 cells around theirs."""
    wanted = max(COMPANY_LEAST, COMPANY_SHARE * len(xyz))
    cells = np.floor((xyz - np.median(xyz, axis=0)) / edge)
    own, place = np.unique(cells[outside], axis=0, return_inverse=True)
    found, counts = np.unique(cells, axis=0, return_counts=True)
    number = {tuple(cell): int(count) for cell, count in zip(found.tolist(), counts.tolist(), strict=True)}
    steps = list(product((-1.0, 0.0, 1.0), repeat=3))
    company = [
        sum(number.get((x + i, y + j, z + k), 0) for i, j, k in steps) >= wanted for x, y, z in own.tolist()
    ]
    return np.asarray(company, bool)[place.reshape(-1)]
