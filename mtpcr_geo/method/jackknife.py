"""Normal equations of the final fit in blocks of the overlap, and the block jackknife of its correction.

Neighbouring correspondences err together: the same wall, the same crown, the same error of a flight line.
Leaving out a whole block at a time and solving again from the others shows how far the pose depends on any
of them (Künsch 1989, Annals of Statistics 17(3), for the block jackknife). All is linear at the final pose,
so a delete-a-block costs a 6x6 solve.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices
from mtpcr_geo.core.equations import BlockEquations
from mtpcr_geo.method.icp import Surfaces

MOST_BLOCKS, FEWEST_BLOCKS = 16, 8
FEWEST_IN_BLOCK = 40
"""Correspondences that a block must have: below that its own noise hides what it has in common."""
QUARTERS = 4
QUARTER_STEPS = 3
"""Rounds of new correspondences in which a quarter of the overlap is solved by itself."""
MOST_CORRESPONDENCES = 8_000
RIDGE = 1e-9
"""Share of the mean information added to a block's, so that one that sees no motion along a direction asks
for none along it."""


def blocks_of(xy: Floats, count: int) -> Indices:
    """Divide places into blocks of equally many by halving the longer side again and again.

    The blocks follow the overlap's own extent and shape: none is larger than needed, none empty.

    Args:
        xy: (n, 2) metres.
        count: of the blocks; a power of two.

    Returns:
        (n,) number of each place's block.

    """
    number = np.zeros(len(xy), np.int64)
    parts = [np.arange(len(xy))]
    while len(parts) < count:
        halves = []
        for part in parts:
            longer = int(np.argmax(np.ptp(xy[part], axis=0))) if len(part) else 0
            order = part[np.argsort(xy[part, longer], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts = halves
    for index, part in enumerate(parts):
        number[part] = index
    return number


def block_count(correspondences: int) -> int:
    """Return how many blocks that many correspondences bear: a power of two, none below the fewest."""
    borne = max(correspondences // FEWEST_IN_BLOCK, FEWEST_BLOCKS)
    return int(min(2 ** int(np.log2(borne)), MOST_BLOCKS))


def rows_of(places: Floats, gap: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Return the normal equations of each correspondence.

    Args:
        places: (n, 3) points of the registered source less the pivot, metres.
        gap: (n, 3) from there to the target, metres.
        weight: (n, 3, 3) information of the gap.

    Returns:
        (n, 6, 6) and (n, 6), of a correction as `BlockEquations` has it.

    """
    J = np.zeros((len(places), 3, 6))
    x, y, z = places.T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, [0, 1, 2], [3, 4, 5]] = 1.0
    weighted = np.matmul(weight, J)
    H = np.matmul(J.transpose(0, 2, 1), weighted)
    return H, np.einsum("nij,ni->nj", weighted, gap)


def equations_of(
    T: Floats, pivot: Floats, places: Floats, gap: Floats, weight: Floats, fitted: str
) -> BlockEquations:
    """Sum the normal equations of correspondences over blocks.

    Args:
        T: 4x4 at which they hold.
        pivot: (3,) target work coordinates, metres.
        places, gap, weight: see `rows_of`.
        fitted: what the correspondences are.

    """
    H, b = rows_of(places, gap, weight)
    count = block_count(len(places))
    number = blocks_of(places[:, :2], count)
    sums_H, sums_b, centres, counts = _summed(number, count, H, b, places)
    # the blocks of a quarter follow each other
    per_quarter = count // QUARTERS
    left = float(np.einsum("ni,nij,nj->", gap, weight, gap)) / max(len(places) - 6, 1)
    quarters = [
        solved(sums_H[one].sum(axis=0), sums_b[one].sum(axis=0))
        for one in (slice(q * per_quarter, (q + 1) * per_quarter) for q in range(QUARTERS))
    ]
    return BlockEquations(
        T=T,
        pivot=pivot,
        centres=centres + pivot,
        H=sums_H,
        b=sums_b,
        counts=counts,
        variance=left,
        quarters=np.array(quarters),
        quarter_centres=centres.reshape(QUARTERS, per_quarter, 3).mean(axis=1) + pivot,
        gap_m=float(np.median(np.linalg.norm(gap, axis=1))),
        fitted=fitted,
    )


def equations_of_surfaces(surfaces: Surfaces, T: Floats, within_m: float) -> BlockEquations | None:
    """Return the normal equations of the last round of ICP, in blocks.

    The quarters are solved by themselves with correspondences of their own, as ICP would.

    Args:
        surfaces: of both clouds, as that round saw them.
        T: 4x4 from source to target work coordinates, where it ended.
        within_m: farthest correspondence of that round, metres.

    Returns:
        None where too few correspondences are left.

    """
    points, _ = surfaces.sizes
    every = np.arange(0, points, max(-(-points // MOST_CORRESPONDENCES), 1))
    found = surfaces.correspondences(T, within_m, every)
    if len(found.index) < FEWEST_BLOCKS * FEWEST_IN_BLOCK // 4:
        return None
    middle = found.places.mean(axis=0)
    places = found.places - middle
    pivot = surfaces.pivot + middle
    equations = equations_of(T, pivot, places, found.gap, found.weight, "surfaces")
    quarter = blocks_of(places[:, :2], QUARTERS)
    alone = [
        _alone(surfaces, T, within_m, found.index[quarter == number], middle) for number in range(QUARTERS)
    ]
    return replace(equations, quarters=np.array(alone))


def _alone(surfaces: Surfaces, T: Floats, within_m: float, among: Indices, middle: Floats) -> Floats:
    """Return the correction (6,) that some points ask for by themselves, about the pivot."""
    pivot = surfaces.pivot + middle
    start, T_now = T, T
    for _ in range(QUARTER_STEPS):
        found = surfaces.correspondences(T_now, within_m, among)
        if len(found.index) < 6:
            break
        H, b = rows_of(found.places - middle, found.gap, found.weight)
        T_now = moved_by(solved(H.sum(axis=0), b.sum(axis=0)), pivot) @ T_now
    return correction_of(T_now @ transforms.inverse(start), pivot)


def moved_by(x: Floats, pivot: Floats) -> Floats:
    """Return a correction (6,) about a pivot as a 4x4; see `BlockEquations`."""
    angle = float(np.linalg.norm(x[:3]))
    R = transforms.axis_angle_matrix(x[:3] / angle, angle) if angle > 0 else np.eye(3)
    return np.asarray(transforms.translation(x[3:]) @ transforms.about(pivot, R))


def correction_of(T: Floats, pivot: Floats) -> Floats:
    """Return a small 4x4 as a correction (6,) about a pivot: the inverse of `moved_by`."""
    R = T[:3, :3]
    half = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0
    sine = float(np.linalg.norm(half))
    turn = half if sine < 1e-12 else half * (transforms.rotation_angle(R) / sine)
    return np.concatenate([turn, transforms.apply(T, pivot[None])[0] - pivot])


def jackknife(equations: BlockEquations) -> Floats:
    """Return the covariance (6, 6) of the correction by leaving out a block at a time.

    With k blocks it is scaled by (k - 1) / (k - 3), as the spread of few is that of a t distribution.
    """
    H, b = equations.H, equations.b
    k = len(H)
    without = np.array([solved(H.sum(axis=0) - h, b.sum(axis=0) - v) for h, v in zip(H, b, strict=True)])
    off = without - without.mean(axis=0)
    return np.asarray((k - 1) / k * (off.T @ off) * (k - 1) / max(k - 3, 1))


def information_bound(equations: BlockEquations) -> Floats:
    """Return the covariance (6, 6) that independent correspondences would give: what it cannot fall below."""
    total = equations.H.sum(axis=0)
    return np.asarray(equations.variance * np.linalg.pinv(total + _ridge(total)))


def not_below(covariance: Floats, bound: Floats) -> Floats:
    """Return a covariance raised to a bound in every direction in which it is less.

    Args:
        covariance, bound: (n, n), symmetric; the bound positive definite.

    """
    values, axes = np.linalg.eigh(bound)
    root = axes * np.sqrt(np.maximum(values, 1e-300))
    back = (axes / np.sqrt(np.maximum(values, 1e-300))).T
    whitened = back @ covariance @ back.T
    values, axes = np.linalg.eigh((whitened + whitened.T) / 2.0)
    raised = (axes * np.maximum(values, 1.0)) @ axes.T
    return np.asarray(root @ raised @ root.T)


def solved(H: Floats, b: Floats) -> Floats:
    """Solve normal equations, with no motion along what they do not see."""
    return np.asarray(np.linalg.solve(H + _ridge(H), b))


def _ridge(H: Floats) -> Floats:
    """Return a diagonal that is small beside the information of rotations, and of shifts."""
    turn, shift = np.trace(H[:3, :3]) / 3.0, np.trace(H[3:, 3:]) / 3.0
    return np.asarray(np.diag([RIDGE * turn + 1e-12] * 3 + [RIDGE * shift + 1e-12] * 3))


def _summed(
    number: Indices, count: int, H: Floats, b: Floats, places: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Sum equations and average places by block."""
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(count))
    counts = np.bincount(number, minlength=count).astype(np.float64)
    sums = [np.add.reduceat(values[order], starts, axis=0) for values in (H, b, places)]
    return sums[0], sums[1], sums[2] / np.maximum(counts, 1.0)[:, None], counts
