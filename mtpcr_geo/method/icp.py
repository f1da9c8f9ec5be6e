"""Iterative closest points on the overlap, and how well surfaces meet under a transform."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import IcpMethod, IcpRound
from mtpcr_geo.core.wording import only
from mtpcr_geo.method.downsample import near, thinned
from mtpcr_geo.method.gicp import Descender, Surface, weighing
from mtpcr_geo.method.neighbourhoods import local_shapes

FEWEST_POINTS = 60
"""Ten to each of the six parameters."""
FEWEST_TRIMMED = 200
"""Partners near by below which rounds take all points again."""
FAR_DISTANCES_M = (3.0, 1.5)
NEAR_DISTANCES_M = (1.0, 0.5)
FINE_CELL_M = 2.0
"""Cell of the rasters up to which correspondence distances stand as they are; beyond it they grow in step."""

STILL_RAD = 4e-6
STILL_M = 1e-4
LAST_ROUND = 4
"""Times as many iterations as another round that the last one may take: on level ground points slide slowly,
and a result that does not stand still depends on the start."""
ROUGH_SLACK, ROUGH_PARTNERS = 25.0, 7_500
"""For all rounds but the last: times the usual step at which they stand still, and partners that do."""
NEIGHBOURS = 10
FEWEST_THINNED = 2 * NEIGHBOURS
"""Points left by thinning below which their surroundings tell nothing of surfaces."""
FLAT = 4.0
"""Times that a flat neighbourhood spreads further along its surface than across it."""

PROBES = 10_000
MEETS_M = 0.1
"""Gap between surfaces, metres, at which the bounded cost reaches half of its greatest value."""


@dataclass(frozen=True)
class Rounds:
    """Settings of one run of ICP.

    Attributes:
        max_correspondence_distances_m: farthest correspondence of each round, metres.
        trim_m: distance within which a point of the source must have a partner at the start to take part in
            all rounds but the last, metres; None takes all. What grew or was built in between is left
            out by it; the last round takes all, so that the result does not depend on the start.
        slack: times the usual step below which the last round stands still.

    """

    max_correspondence_distances_m: tuple[float, ...]
    trim_m: float | None = None
    slack: float = 1.0


@dataclass(frozen=True)
class Descent:
    """Result of one run of ICP.

    Attributes:
        T: 4x4 from source to target, work coordinates.
        rounds: distance, iterations, inliers and convergence of each round.

    """

    T: Floats
    rounds: tuple[IcpRound, ...]


@dataclass(frozen=True)
class Correspondences:
    """Points of the source under a transform, and what they meet.

    Attributes:
        index: (n,) of the points among those kept of the source.
        places: (n, 3) where the transform puts them, less the pivot, metres.
        gap: (n, 3) from there to the nearest point of the target, metres.
        weight: (n, 3, 3) information of the gap as GICP weighs it.

    """

    index: Indices
    places: Floats
    gap: Floats
    weight: Floats


class Surfaces:
    """Both clouds' points in and around their overlap, thinned, with the directions of their surfaces.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.
        T_start: 4x4 from source to target, near the result: it decides which points lie in the overlap.
        voxel_m: thinning, metres.
        max_correspondence_distance_m: farthest correspondence to be asked for, metres.
        max_points: of the source after thinning, about; the target, which costs less, may have twice as
            many in what both share, and has its surroundings besides.
        threads: for surfaces; all cores if None. Results do not depend on it.
        T_axes: 4x4, own axes of source and target (`mtpcr_geo.method.downsample.own_axes`) where they are
            known already.

    Raises:
        RegistrationError: if the clouds hardly overlap under the start.

    """

    def __init__(
        self,
        source: Floats,
        target: Floats,
        T_start: Floats,
        *,
        voxel_m: float = 0.5,
        max_correspondence_distance_m: float = FAR_DISTANCES_M[0],
        max_points: int = 60_000,
        threads: int | None = None,
        T_axes: tuple[Floats | None, Floats | None] = (None, None),
    ) -> None:
        import small_gicp

        farthest = max_correspondence_distance_m
        moved = transforms.apply(T_start, source)
        of_source, of_target = near(moved, target, farthest), near(target, moved, farthest)
        del moved  # a copy of a whole cloud
        fewest = min(of_source.sum(), of_target.sum())
        if fewest < FEWEST_POINTS:
            role = "source" if of_source.sum() == fewest else "target"
            raise RegistrationError(
                f"{only(int(fewest), 'point')} of the {role} lie in the "
                f"overlap, within {farthest:g} m of the other cloud, and "
                f"{FEWEST_POINTS} are needed to refine the pose: it brings hardly any of the clouds "
                "together, or they are too sparse; give denser clouds, or leave the refinement out (method "
                "none of mtpcr.refine in a pipeline)"
            )
        self.T_start = T_start
        self.voxel_m = voxel_m
        self._threads = threads or usable_cores()
        self._pivot = np.floor(transforms.centroid(target[of_target]))
        thin_s = thinned(source, of_source, voxel_m, T_axes[0])
        thin_t = thinned(target, of_target, voxel_m, T_axes[1])
        s = transforms.apply(T_start, thin_s.points)
        shared = near(s, thin_t.points, farthest).sum(), near(thin_t.points, s, farthest).sum()
        thin_s = thin_s.reduced(max_points, int(shared[0]))
        thin_t = thin_t.reduced(2 * max_points, int(shared[1]))
        s = transforms.apply(T_start, thin_s.points)
        # what lies farther away has no partner, but shows the surfaces at the edge of the overlap
        self._kept = np.flatnonzero(near(s, thin_t.points, farthest))
        fewest = min(len(self._kept), int(near(thin_t.points, s, farthest).sum()))
        if fewest < FEWEST_THINNED:
            raise RegistrationError(
                f"the overlap holds points in {only(fewest, 'cell')} of {voxel_m:g} m only, and "
                f"{FEWEST_THINNED} are needed to refine the pose: it brings hardly any of the clouds together"
            )
        self._around, self._t = s - self._pivot, thin_t.points - self._pivot
        self._s, self._lots = self._around[self._kept], thin_s.lots[self._kept]
        self._source, self._target = small_gicp.PointCloud(self._around), small_gicp.PointCloud(self._t)
        self._source_tree = self._with_surfaces(self._source)
        self._tree = self._with_surfaces(self._target)

    @property
    def sizes(self) -> tuple[int, int]:
        """Points of the source that have some of the target near by, and all points of the target."""
        return len(self._s), len(self._t)

    def descend(
        self, T_from: Floats, rounds: Rounds, *, method: IcpMethod = "gicp", iterations: int = 30
    ) -> Descent:
        """Run ICP from a transform, in rounds of given correspondence distance.

        Args:
            T_from: 4x4 from source to target, work coordinates.
            rounds: correspondence distance of each round, and which points take part.
            method: "gicp" (plane to plane), "point_to_plane", or "point_to_point" (the paper's citation).
            iterations: at most, each round; four times as many in the last.

        """
        X = self._relative(T_from)
        done: list[IcpRound] = []
        distances = rounds.max_correspondence_distances_m
        trimmed = None if rounds.trim_m is None else self._trimmed(X, rounds.trim_m)
        for number, distance in enumerate(distances, 1):
            # what a round leaves is taken up by the next; only the last must stand still, and take all points
            last = number == len(distances)
            slack = rounds.slack if last else ROUGH_SLACK
            result = self._descender.descend(
                X,
                within_m=distance,
                method=method,
                iterations=iterations * (LAST_ROUND if last else 1),
                still_rad=slack * STILL_RAD,
                still_m=slack * STILL_M,
                among=None if last else trimmed,
                enough=None if last else ROUGH_PARTNERS,
            )
            X = result.T
            done.append(IcpRound(distance, result.iterations, result.inliers, result.converged))
        return Descent(self._absolute(X), tuple(done))

    def between(self, A: Floats, B: Floats) -> Floats:
        """Return the transform halfway between two that hardly differ, 4x4 each."""
        return self._absolute((self._relative(A) + self._relative(B)) / 2.0)

    def surface_residual(self, T: Floats) -> float:
        """Return how badly flat surfaces of the source meet the target: 0 all meet, 1 none does.

        Each gap along the surface's normal costs ``gap^2 / (gap^2 + 0.1^2)`` (Geman and McClure), so that
        what grew, was built or stands in one cloud only weighs alike wherever a transform puts it. The sum
        of squares that ICP minimises has no such bound, and is smallest where a field's crop is met halfway.

        Args:
            T: 4x4 from source to target, work coordinates.

        """
        probes, normals = self._probes
        if not len(probes):
            return 1.0
        X = self._relative(T)
        moved, normal = transforms.apply(X, probes), normals @ X[:3, :3].T
        nearest = np.asarray(self._tree.batch_knn_search(moved, 1, self._threads)[0])[:, 0].astype(np.int64)
        gap = np.einsum("ij,ij->i", normal, self._t[nearest] - moved)
        return float((gap**2 / (gap**2 + MEETS_M**2)).mean())

    @property
    def pivot(self) -> Floats:
        """Origin near the middle of the overlap, (3,) target work coordinates, metres."""
        return np.asarray(self._pivot)

    def correspondences(self, T: Floats, within_m: float, among: Indices) -> Correspondences:
        """Return what GICP sees at a transform: points, gaps and weights.

        Args:
            T: 4x4 from source to target, work coordinates.
            within_m: farthest correspondence, metres.
            among: (k,) points of the source to look at, see `sizes`.

        """
        chosen = np.asarray(among)
        X = self._relative(T)
        moved = transforms.apply(X, self._s[chosen])
        nearest, squared = self._tree.batch_knn_search(moved, 1, self._threads)
        near_by = np.asarray(squared)[:, 0] <= within_m**2
        chosen, moved = chosen[near_by], moved[near_by]
        partner = np.asarray(nearest)[near_by, 0].astype(np.int64)
        of_source = self._descender.source.normals[chosen] @ X[:3, :3].T
        weight = weighing("gicp", of_source.T, self._descender.target.normals[partner].T).matrices()
        return Correspondences(chosen, moved, self._t[partner] - moved, weight)

    def _with_surfaces(self, cloud: Any) -> Any:
        """Find a cloud's normals and covariances, which are stored in it, and give its tree."""
        import small_gicp

        tree = small_gicp.KdTree(cloud, self._threads)
        small_gicp.estimate_normals_covariances(cloud, tree, NEIGHBOURS, self._threads)
        return tree

    def _trimmed(self, X: Floats, within_m: float) -> Indices | None:
        """Return the source's points that have a partner near by; None, for all, where those are too few."""
        squared = np.asarray(self._tree.batch_knn_search(transforms.apply(X, self._s), 1, self._threads)[1])
        kept = np.flatnonzero(squared[:, 0] <= within_m**2)
        return None if len(kept) < FEWEST_TRIMMED else kept

    @cached_property
    def _descender(self) -> Descender:
        of_source, of_target = (np.asarray(cloud.normals())[:, :3] for cloud in (self._source, self._target))
        source = Surface(self._s, of_source[self._kept])
        return Descender(source, Surface(self._t, of_target), self._tree, self._lots)

    @cached_property
    def _probes(self) -> tuple[Floats, Floats]:
        """Flat places of the source, (n, 3), and their unit normals, (n, 3)."""
        chosen = np.flatnonzero(self._lots * max(len(self._s) // PROBES, 1) < 1.0)
        spread, axes = local_shapes(
            self._source_tree, self._around, self._s[chosen], NEIGHBOURS, self._threads
        )
        flat = spread[:, 1] > FLAT * spread[:, 0]
        return self._s[chosen[flat]], axes[flat, :, 0]

    def _absolute(self, X: Floats) -> Floats:
        """Express what is left after the start, about the pivot, as a transform."""
        X = X.copy()
        X[:3, :3] = transforms.orthonormal(X[:3, :3])
        return transforms.translation(self._pivot) @ X @ transforms.translation(-self._pivot) @ self.T_start

    def _relative(self, T: Floats) -> Floats:
        """Express a transform as what is left after the start, about the pivot."""
        left = T @ transforms.inverse(self.T_start)
        return transforms.translation(-self._pivot) @ left @ transforms.translation(self._pivot)


def rounds_for(cell: float) -> dict[str, Rounds]:
    """Name the runs of ICP to try on clouds rasterised at ``cell`` metres: from far, and from near.

    Those from far catch starts that are off by metres. Those from near begin at a cell, by which tie points
    may be off: on the rings of single scans, which have fine cells, a farther one leads a good start away.
    """
    scale = max(1.0, cell / FINE_CELL_M)
    far, close = (
        tuple(scale * distance for distance in distances) for distances in (FAR_DISTANCES_M, NEAR_DISTANCES_M)
    )
    first = float(np.clip(cell, close[-1], close[0]))
    return {"far": Rounds((*far, *close)), "near": Rounds((first, close[-1], close[-1]), trim_m=first)}
