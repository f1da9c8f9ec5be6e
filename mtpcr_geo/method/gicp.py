"""Generalised ICP with nearest neighbours that are remembered: the optimiser of `mtpcr_geo.method.icp`.

A. Segal, D. Haehnel and S. Thrun, "Generalized-ICP", Robotics: Science and Systems 2009,
doi:10.15607/RSS.2009.V.021. Near the end of a descent points move by less than half of what separates their
nearest neighbour from the next one, so that it cannot have changed and is not searched for. Sums are taken in
one order, whatever the number of threads, so that results are the same bits.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices
from mtpcr_geo.core.types import IcpMethod

ALONG_NORMAL = 1e-3
"""Variance of a surface along its normal, as a share of that across it (the paper's epsilon)."""
FEWEST_PARTNERS = 6
LONGEST_RING = 8
"""Steps, at most, after which a descent that is back where it was has ended."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
"""Multiples of this, less their whole part, spread evenly, however many there are."""
_HAIR_M = 1e-9  # rounding could tip what is nearly halfway
DAMPING, DAMPING_FACTOR, LEAST_DAMPING, MOST_TRIES = 1e-3, 10.0, 1e-9, 10
"""Damping of Levenberg and Marquardt's step at first, by what it changes, where it stops falling, and how
often it is raised."""


@dataclass(frozen=True)
class Surface:
    """Points with the directions of their surfaces.

    Attributes:
        points: (n, 3) metres.
        normals: (n, 3) unit normals, of either sign.

    """

    points: Floats
    normals: Floats


@dataclass(frozen=True)
class Descended:
    """Result of a descent.

    Attributes:
        T: 4x4 from source to target.
        iterations: how many there were.
        inliers: points with a partner at its end.
        converged: whether it stands still, or goes round in a ring of a few steps.

    """

    T: Floats
    iterations: int
    inliers: int
    converged: bool


class Partners:
    """Nearest points of a target, as far as they matter, for points that move little by little.

    Args:
        tree: small_gicp's KdTree of the target.
        target: (m, 3) its points.
        points: (n, 3) points that are moved.
        within_m: farthest correspondence, metres.

    """

    def __init__(self, tree: Any, target: Floats, points: Floats, within_m: float) -> None:
        self._tree, self._target, self._points, self._within = tree, target, points, within_m
        self._radius = float(np.sqrt(np.square(points).sum(axis=1).max(initial=0.0)))
        self._asked: Floats | None = None

    def of(self, T: Floats) -> tuple[Indices, Floats, Indices]:
        """Return what has a partner under a 4x4: (k,) points, (k, 3) where they lie, (k,) their partners."""
        if self._asked is None or self._farthest(T) > self._within / 2.0:
            self._ask_all(T)
            moved = self._asked_at
        else:
            moved = transforms.apply(T, self._points[self._active])
            apart = moved - self._asked_at
            gone = np.einsum("ni,ni->n", apart, apart)
            again = np.flatnonzero(gone >= self._free)
            if len(again):
                self._ask(again, moved[again])
        gap = self._target[self._nearest] - moved
        near = np.flatnonzero(np.einsum("ni,ni->n", gap, gap) <= self._within**2)
        return self._active[near], moved[near], self._nearest[near]

    def _farthest(self, T: Floats) -> float:
        """Return what no point has moved further than since all were asked for, metres."""
        assert self._asked is not None
        change = T @ transforms.inverse(self._asked)
        turned = transforms.rotation_angle(change[:3, :3])
        reach = self._radius + float(np.linalg.norm(self._asked[:3, 3]))
        return float(np.linalg.norm(change[:3, 3])) + turned * reach

    def _ask_all(self, T: Floats) -> None:
        """Find the nearest points anew, and who may come to have a partner without being asked for again."""
        moved = transforms.apply(T, self._points)
        nearest, squared = self._tree.batch_knn_search(moved, self._count, 1)
        distance = np.sqrt(np.asarray(squared))
        self._active = np.flatnonzero(distance[:, 0] <= 1.5 * self._within + _HAIR_M)
        self._asked, self._asked_at = T, moved[self._active]
        self._nearest = np.asarray(nearest)[self._active, 0].astype(np.int64)
        self._free = self._bounds(distance[self._active])

    def _ask(self, which: Indices, moved: Floats) -> None:
        nearest, squared = self._tree.batch_knn_search(moved, self._count, 1)
        self._nearest[which] = np.asarray(nearest)[:, 0]
        self._free[which] = self._bounds(np.sqrt(np.asarray(squared)))
        self._asked_at[which] = moved

    @property
    def _count(self) -> int:
        return min(2, len(self._target))

    def _bounds(self, distance: Floats) -> Floats:
        """Return the square of how far a point may go before another one can be nearer, (n,)."""
        if self._count == 1:
            return np.full(len(distance), np.inf)
        return np.asarray(np.maximum((distance[:, 1] - distance[:, 0]) / 2.0 - _HAIR_M, 0.0) ** 2)


class Descender:
    """Brings a source's surface to a target's.

    Args:
        source, target: both surfaces, in coordinates near their middle.
        tree: small_gicp's KdTree of the target's points.
        lots: (n,) from 0 to 1, of the source's points: where a share of them does, it is those below it;
            if None, points are taken evenly by their number.

    """

    def __init__(self, source: Surface, target: Surface, tree: Any, lots: Floats | None = None) -> None:
        self.source, self.target, self._tree = source, target, tree
        self._lots = np.arange(len(source.points)) * GOLDEN % 1.0 if lots is None else lots

    def descend(
        self,
        T: Floats,
        *,
        within_m: float,
        method: IcpMethod,
        iterations: int,
        still_rad: float,
        still_m: float,
        among: Indices | None = None,
        enough: int | None = None,
    ) -> Descended:
        """Iterate from a transform until it stands still, or goes round in a ring: its mean is returned then.

        Args:
            T: 4x4 from source to target.
            within_m: farthest correspondence, metres.
            method: what of a gap counts.
            iterations: at most.
            still_rad, still_m: a step below both ends it.
            among: (k,) points of the source to use; all if None.
            enough: partners that do at the start: of more, only a share is used; None uses all.

        """
        which = np.arange(len(self.source.points)) if among is None else among
        points, normals = self.source.points[which], self.source.normals[which]
        partners = Partners(self._tree, self.target.points, points, within_m)
        every = 1 if enough is None else len(partners.of(T)[0]) // enough
        if every > 1:
            few = self._lots[which] * every < 1.0
            points, normals = points[few], normals[few]
            partners = Partners(self._tree, self.target.points, points, within_m)
        damping, inliers = DAMPING, 0
        lately: deque[Floats] = deque([T], maxlen=LONGEST_RING + 1)
        for number in range(1, iterations + 1):
            near, places, partner = partners.of(T)
            inliers = len(near)
            if inliers < FEWEST_PARTNERS:
                return Descended(T, number, inliers, converged=False)
            places = np.ascontiguousarray(places.T)
            gap = np.ascontiguousarray(self.target.points[partner].T) - places
            weights = weighing(method, T[:3, :3] @ normals[near].T, self.target.normals[partner].T)
            H, b = weights.equations(places, gap)
            cost = weights.cost(gap)
            for _ in range(MOST_TRIES):
                step = np.asarray(np.linalg.solve(H + damping * np.eye(6), b), np.float64)
                change = _exponential(step)
                if weights.cost(gap + places - _moved(change, places)) <= cost:
                    break
                damping *= DAMPING_FACTOR
            else:  # however short, no step is better
                return Descended(T, number, inliers, converged=True)
            damping = max(damping / DAMPING_FACTOR, LEAST_DAMPING)
            T = change @ T
            if np.linalg.norm(step[:3]) <= still_rad and np.linalg.norm(step[3:]) <= still_m:
                return Descended(T, number, inliers, converged=True)
            # points on the verge of another partner may send it round in a ring for ever
            lately.append(T)
            for back in range(2, len(lately)):
                if _are_one(T, lately[-1 - back], still_rad, still_m):
                    return Descended(_mean(list(lately)[-back:]), number, inliers, converged=True)
        return Descended(T, iterations, inliers, converged=False)


@dataclass(frozen=True)
class Weighing:
    """Information of gaps: a share of the identity, and more or less along some directions.

    That of gap n is ``even * I + sum over k of strengths[k][n] * d d^T``, with d = directions[k][:, n].

    Attributes:
        even: what counts in every direction.
        directions: (3, n) each.
        strengths: (n,) each.

    """

    even: float
    directions: tuple[Floats, ...] = ()
    strengths: tuple[Floats, ...] = ()

    def cost(self, gap: Floats) -> float:
        """Return the weighted sum of squares of gaps (3, n)."""
        total = self.even * float(np.einsum("in,in->", gap, gap))
        for direction, strength in zip(self.directions, self.strengths, strict=True):
            along = np.einsum("in,in->n", direction, gap)
            total += float(np.einsum("n,n,n->", strength, along, along))
        return total

    def matrices(self) -> Floats:
        """Return the information of each gap, (n, 3, 3); there must be a direction."""
        of_each = [
            np.einsum("n,in,jn->nij", strength, direction, direction)
            for direction, strength in zip(self.directions, self.strengths, strict=True)
        ]
        return np.asarray(self.even * np.eye(3) + sum(of_each))

    def equations(self, places: Floats, gap: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations of a small rotation and shift, (6, 6) and (6,).

        Args:
            places: (3, n) moved points.
            gap: (3, n) from there to their partners.

        """
        H, b = np.zeros((6, 6)), np.zeros(6)
        if self.even:
            squares, total = np.einsum("in,jn->ij", places, places), places.sum(axis=1)
            H[:3, :3] = np.trace(squares) * np.eye(3) - squares
            H[:3, 3:] = _cross(total)
            H[3:, :3] = H[:3, 3:].T
            H[3:, 3:] = places.shape[1] * np.eye(3)
            turned = np.einsum("in,jn->ij", places, gap)
            b[:3] = turned[[1, 2, 0], [2, 0, 1]] - turned[[2, 0, 1], [1, 2, 0]]
            b[3:] = gap.sum(axis=1)
            H, b = self.even * H, self.even * b
        x, y, z = places
        rows = np.empty((6, places.shape[1]))
        for direction, strength in zip(self.directions, self.strengths, strict=True):
            u, v, w = direction
            rows[0], rows[1], rows[2] = y * w - z * v, z * u - x * w, x * v - y * u
            rows[3:] = direction
            weighted = rows * strength
            H += np.einsum("in,jn->ij", weighted, rows)
            b += np.einsum("in,n->i", weighted, np.einsum("in,in->n", direction, gap))
        return H, b


def weighing(method: IcpMethod, of_source: Floats, of_target: Floats) -> Weighing:
    """Return how gaps between surfaces weigh, from their normals in one frame, (3, n) each.

    Each surface spreads by 1 across its normal and by `ALONG_NORMAL` along it; the information is the inverse
    of both covariances' sum, which along the sum and the difference of both normals is known in closed form.
    """
    if method == "point_to_point":
        return Weighing(1.0)
    if method == "point_to_plane":
        return Weighing(0.0, (of_target,), (np.ones(of_target.shape[1]),))
    flat = 1.0 - ALONG_NORMAL
    cosine = np.einsum("in,in->n", of_source, of_target)
    strengths = tuple(flat / (4.0 * (2.0 - flat * (1.0 + sign * cosine))) for sign in (1.0, -1.0))
    return Weighing(0.5, (of_source + of_target, of_source - of_target), strengths)


def _cross(v: Floats) -> Floats:
    """Return the (3, 3) matrix that takes a vector to its cross product with v, v first."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _moved(T: Floats, places: Floats) -> Floats:
    """Move (3, n) points."""
    return np.asarray(np.einsum("ij,jn->in", T[:3, :3], places) + T[:3, 3:])


def _are_one(A: Floats, B: Floats, still_rad: float, still_m: float) -> bool:
    """Return whether two 4x4 differ by no more than what counts as standing still."""
    if np.linalg.norm(A[:3, 3] - B[:3, 3]) > still_m:
        return False
    return bool(np.linalg.norm(A[:3, :3] - B[:3, :3]) <= np.sqrt(2.0) * still_rad)


def _mean(ring: list[Floats]) -> Floats:
    """Return the mean of some 4x4 that hardly differ: the same wherever in the ring one begins."""
    T = np.mean(ring, axis=0)
    T[:3, :3] = transforms.orthonormal(T[:3, :3])
    return np.asarray(T, np.float64)


def _exponential(step: Floats) -> Floats:
    """Return the 4x4 of a rotation vector and a shift, (6,)."""
    angle = float(np.linalg.norm(step[:3]))
    if angle == 0.0:
        return transforms.translation(step[3:])
    R = transforms.axis_angle_matrix(step[:3] / angle, angle)
    return transforms.compose(R, step[3:])
