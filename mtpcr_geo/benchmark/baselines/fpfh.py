"""Fast point feature histograms and what makes a transform of them, through Open3D.

FPFH: R. B. Rusu, N. Blodow and M. Beetz (2009), doi:10.1109/ROBOT.2009.5152473. Radii follow Open3D's own
examples: normals within 2 voxels, features within 5.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.baselines.open3d import import_open3d
from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices

_FEWEST_MATCHES = 3
_ROWS, _COLUMNS = 512, 2048


@dataclass(frozen=True)
class Features:
    """A thinned cloud with its features, as Open3D's objects."""

    cloud: Any
    fpfh: Any

    @property
    def xyz(self) -> Floats:
        """The thinned points, (n, 3) metres."""
        return np.asarray(self.cloud.points)


def features(
    xyz: Floats, voxel: float, *, normal_radius: float = 2.0, feature_radius: float = 5.0
) -> Features:
    """Thin a cloud and describe its points.

    Args:
        xyz: (n, 3) metres.
        voxel: edge of the voxels that thin it, metres.
        normal_radius: radius of the neighbours that give a normal, in voxels.
        feature_radius: radius of the neighbours that a feature describes, in voxels.

    """
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(xyz)))
    cloud = cloud.voxel_down_sample(voxel)
    near = o3d.geometry.KDTreeSearchParamHybrid
    cloud.estimate_normals(near(radius=normal_radius * voxel, max_nn=30))
    # all normals to one side: up, which both views of a surface share
    cloud.orient_normals_to_align_with_direction(np.array([0.0, 0.0, 1.0]))
    fpfh = o3d.pipelines.registration.compute_fpfh_feature(
        cloud, near(radius=feature_radius * voxel, max_nn=100)
    )
    return Features(cloud, fpfh)


def mutual_matches(source: Features, target: Features) -> Indices:
    """Return (n, 2) numbers of source and target points that are each other's nearest in feature space."""
    # all against all: trees gain nothing in 33 dimensions, and Open3D's took three times as long
    a, b = (np.asarray(one.fpfh.data, np.float32).T for one in (source, target))
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    there, back = _nearest_both_ways(a, b)
    mutual = np.flatnonzero(back[there] == np.arange(len(a)))
    return np.stack([mutual, there[mutual]], axis=1)


def _nearest_both_ways(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[Indices, Indices]:
    """Return each row's nearest in the other array, by blocks of distances that stay in the cache."""
    one_a, one_b = (np.ones((len(x), 1), np.float32) for x in (a, b))
    # -|a - b|^2 / 2 as one product
    long_a = np.hstack([a, one_a * (a * a).sum(axis=1, keepdims=True) / -2, one_a])
    long_b = np.hstack([b, one_b, one_b * (b * b).sum(axis=1, keepdims=True) / -2])
    best_a, best_b = (np.full(len(x), -np.inf, np.float32) for x in (a, b))
    there, back = np.zeros(len(a), np.int64), np.zeros(len(b), np.int64)
    for i in range(0, len(a), _ROWS):
        for j in range(0, len(b), _COLUMNS):
            near = long_a[i : i + _ROWS] @ long_b[j : j + _COLUMNS].T
            for axis, best, index, own, other in ((1, best_a, there, i, j), (0, best_b, back, j, i)):
                most = near.max(axis=axis)
                better = np.flatnonzero(most > best[own : own + len(most)])
                if len(better):
                    found = near.take(better, axis=1 - axis).argmax(axis=axis)
                    index[own + better], best[own + better] = other + found, most[better]
    return there, back


def sample_matches(matches: Indices, max_matches: int, seed: int) -> Indices:
    """Draw at most ``max_matches`` of the matches, in their order."""
    if len(matches) <= max_matches:
        return matches
    chosen = np.random.default_rng(seed).choice(len(matches), max_matches, replace=False)
    return matches[np.sort(chosen)]


def best_rigid(source: Floats, target: Floats) -> Floats:
    """Fit a rigid transform to matches by least squares (S. Umeyama, 1991, without scale).

    Args:
        source, target: (n, 3) matching points.

    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - b).T @ (source - a))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return transforms.compose(R, b - R @ a)


class FpfhMethod(ABC):
    """What the methods on FPFH share.

    Args:
        voxel: thinning, metres; all radii grow with it.
        icp: whether point-to-point ICP follows, its correspondences up to 1.5 voxels long.

    Attributes:
        max_matches: largest number of matches used, drawn at random; all if None.

    """

    max_matches: int | None = None

    def __init__(self, voxel: float = 1.0, icp: bool = True) -> None:
        if voxel <= 0:
            raise ValueError("voxel must be above 0")
        self.voxel, self.icp = voxel, icp

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Match features and solve."""
        o3d = import_open3d()
        o3d.utility.random.seed(seed)
        s, t = features(source, self.voxel), features(target, self.voxel)
        matches = mutual_matches(s, t)
        if len(matches) < _FEWEST_MATCHES:
            return Estimate(None, "refused", f"only {len(matches)} matches")
        if self.max_matches is not None:
            matches = sample_matches(matches, self.max_matches, seed)
        answer = self.solve(s, t, matches, seed)
        if answer.T_target_source is None or not self.icp:
            return answer
        kit = o3d.pipelines.registration
        refined = kit.registration_icp(
            s.cloud,
            t.cloud,
            1.5 * self.voxel,
            answer.T_target_source,
            kit.TransformationEstimationPointToPoint(),
            kit.ICPConvergenceCriteria(max_iteration=100),
        )
        details = answer.details | {"icp_fitness": float(refined.fitness)}
        return Estimate(np.array(refined.transformation), answer.verdict, answer.reason, details)

    @abstractmethod
    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Find the transform from features and their (n, 2) mutual matches."""


class PrunedFpfhMethod(FpfhMethod):
    """What the methods share that prune matches by a graph of their consistency.

    Args:
        voxel, icp: as for all.
        max_matches: largest number of matches used, as KISS-Matcher has it; the graph grows with the square.

    """

    def __init__(self, voxel: float = 1.0, icp: bool = True, max_matches: int = 5000) -> None:
        super().__init__(voxel, icp)
        self.max_matches = max_matches


class FpfhSvd(FpfhMethod):
    """Mutual nearest neighbours of FPFH, and one least-squares fit to all of them."""

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Fit to every match, right or wrong."""
        T = best_rigid(source.xyz[matches[:, 0]], target.xyz[matches[:, 1]])
        return Estimate(T, details={"matches": len(matches)})


class FpfhRansac(FpfhMethod):
    """FPFH and RANSAC as in Open3D.

    Args:
        voxel, icp: as for all.
        iterations: largest number of samples.

    """

    def __init__(self, voxel: float = 1.0, icp: bool = True, iterations: int = 1_000_000) -> None:
        super().__init__(voxel, icp)
        self.iterations = iterations

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Draw matches until the confidence is 0.999."""
        o3d = import_open3d()
        kit = o3d.pipelines.registration
        longest = 1.5 * self.voxel
        found = kit.registration_ransac_based_on_correspondence(
            source.cloud,
            target.cloud,
            o3d.utility.Vector2iVector(matches.astype(np.int32)),
            longest,
            kit.TransformationEstimationPointToPoint(False),
            3,
            [
                kit.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                kit.CorrespondenceCheckerBasedOnDistance(longest),
            ],
            kit.RANSACConvergenceCriteria(self.iterations, 0.999),
        )
        if found.fitness == 0:
            return Estimate(None, "refused", "no sample agreed with anything")
        return Estimate(np.array(found.transformation), details={"fitness": float(found.fitness)})


class FpfhFgr(FpfhMethod):
    """FPFH and fast global registration: Q.-Y. Zhou, J. Park and V. Koltun (2016)."""

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Minimise a robust cost over all matches at once."""
        o3d = import_open3d()
        kit = o3d.pipelines.registration
        found = kit.registration_fgr_based_on_correspondence(
            source.cloud,
            target.cloud,
            o3d.utility.Vector2iVector(matches.astype(np.int32)),
            kit.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * self.voxel),
        )
        return Estimate(np.array(found.transformation), details={"fitness": float(found.fitness)})
