"""KISS-Matcher, and its pruning and solver on FPFH: what TEASER++ does, with libraries that pip has.

KISS-Matcher: H. Lim and others (2025), arXiv:2409.15615. Its solver prunes matches by a graph of pairwise
consistency and estimates rotation by graduated non-convexity, like TEASER++ (H. Yang, J. Shi and
L. Carlone, 2020, doi:10.1109/TRO.2020.3033695).
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

    Args:
        voxel: thinning, metres; all its radii grow with it.

    """

    def __init__(self, voxel: float = 1.0) -> None:
        if voxel <= 0:
            raise ValueError("voxel must be above 0")
        self.voxel = voxel

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Match and solve; KISS-Matcher takes no seed."""
        import kiss_matcher
        import small_gicp

        # thinned here, since handing over millions of points one by one would count as its time
        s, t = (
            np.asarray(small_gicp.voxelgrid_sampling(xyz, self.voxel).points())[:, :3]
            for xyz in (source, target)
        )
        config = kiss_matcher.KISSMatcherConfig(self.voxel, use_voxel_sampling=False)
        matcher = kiss_matcher.KISSMatcher(config)
        solution = matcher.estimate(list(s.astype(np.float32)), list(t.astype(np.float32)))
        return _answer(matcher, solution)


class FpfhGnc(PrunedFpfhMethod):
    """Mutual nearest neighbours of FPFH, pruned and solved in TEASER's style."""

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Prune the matches by their consistency, and solve for what is left."""
        import kiss_matcher

        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(self.voxel))
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
