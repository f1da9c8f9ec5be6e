"""The uncertainty of the final pose: a block jackknife of the final fit, and what that cannot see.

A jackknife sees how far the pose depends on any block of the overlap. Five things it does not see are added:
that correspondences follow the pose, so that a block gives way less in the linear equations than in ICP;
errors that reach over whole quarters of the overlap; what the ground and the surfaces say differently of the
height; the part of the points' distances that no fit resolves; and where the scene repeats itself, how far
the fit went from the tie points in plan: along rows of panels or vines surfaces slide, and tie points do not.
"""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.equations import BlockEquations
from mtpcr_geo.core.types import Pair, TiePoints
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.method.jackknife import (
    FEWEST_BLOCKS,
    QUARTERS,
    correction_of,
    equations_of,
    information_bound,
    jackknife,
    not_below,
    solved,
)
from mtpcr_geo.method.overlap import CommonGround

GAP_FLOOR = 0.1
"""Standard deviation in plan that is never undercut, as a share of the distance of corresponding points."""
HEIGHT_FLOOR = 0.25
"""Height has this share of the floor in plan: surfaces are level oftener than upright."""
MOST_GIVING_WAY = 4.0
SLID_SHARE = 0.5
"""Standard deviation in plan of a scene that repeats itself, as a share of how far the fit went from the tie
points. Of 46 simulated ones that distance and the true error correlate by 0.92."""
_BLOCK = 262_144
FEWEST_TIE_POINTS = 8
FEWEST_GROUND = 30


def equations_of_pair(pair: Pair, ground: CommonGround, tolerance: float) -> BlockEquations | None:
    """Return the equations of the final fit: of its surfaces, or of tie points and ground if those decided.

    Args:
        pair: with a transform, tie points and, where it was refined, the equations of that.
        ground: that both clouds see under the transform, target work coordinates.
        tolerance: plan distance within which a tie point agrees, metres.

    Returns:
        None where too little agrees to tell.

    """
    refined = pair.refinement
    equations = None if refined is None or refined.slid_m is not None else refined.equations
    if equations is None and pair.tie_points is not None:
        equations = equations_of_tie_points(pair, pair.tie_points, ground, tolerance)
    return equations


def uncertainty_of(pair: Pair, equations: BlockEquations, ground: CommonGround) -> Uncertainty | None:
    """Return the uncertainty of a pair's transform.

    Args:
        pair: with a transform.
        equations: of the final fit.
        ground: that both clouds see under the transform, target work coordinates.

    Returns:
        None where it cannot be told.

    """
    T = pair.T_target_source
    assert T is not None
    # where another pose was taken than that of the fit, it is off by as much
    taken = correction_of(T @ transforms.inverse(equations.T), equations.pivot)
    covariance = not_below(jackknife(equations), _between_quarters(equations))
    covariance = not_below(giving_way(equations) ** 2 * covariance, information_bound(equations))
    covariance = covariance + _floor(equations, pair, ground) + np.outer(taken, taken)
    R_level = pair.target.T_level_work[:3, :3]
    both = np.kron(np.eye(2), R_level)
    if pair.matches is not None and pair.matches.repeats and pair.refinement is not None:
        went = both @ correction_of(T @ transforms.inverse(pair.refinement.T_before), equations.pivot)
        # tie points tell plan and yaw
        slid = SLID_SHARE * both.T @ (went * np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0]))
        covariance = covariance + np.outer(slid, slid)
    if not np.isfinite(covariance).all():
        return None
    return Uncertainty(
        covariance=both @ covariance @ both.T,
        pivot=equations.pivot,
        R_level=R_level,
        far=_farthest(pair.source.sample, T, equations.pivot, R_level),
        blocks=len(equations.H),
        correspondences=int(equations.counts.sum()),
        fitted=equations.fitted,
    )


def _farthest(source: Floats, T: Floats, pivot: Floats, R_level: Floats) -> Floats:
    """Return where the point of the source (n, 3) farthest in plan from a pivot comes to lie, (3,)."""
    best, found = -1.0, pivot
    for start in range(0, len(source), _BLOCK):
        moved = transforms.apply(T, source[start : start + _BLOCK])
        off = (moved - pivot) @ R_level[:2].T
        squared = np.einsum("ij,ij->i", off, off)
        k = int(np.argmax(squared))
        if squared[k] > best:
            best, found = float(squared[k]), moved[k]
    return found


def giving_way(equations: BlockEquations) -> float:
    """Return how much farther quarters of the overlap move when correspondences follow, 1 or more.

    The nearest point of the target moves along with a point of the source, so that the pose gives way by
    more than equations with fixed correspondences say (Censi 2007, ICRA). How much is seen by solving each
    quarter both ways.
    """
    linear = _seen_at_quarters(equations, _linear_quarters(equations))
    followed = _seen_at_quarters(equations, equations.quarters)
    spread = [float(np.sqrt(((one - one.mean(axis=0)) ** 2).mean())) for one in (linear, followed)]
    return float(np.clip(spread[1] / max(spread[0], 1e-12), 1.0, MOST_GIVING_WAY))


def _linear_quarters(equations: BlockEquations) -> Floats:
    """Return the correction (q, 6) of each quarter by the linear equations alone."""
    H = equations.H.reshape(QUARTERS, -1, 6, 6).sum(axis=1)
    b = equations.b.reshape(QUARTERS, -1, 6).sum(axis=1)
    return np.array([solved(h, v) for h, v in zip(H, b, strict=True)])


def _seen_at_quarters(equations: BlockEquations, x: Floats) -> Floats:
    """Return by how much corrections (q, 6) shift the middle of their own quarter, (q, 3) metres."""
    return np.asarray(x[:, 3:] + np.cross(x[:, :3], equations.quarter_centres - equations.pivot))


def quarter_spread(equations: BlockEquations, R_level: Floats) -> tuple[float, float]:
    """Return how far apart the quarters of the overlap, each solved by itself, put their middles.

    Args:
        equations: of the fit.
        R_level: (3, 3) to levelled axes.

    Returns:
        Standard deviation in plan (both axes together) and in height, metres.

    """
    seen = _seen_at_quarters(equations, equations.quarters) @ R_level.T
    deviation = seen.std(axis=0, ddof=1)
    return float(np.hypot(deviation[0], deviation[1])), float(deviation[2])


def _between_quarters(equations: BlockEquations) -> Floats:
    """Return the covariance (6, 6) by leaving out a quarter at a time: for errors longer than a block."""
    H = equations.H.reshape(QUARTERS, -1, 6, 6).sum(axis=1)
    b = equations.b.reshape(QUARTERS, -1, 6).sum(axis=1)
    without = np.array([solved(H.sum(axis=0) - h, b.sum(axis=0) - v) for h, v in zip(H, b, strict=True)])
    off = without - without.mean(axis=0)
    return np.asarray((QUARTERS - 1) / QUARTERS * (off.T @ off))


def _floor(equations: BlockEquations, pair: Pair, ground: CommonGround) -> Floats:
    """Return the covariance (6, 6) of what no jackknife sees, in work axes."""
    off = equations.centres - equations.pivot
    arm = max(float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())), 1e-3)
    plan = GAP_FLOOR * equations.gap_m
    noise, differ = _height_noise(pair, ground)
    uneven = float(np.hypot(HEIGHT_FLOOR * plan, noise))
    height = float(np.hypot(uneven, differ))
    return np.diag([(uneven / arm) ** 2] * 2 + [(plan / arm) ** 2] + [plan**2] * 2 + [height**2])


def _height_noise(pair: Pair, ground: CommonGround) -> tuple[float, float]:
    """Return how well the ground tells the height, and how far the fit and the ground differ, metres."""
    noise = 0.0
    if len(ground.step) >= FEWEST_GROUND:
        shape = ground.shape()
        if np.isfinite(shape.spread_m):
            noise = shape.spread_m / float(np.sqrt(shape.blocks))
    settled = pair.refinement.ground_after if pair.refinement is not None else None
    if settled is not None and settled.rise_m is not None:
        return noise, abs(settled.rise_m)
    return noise, 0.0


def equations_of_tie_points(
    pair: Pair, tie_points: TiePoints, ground: CommonGround, tolerance: float
) -> BlockEquations | None:
    """Return the equations of a pose that rests on tie points in plan and on the ground in height.

    Args:
        pair: with a transform.
        tie_points: levelled, metres.
        ground: see `uncertainty_of`; where there is too little, the tie points tell the height.
        tolerance: plan distance within which a tie point agrees, metres.

    """
    T = pair.T_target_source
    assert T is not None
    T_work_level = transforms.inverse(pair.target.T_level_work)
    source = transforms.apply(pair.levelled(T), tie_points.source)
    gap = tie_points.target - source
    near = np.hypot(gap[:, 0], gap[:, 1]) < 2.0 * tolerance
    if near.sum() < FEWEST_TIE_POINTS:
        return None
    places, gap = source[near], gap[near]
    scatter = max(float(np.median(np.hypot(gap[:, 0], gap[:, 1]))) / 1.1774, 1e-3 * tolerance)
    rise = max(1.4826 * float(np.median(np.abs(gap[:, 2]))), 1e-3 * tolerance)
    known = len(ground.step) >= FEWEST_GROUND
    weight = np.diag([scatter**-2, scatter**-2, 0.0 if known else rise**-2])
    weights = np.broadcast_to(weight, (len(places), 3, 3))
    R = T_work_level[:3, :3]
    places, gap, weights = transforms.apply(T_work_level, places), gap @ R.T, R @ weights @ R.T
    if known:
        spread = max(1.4826 * float(np.median(np.abs(ground.step - np.median(ground.step)))), 1e-3)
        close = np.abs(ground.step) < 3.0 * spread + abs(float(np.median(ground.step)))
        low = np.column_stack([ground.xy, ground.target])[close]
        up = np.zeros_like(low)
        up[:, 2] = ground.step[close]
        upward = np.broadcast_to(np.diag([0.0, 0.0, spread**-2]), (len(low), 3, 3))
        places, gap = np.vstack([places, low]), np.vstack([gap, up])
        weights = np.concatenate([weights, upward])
    pivot = places[: int(near.sum())].mean(axis=0)
    if len(places) < FEWEST_BLOCKS:
        return None
    return equations_of(T, pivot, places - pivot, gap, weights, "tie points")
