"""KISS-Matcher, and its pruning and solver on FPFH, through its package on PyPI (kiss-matcher 1.0).

H. Lim and others (2025), arXiv:2409.15615. It prunes matches by the densest core of a graph of their pairwise
consistency (ROBIN) and estimates rotation by graduated non-convexity. It is akin to TEASER++, by some of the
same authors, and not the same: a core holds more wrong matches than TEASER++'s largest clique, and both noise
bounds are held to 1 m (`clamp`), below the size of a voxel that such clouds need.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mtpcr_geo.benchmark.baselines.fpfh import Features, PrunedFpfhMethod
from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices

FEWEST_INLIERS = 5


class KissMatcher:
    """The whole of KISS-Matcher.

    Its authors' examples take a voxel of 2 m for maps and 0.2 to 0.3 m for single scans, and Quatro (which
    keeps the vertical) for all but tilted ones: ``kiss-matcher:voxel=2,quatro=yes``.

    Args:
        voxel: thinning, metres; all its radii grow with it.
        quatro: solve for yaw and shift alone, as for clouds that stand upright.
        clamp: hold both noise bounds to 1 m, as the library does unless told otherwise.

    """

    def __init__(self, voxel: float = 1.0, quatro: bool = False, clamp: bool = True) -> None:
        if voxel <= 0:
            raise ValueError("voxel must be above 0")
        self.voxel, self.quatro, self.clamp = voxel, quatro, clamp

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Match and solve; KISS-Matcher takes no seed."""
        import kiss_matcher
        import small_gicp

        # thinned here, since handing over millions of points one by one would count as its time
        s, t = (
            np.asarray(small_gicp.voxelgrid_sampling(xyz, self.voxel).points())[:, :3]
            for xyz in (source, target)
        )
        config = kiss_matcher.KISSMatcherConfig(
            self.voxel,
            use_voxel_sampling=False,
            use_quatro=self.quatro,
            enable_noise_bound_clamping=self.clamp,
        )
        matcher = kiss_matcher.KISSMatcher(config)
        solution = matcher.estimate(list(s.astype(np.float32)), list(t.astype(np.float32)))
        return _answer(matcher, solution)


class FpfhKissSolver(PrunedFpfhMethod):
    """Mutual nearest neighbours of FPFH, pruned and solved by KISS-Matcher.

    Args:
        voxel, icp, max_matches: as for all that prune.
        clamp: hold both noise bounds to 1 m, as the library does unless told otherwise.

    """

    def __init__(
        self, voxel: float = 1.0, icp: bool = True, max_matches: int = 5000, clamp: bool = True
    ) -> None:
        super().__init__(voxel, icp, max_matches)
        self.clamp = clamp

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Prune the matches by their consistency, and solve for what is left."""
        import kiss_matcher

        config = kiss_matcher.KISSMatcherConfig(self.voxel, enable_noise_bound_clamping=self.clamp)
        matcher = kiss_matcher.KISSMatcher(config)
        solution = matcher.prune_and_solve(
            list(source.xyz[matches[:, 0]].astype(np.float32)),
            list(target.xyz[matches[:, 1]].astype(np.float32)),
        )
        return _answer(matcher, solution)


def _answer(matcher: Any, solution: Any) -> Estimate:
    inliers = int(matcher.get_num_final_inliers())
    details = {"inliers": inliers, "rotation_inliers": int(matcher.get_num_rotation_inliers())}
    if not solution.valid:
        return Estimate(None, "refused", "its solver found nothing", details)
    R = transforms.orthonormal(np.asarray(solution.rotation, np.float64))
    T = transforms.compose(R, np.asarray(solution.translation, np.float64).ravel())
    if inliers < FEWEST_INLIERS:
        return Estimate(T, "doubtful", f"only {inliers} matches agree in the end", details)
    return Estimate(T, details=details)
