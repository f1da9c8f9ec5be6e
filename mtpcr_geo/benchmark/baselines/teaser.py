"""FPFH and TEASER++, through its own Python binding where that is installed.

H. Yang, J. Shi and L. Carlone (2020), doi:10.1109/TRO.2020.3033695.
"""

from __future__ import annotations

import numpy as np

from mtpcr_geo.benchmark.baselines.fpfh import Features, PrunedFpfhMethod
from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Indices


class FpfhTeaser(PrunedFpfhMethod):
    """Mutual nearest neighbours of FPFH, and TEASER++ without scale."""

    def solve(self, source: Features, target: Features, matches: Indices, seed: int) -> Estimate:
        """Solve with a noise bound of one voxel, as its authors' example does."""
        import teaserpp_python

        params = teaserpp_python.RobustRegistrationSolver.Params()
        params.cbar2 = 1.0
        params.noise_bound = self.voxel
        params.estimate_scaling = False
        params.rotation_estimation_algorithm = (
            teaserpp_python.RobustRegistrationSolver.ROTATION_ESTIMATION_ALGORITHM.GNC_TLS
        )
        params.rotation_gnc_factor = 1.4
        params.rotation_max_iterations = 100
        params.rotation_cost_threshold = 1e-12
        solver = teaserpp_python.RobustRegistrationSolver(params)
        solver.solve(source.xyz[matches[:, 0]].T, target.xyz[matches[:, 1]].T)
        solution = solver.getSolution()
        if not solution.valid:
            return Estimate(None, "refused", "its solver found nothing", {"matches": len(matches)})
        T = transforms.compose(np.asarray(solution.rotation), np.asarray(solution.translation).ravel())
        return Estimate(T, details={"matches": len(matches)})
