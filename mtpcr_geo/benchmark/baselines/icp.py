"""Point-to-point ICP from where the clouds stand: the floor that any global method must clear."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.benchmark.methods import Estimate
from mtpcr_geo.core.arrays import Floats


class PointToPointIcp:
    """ICP after P. J. Besl and N. D. McKay (1992), doi:10.1109/34.121791, with small_gicp.

    Args:
        voxel: thinning, metres.
        reach: farthest correspondence, metres.
        iterations: at most.

    """

    def __init__(self, voxel: float = 1.0, reach: float = 10.0, iterations: int = 100) -> None:
        self.voxel, self.reach, self.iterations = voxel, reach, iterations

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Iterate from the identity; the seed is not used."""
        import small_gicp

        result = small_gicp.align(
            target,
            source,
            registration_type="ICP",
            downsampling_resolution=self.voxel,
            max_correspondence_distance=self.reach,
            max_iterations=self.iterations,
            num_threads=1,
        )
        return Estimate(
            np.array(result.T_target_source, np.float64),
            details={"iterations": int(result.iterations), "inliers": int(result.num_inliers)},
        )
