"""From tie points to a rigid transform: iterative SVD with outlier rejection, and a robust start for it.

From many outliers the SVD does not recover, however often it is repeated. With the vertical known, only a yaw
and a shift remain; two tie points determine them, so that RANSAC over pairs of tie points finds a start which
the SVD can improve.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.types import Solution, SolveSettings, TiePoints
from mtpcr_geo.core.wording import only

DEFAULTS = SolveSettings()
NUMBERS_AT_A_TIME = 32_768
"""Residuals computed at a time: as many as stay in a core's own cache."""


def fit_rigid(source: Floats, target: Floats, weight: Floats | None = None) -> Floats:
    """Return the least-squares rigid transform without scale (Kabsch; Umeyama 1991, doi:10.1109/34.88573).

    Args:
        source, target: (n, 3) corresponding points, metres, n >= 3 and not on a line.
        weight: (n,) non-negative weights; equal if None.

    Returns:
        4x4 transform from source to target; the rotation is proper (determinant +1).

    """
    w = np.ones(len(source)) if weight is None else np.asarray(weight, np.float64)
    w = w / w.sum()
    cs, ct = w @ source, w @ target
    U, _, Vt = np.linalg.svd((target - ct).T @ ((source - cs) * w[:, None]))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return transforms.compose(R, ct - R @ cs)


def fit_upright(source: Floats, target: Floats, weight: Floats | None = None) -> Floats:
    """Return the least-squares yaw and shift, with the vertical known.

    Args:
        source, target: (n, 3) or (n, 2) corresponding points, metres, n >= 2.
        weight: (n,) non-negative weights; equal if None.

    Returns:
        4x4 transform; its vertical shift is the mean height difference, 0 for planar input.

    """
    w = np.ones(len(source)) if weight is None else np.asarray(weight, np.float64)
    w = w / w.sum()
    cs, ct = w @ source, w @ target
    a, b = source - cs, target - ct
    cross = float(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    dot = float(w @ (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    R = transforms.yaw_matrix(np.arctan2(cross, dot))
    if source.shape[1] == 2:
        cs, ct = np.append(cs, 0.0), np.append(ct, 0.0)
    return transforms.compose(R, ct - R @ cs)


def ransac_upright(
    source: Floats, target: Floats, tolerance: float, seed: int, iterations: int = 2000
) -> tuple[Floats, Mask]:
    """Find the yaw and shift on which most tie points agree in plan.

    Args:
        source, target: (n, >=2) corresponding points, metres.
        tolerance: largest plan residual of an inlier, metres.
        seed: of the sampling.
        iterations: pairs of tie points tried.

    Returns:
        4x4 transform refitted to its inliers (planar: no vertical part), and the (n,) inlier mask.
        With fewer than two tie points, the identity and an empty mask.

    """
    n = len(source)
    s, t = np.asarray(source[:, :2]), np.asarray(target[:, :2])
    if n < 2:
        return np.eye(4), np.zeros(n, bool)
    rng = np.random.default_rng(seed)
    first = rng.integers(0, n, iterations)
    second = (first + rng.integers(1, n, iterations)) % n
    ds, dt = s[second] - s[first], t[second] - t[first]
    ls, lt = np.hypot(*ds.T), np.hypot(*dt.T)
    # a rigid motion keeps distances; short bases turn noise into yaw
    usable = (np.abs(ls - lt) < 2 * tolerance) & (ls > 4 * tolerance)
    first, ds, dt = first[usable], ds[usable], dt[usable]
    if not len(first):
        return np.eye(4), np.zeros(n, bool)
    yaw = np.arctan2(ds[:, 0] * dt[:, 1] - ds[:, 1] * dt[:, 0], (ds * dt).sum(axis=1))
    best = _most_agreed(s, t, yaw, first, tolerance)
    T = fit_upright(s[best], t[best])
    for _ in range(5):
        residual = np.hypot(*(transforms.apply(T, _planar(s))[:, :2] - t).T)
        inlier = residual < tolerance
        if inlier.sum() < 2 or (inlier == best).all():
            break
        best = inlier
        T = fit_upright(s[best], t[best])
    return T, best


def _most_agreed(s: Floats, t: Floats, yaw: Floats, anchor: NDArray[np.int64], tolerance: float) -> Mask:
    """Mark the tie points that agree with the best of many poses, each exact at one tie point."""
    best, best_count = np.zeros(len(s), bool), -1
    x, y, to_east, to_north = np.ascontiguousarray(np.hstack([s, t]).T)
    step = max(1, NUMBERS_AT_A_TIME // len(s))
    for start in range(0, len(yaw), step):
        c, r = np.cos(yaw[start : start + step, None]), np.sin(yaw[start : start + step, None])
        i = anchor[start : start + step]
        rows = np.arange(len(i))
        east, north = c * x, r * x
        east -= r * y
        east -= to_east
        north += c * y
        north -= to_north
        east -= east[rows, i][:, None]
        north -= north[rows, i][:, None]
        east *= east
        north *= north
        east += north
        agree = east < tolerance**2
        counts = np.count_nonzero(agree, axis=1)
        k = int(np.argmax(counts))
        if counts[k] > best_count:
            best, best_count = agree[k], int(counts[k])
    return best


def _planar(xy: Floats) -> Floats:
    return np.column_stack([xy, np.zeros(len(xy))])


def iterative_svd(
    source: Floats,
    target: Floats,
    *,
    start: Mask | None = None,
    weight: Floats | None = None,
    factor: float = 2.5,
    floor: float = 0.5,
    ceiling: float = np.inf,
    max_iterations: int = 30,
    upright: bool = False,
) -> Solution:
    """Fit, drop what lies beyond ``factor`` robust standard deviations, and repeat until stable.

    Args:
        source, target: (n, 3) tie points, metres.
        start: (n,) tie points of the first fit; all if None (as in the paper).
        weight: (n,) weights.
        factor: residuals beyond this many times 1.4826 median residuals are outliers.
        floor: the threshold never falls below this, metres: below the raster's own precision a residual
            says nothing.
        ceiling: nor does it rise above this, metres: with few tie points that agree badly it would grow until
            it includes all.
        max_iterations: rounds at most.
        upright: solve yaw and shift only.

    Returns:
        The transform, its (n,) inlier mask, the rounds, and the last threshold in metres.

    """
    fit = fit_upright if upright else fit_rigid
    least = 2 if upright else 3
    inlier = np.ones(len(source), bool) if start is None else start.copy()
    T, threshold, rounds = np.eye(4), floor, 0
    for rounds in range(1, max_iterations + 1):  # noqa: B007 - reported below
        T = fit(source[inlier], target[inlier], None if weight is None else weight[inlier])
        residual = np.linalg.norm(transforms.apply(T, source) - target, axis=1)
        spread = 1.4826 * float(np.median(residual[inlier]))
        threshold = min(max(floor, factor * spread), ceiling)
        now = residual < threshold
        if now.sum() < least or (now == inlier).all():
            break
        inlier = now
    return Solution(T, inlier, rounds, threshold)


def solve_tie_points(
    tie_points: TiePoints,
    tolerance: float,
    settings: SolveSettings = DEFAULTS,
    held_out: Mask | None = None,
) -> tuple[Solution, Mask]:
    """Solve the transform from the tie points not held out: robust start, then iterative SVD.

    Args:
        tie_points: in levelled coordinates, metres; their scores squared are the weights of the fit.
        tolerance: plan residual up to which a tie point may agree with a pose, metres; about 1.5 cells.
        settings: how to solve.
        held_out: (n,) tie points to leave out; those that `tie_points` holds out if None.

    Returns:
        The solution, whose inlier mask covers the used tie points only, and the (n,) mask of all tie
        points within the final threshold in plan, held out ones included.

    Raises:
        RegistrationError: if fewer tie points agree than a transform needs.

    """
    source, target = tie_points.source, tie_points.target
    used = np.flatnonzero(~(tie_points.held_out if held_out is None else held_out))
    least = 3
    if len(used) < least:
        held = len(source) - len(used)
        kept = f", {held} of them held out to judge by," if held else ""
        raise RegistrationError(
            f"{only(len(source), 'tie point')} found{kept} and at least {least} are needed to solve "
            "a transform from: too few places look alike in both rasters; give denser clouds or larger parts "
            "of them, or another cell or matcher (options cell, matcher)"
        )
    s, t = source[used], target[used]
    start = None
    if settings.robust_start:
        _, start = ransac_upright(s, t, tolerance, settings.seed, settings.tries)
        if start.sum() < least:
            raise RegistrationError(
                f"of {len(used)} tie points no {least} agree on one yaw and shift within {tolerance:g} m: "
                "what looks alike in both rasters is not the same place; see that the clouds overlap, or try "
                "another cell or matcher (options cell, matcher)"
            )
    # a robust start bounds how far agreeing tie points may lie apart; the paper has no such bound
    ceiling = 2.0 * tolerance if settings.robust_start else np.inf
    weight = np.maximum(tie_points.score[used], 0.05) ** 2
    flat = np.array([1.0, 1.0, 0.0])
    if settings.upright:
        # heights of single tie points are rough: plan is solved without them, height from their median
        solution = iterative_svd(
            s * flat, t * flat, start=start, weight=weight, floor=tolerance, ceiling=ceiling, upright=True
        )
        moved = transforms.apply(solution.T, s)
        rise = float(np.median((t - moved)[solution.inlier, 2]))
        T = transforms.translation((0.0, 0.0, rise)) @ solution.T
        solution = replace(solution, T=T)
    else:
        solution = iterative_svd(s, t, start=start, weight=weight, floor=tolerance, ceiling=ceiling)
    plan = np.hypot(*(transforms.apply(solution.T, source) - target)[:, :2].T)
    inlier = plan < max(tolerance, solution.threshold)
    return replace(solution, settings=settings, used=len(used)), inlier
