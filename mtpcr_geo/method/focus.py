"""FOCUS: where clouds overlap little, match again, finer, around what the first pass matched.

The paper does not say how overlap is known before registration, nor what a neighbourhood is. Here the pose on
which most matches of the first pass agree tells the overlap; below theta, the clouds' points within a
radius of the agreeing matches are rasterised at finer cells and matched again, by the same matcher.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Matches
from mtpcr_geo.method.bev import grid_around, make_bev
from mtpcr_geo.method.overlap import overlap_of
from mtpcr_geo.method.solve import ransac_upright

Rematch = Callable[[Bev, Bev, float | None], Matches]
"""Matches two rasters, source first, at a yaw in radians that is known to some 20 degrees, or None."""

FEWEST = 5
"""Agreeing matches below which the first pass is taken to have found no pose."""
FEWEST_POINTS = 100
TRIES = 20_000


@dataclass(frozen=True)
class FocusSettings:
    """What governs FOCUS.

    Attributes:
        theta: overlap, as a share of the less covered cloud's area, below which it matches again.
        finer: by which the cells are divided.
        radius_m: of the neighbourhood of a match, metres.
        finest_m: cells are made no finer than this, metres.

    """

    theta: float = 0.3
    finer: float = 2.0
    radius_m: float = 25.0
    finest_m: float = 0.25


@dataclass(frozen=True)
class Subject:
    """One cloud that FOCUS may look at again.

    Attributes:
        xyz: (n, 3) levelled points, metres.
        grid: where its raster lies, on whose pixels matches are counted.

    """

    xyz: Floats
    grid: Grid


def focus(
    rematch: Rematch,
    first: Matches,
    source: Subject,
    target: Subject,
    settings: FocusSettings,
    seed: int = 0,
) -> Matches:
    """Match again where the overlap is small, and keep what more matches agree on.

    Args:
        rematch: the matcher that matched first.
        first: what it found.
        source, target: both clouds.
        settings: see `FocusSettings`.
        seed: of random choices.

    Returns:
        The matches, on the pixels of the rasters given; ``report["focus"]`` says what was done, and
        ``before_focus`` holds the first pass where it was replaced.

    """
    tolerance = 1.5 * max(source.grid.cell, target.grid.cell)
    T, agreeing = _consensus(first, source.grid, target.grid, tolerance, seed)
    known = int(agreeing.sum()) >= FEWEST
    share = overlap_share(T, source.xyz, target.xyz) if known else 0.0
    report: dict[str, Any] = {
        "overlap": share,
        "theta": settings.theta,
        "agreeing_before": int(agreeing.sum()),
        "matches_before": len(first.score),
        "pose_known": known,
        "applied": False,
    }
    if share >= settings.theta:
        return _noted(first, report | {"why": "the overlap is large enough"})
    if not len(first.score):
        return _noted(first, report | {"why": "the first pass matched nothing"})
    near = agreeing if known else np.ones(len(first.score), bool)
    rasters = []
    for subject, px in ((source, first.source_px), (target, first.target_px)):
        cell = max(subject.grid.cell / settings.finer, min(settings.finest_m, subject.grid.cell))
        points = neighbourhood(subject.xyz, subject.grid.to_metres(px[near]), settings.radius_m)
        if len(points) < FEWEST_POINTS:
            return _noted(first, report | {"why": "there are no points around the matches"})
        rasters.append(make_bev(points, cell))
    report |= {"cells_m": [one.grid.cell for one in rasters]}
    yaw = transforms.yaw_of(T[:3, :3]) if known else None
    try:
        found = rematch(rasters[0], rasters[1], yaw)
    except RegistrationError as error:
        return _noted(first, report | {"why": f"the second pass came to nothing: {error}"})
    second = _on_grids(found, (rasters[0].grid, rasters[1].grid), (source.grid, target.grid))
    _, after = _consensus(second, source.grid, target.grid, tolerance, seed)
    report |= {"agreeing_after": int(after.sum()), "matches_after": len(second.score)}
    if after.sum() <= agreeing.sum():
        return _noted(first, report | {"why": "no more matches agree at finer cells"})
    return _noted(replace(second, before_focus=first, matcher=first.matcher), report | {"applied": True})


def overlap_share(T: Floats, source: Floats, target: Floats) -> float:
    """Estimate the overlap under a planar pose: the smaller of both clouds' covered shares, 0..1.

    Args:
        T: 4x4 from source to target.
        source, target: (n, 3) and (m, 3) levelled points, metres.

    """
    moved = transforms.apply(T, source)
    overlap = overlap_of(moved, target)
    return min(float(overlap.select(moved).mean()), float(overlap.select(target).mean()))


def neighbourhood(xyz: Floats, centres: Floats, radius_m: float) -> Floats:
    """Return the (n, 3) points that lie within a radius of any of (k, 2) centres, seen from above."""
    import cv2

    low, high = transforms.bounds(xyz[:, :2])
    grid = grid_around(low, high, max(radius_m / 8, 1.0))
    spots = np.full(grid.shape, 255, np.uint8)
    column, row = grid.cells(centres)
    inside = grid.holds(column, row)
    spots[row[inside], column[inside]] = 0
    near = cv2.distanceTransform(spots, cv2.DIST_L2, 5) * grid.cell <= radius_m
    column, row = grid.cells(xyz)
    column, row = np.clip(column, 0, grid.width - 1), np.clip(row, 0, grid.height - 1)
    return np.asarray(xyz[near[row, column]])


def _consensus(
    matches: Matches, source: Grid, target: Grid, tolerance: float, seed: int
) -> tuple[Floats, Mask]:
    s, t = source.to_metres(matches.source_px), target.to_metres(matches.target_px)
    return ransac_upright(s, t, tolerance, seed, TRIES)


def _on_grids(matches: Matches, made_on: tuple[Grid, Grid], wanted: tuple[Grid, Grid]) -> Matches:
    """Express matches of a source and a target raster in pixels of other rasters of the same frames."""

    def moved(px: Floats, side: int) -> Floats:
        return wanted[side].to_pixel(made_on[side].to_metres(px))

    s, t = matches.source_keypoints, matches.target_keypoints
    return replace(
        matches,
        source_px=moved(matches.source_px, 0),
        target_px=moved(matches.target_px, 1),
        source_keypoints=None if s is None else moved(s, 0),
        target_keypoints=None if t is None else moved(t, 1),
    )


def _noted(matches: Matches, report: dict[str, Any]) -> Matches:
    return replace(matches, report={**matches.report, "focus": report})
