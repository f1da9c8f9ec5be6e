"""Point-to-point ICP from where the clouds stand: the baseline that any global method must beat."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core.arrays import Floats


class PointToPointIcp:
    """ICP after P. J. Besl and N. D. McKay (1992), doi:10.1109/34.121791, with small_gicp.

    Args:
        voxel: thinning, metres.
        max_correspondence_distance: longest distance between matched points, metres.
        max_iterations: of the fit.

    """

    def __init__(
        self, voxel: float = 1.0, max_correspondence_distance: float = 10.0, max_iterations: int = 100
    ) -> None:
        self.voxel, self.max_iterations = voxel, max_iterations
        self.max_correspondence_distance = max_correspondence_distance

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Iterate from the identity; the seed is not used."""
        import small_gicp

        result = small_gicp.align(
            target,
            source,
            registration_type="ICP",
            downsampling_resolution=self.voxel,
            max_correspondence_distance=self.max_correspondence_distance,
            max_iterations=self.max_iterations,
            num_threads=1,
        )
        return Estimate(
            np.array(result.T_target_source, np.float64),
            details={"iterations": int(result.iterations), "inliers": int(result.num_inliers)},
        )
