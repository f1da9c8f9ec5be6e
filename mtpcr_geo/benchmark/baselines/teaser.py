"""FPFH and TEASER++, through its own Python binding where that is installed (teaserpp_python 1.1.0).

H. Yang, J. Shi and L. Carlone (2020), doi:10.1109/TRO.2020.3033695.

The binding's solution has rotation, translation and scale, and nothing that says whether they mean anything.
Where no two matches agree, its solver stops before it sets them: what stands there then is uninitialised.
That shows in the largest consistent set (the clique) alone, which the solver gives.
"""

from __future__ import annotations

import numpy as np

from mtpcr_geo.benchmark.baselines.fpfh import Features, PrunedFpfhMethod
from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Indices

_FEWEST = 2
"""Members of a clique for which the solver goes on to a transform."""


class FpfhTeaser(PrunedFpfhMethod):
    """Mutual nearest neighbours of FPFH, and TEASER++ without scale.

    Args:
        voxel, icp, max_matches: as for all that prune.
        clique_limit_s: longest search for the largest clique, seconds; after it the largest found counts.
            The library's own limit is an hour, more than a run of the benchmark has.

    """

    def __init__(
        self, voxel: float = 1.0, icp: bool = True, max_matches: int = 5000, clique_limit_s: float = 120.0
    ) -> None:
        super().__init__(voxel, icp, max_matches)
        if clique_limit_s <= 0:
            raise ValueError("clique_limit_s must be above 0")
        self.clique_limit_s = clique_limit_s

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Solve with a noise bound of one voxel, as its authors' example with FPFH and ICP does."""
        import teaserpp_python

        kind = teaserpp_python.RobustRegistrationSolver
        params = kind.Params()
        params.cbar2 = 1.0
        params.noise_bound = self.voxel
        params.estimate_scaling = False
        params.inlier_selection_mode = kind.INLIER_SELECTION_MODE.PMC_EXACT
        params.max_clique_time_limit = self.clique_limit_s
        params.rotation_tim_graph = kind.INLIER_GRAPH_FORMULATION.CHAIN
        params.rotation_estimation_algorithm = kind.ROTATION_ESTIMATION_ALGORITHM.GNC_TLS
        params.rotation_gnc_factor = 1.4
        params.rotation_max_iterations = 10_000
        params.rotation_cost_threshold = 1e-16
        solver = kind(params)
        solver.solve(source.xyz[matches[:, 0]].T, target.xyz[matches[:, 1]].T)
        clique = len(solver.getInlierMaxClique())
        details = {"matches": len(matches), "clique": clique}
        if clique < _FEWEST:
            return Estimate(None, "refused", "no two of its matches agree", details)
        solution = solver.getSolution()
        R = transforms.orthonormal(np.asarray(solution.rotation, np.float64))
        return Estimate(
            transforms.compose(R, np.asarray(solution.translation, np.float64).ravel()),
            details=details | {"translation_inliers": len(solver.getTranslationInliers())},
        )
