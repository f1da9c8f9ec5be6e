"""Following hypotheses from the level that proposed them down to the finest cells.

On each level yaw and shift are improved in small steps about where the level above had left them; the cells
halve, and so do the steps in yaw.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.match.nearby import score_nearby
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.pyramid import Pyramid

ESTIMATE_CELLS = 20_000.0
"""Cells that tell which yaw and shift fit best on the way down to the finest level."""
FIRST_YAW_STEP_DEG = 1.0
FIRST_YAWS: tuple[int, ...] = (-2, -1, 0, 1, 2)
"""Steps tried on the level that proposed a pose: the search over all yaws takes steps of up to 4 degrees."""
WINDOW_CELLS = 2
COMB_CELLS = 8
COMB_YAWS = (-3, -2, -1, 0, 1, 2, 3)
FEWEST_FOLLOWED = 4
GROWTH_MARGIN = 1.25
"""Times by which the score of a hypothesis may grow on its way down beyond the most that any was seen to."""


@dataclass(frozen=True)
class Descent:
    """Hypotheses at the finest cells.

    Attributes:
        poses: those followed down, with their scores there.
        bound: those left above score less than this at the finest cells.

    """

    poses: tuple[Pose, ...]
    bound: float = 0.0


def follow(pyramid: Pyramid, factor: int, poses: Sequence[Pose], worth: float = 0.0) -> Descent:
    """Follow poses down to the finest cells.

    The score of a pose grows by about as much as that of others of its level, since finer cells are more
    cells. Once a few were followed, those that even with `GROWTH_MARGIN` times the largest growth seen would
    score less than ``worth`` are left where they are.

    Args:
        pyramid: both rasters.
        factor: the level that proposed the poses.
        poses: best first.
        worth: score at the finest cells below which a pose need not be known; 0 to follow all.

    """
    found: list[Pose] = []
    growth = 0.0
    with ThreadPoolExecutor(usable_cores()) as threads:
        if poses:
            pyramid.prepare(levels_below(factor), threads)
        for start in range(0, len(poses), FEWEST_FOLLOWED):
            some = poses[start : start + FEWEST_FOLLOWED]
            reach = GROWTH_MARGIN * growth * max(pose.score for pose in some)
            if found and reach < worth:
                return Descent(tuple(found), GROWTH_MARGIN * growth * max(p.score for p in poses[start:]))
            fine = list(threads.map(lambda pose: _follow_one(pyramid, factor, pose), some))
            growth = max(
                growth, *(b.score / a.score for a, b in zip(some, fine, strict=True) if a.score > 0), 0.0
            )
            found += fine
    return Descent(tuple(found))


def levels_below(factor: int) -> list[int]:
    """Return the levels that a pose of one passes on its way down: that one first, the finest last."""
    levels = [factor]
    while levels[-1] > 1:
        levels.append(_finer(levels[-1]))
    return levels


def _finer(level: int) -> int:
    return max(1, level // 2)


def comb_each(pyramid: Pyramid, poses: Sequence[Pose], reach_m: float) -> list[Pose]:
    """Search the surroundings of several poses closely, see `comb`."""
    with ThreadPoolExecutor(usable_cores()) as threads:
        return list(threads.map(lambda pose: comb(pyramid, pose, reach_m), poses))


def comb(pyramid: Pyramid, pose: Pose, reach_m: float) -> Pose:
    """Search the surroundings of a pose closely, and return the best found.

    Rows and other narrow structures agree only within a fraction of a degree, over a few cells: on the way
    down from coarse cells their true place is easily missed by a few metres.

    Args:
        pyramid: both rasters.
        pose: about the finest centre.
        reach_m: how far to search, metres.

    """
    level = max(1, round(reach_m / (COMB_CELLS * pyramid.source.grid.cell)))
    finest, grid = pyramid.source.grid, pyramid.at(level)[0].grid
    about = pose_of(pose.hypothesis(centre_of(finest)), centre_of(grid))
    window = max(WINDOW_CELLS, round(reach_m / grid.cell))
    # a cell at the rim, and no more than a degree
    step = min(grid.cell / (max(grid.width, grid.height) * grid.cell / 2), np.radians(FIRST_YAW_STEP_DEG))
    tries = [
        score_nearby(
            *pyramid.at(level),
            Pose(about.yaw + k * step, about.east, about.north),
            window,
            ESTIMATE_CELLS,
        )[0]
        for k in COMB_YAWS
    ]
    best = max(tries, key=lambda one: one.score)
    fine = pose_of(best.hypothesis(centre_of(grid)), centre_of(finest))
    return _follow_one(pyramid, 1, fine, float(np.degrees(step)) / 2)


def _follow_one(
    pyramid: Pyramid, factor: int, pose: Pose, first_step_deg: float = FIRST_YAW_STEP_DEG
) -> Pose:
    """Follow one pose down; its score is minus infinity where it leaves the target."""
    level, step, yaws = factor, first_step_deg, FIRST_YAWS
    while True:
        source, target = pyramid.at(level)
        tries = {k: _nearby(pyramid, level, pose, k * step) for k in yaws}
        best = max(tries, key=lambda k: tries[k].score)
        # uphill beyond what was tried at first, where the best lies at its end
        for _ in range(2):
            on = best + (1 if best > 0 else -1)
            if best == 0 or on in tries:
                break
            tries[on] = _nearby(pyramid, level, pose, on * step)
            if tries[on].score <= tries[best].score:
                break
            best = on
        pose = tries[best]
        if level == 1:
            return score_nearby(source, target, pose, 1)[0]
        finer = _finer(level)
        # the centre of the raster moves a little between levels: same pose, other pivot
        hypothesis = pose.hypothesis(centre_of(source.grid))
        pose = pose_of(hypothesis, centre_of(pyramid.at(finer)[0].grid))
        level, step, yaws = finer, step / 2, (-1, 0, 1)


def _nearby(pyramid: Pyramid, level: int, pose: Pose, turn_deg: float) -> Pose:
    """Return the best shift near a pose turned by some degrees."""
    source, target = pyramid.at(level)
    turned = Pose(pose.yaw + np.radians(turn_deg), pose.east, pose.north)
    return score_nearby(source, target, turned, WINDOW_CELLS, ESTIMATE_CELLS)[0]
