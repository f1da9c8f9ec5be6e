"""Images of simulated places: band-passed heights of every cloud at several cells, densities, noises."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.train.sites import Points, Site
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.method.bev import make_bev
from mtpcr_geo.method.images import band_image

FINEST_CELL_M, COARSEST_CELL_M = 0.3, 1.6
LEAST_KEPT = 0.08
"""Smallest share of a cloud's points that thinning keeps."""
LEAST_PER_CELL = 1.0
"""Points in a filled cell, on average, below which a cloud is not thinned: a registration takes coarser cells
for so few."""
LARGEST_NOISE_M = 0.08
DRAWS = 6
"""Cells at which each cloud is rasterised."""
CELL_SPREAD = 0.05
"""Natural logarithm of the factor at most by which the cells of the clouds of a site differ in one draw."""


@dataclass(frozen=True)
class View:
    """One image of a cloud.

    Attributes:
        instrument: which made the cloud: "robot" and "tripod" stand on the ground.
        cell: edge of a pixel, metres.
        image: (h, w) uint8.
        filled: (h, w) bool, False where the raster is empty.
        to_pixel: (2, 3) affine map from the site's frame, metres, to (column, row).

    """

    instrument: str
    cell: float
    image: Grey
    filled: NDArray[np.bool_]
    to_pixel: Floats

    @cached_property
    def places(self) -> Floats:
        """Return the (n, 2) places of the filled pixels in the site's frame, metres."""
        rows, columns = np.nonzero(self.filled)
        L = np.linalg.inv(self.to_pixel[:, :2])
        return np.asarray((np.stack([columns, rows], axis=1) - self.to_pixel[:, 2]) @ L.T)

    @property
    def from_ground(self) -> bool:
        """Return whether the instrument stood on the ground."""
        return self.instrument in ("robot", "tripod")


def views_of(site: Site, seed: int = 0, draws: int = DRAWS) -> list[View]:
    """Rasterise each cloud of a site `draws` times: yaw, density and noise drawn anew.

    In each draw all clouds have nearly one cell, as a pair has in a registration.

    Args:
        site: the clouds.
        seed: of the draws.
        draws: for each cloud.

    Returns:
        `draws` views for each cloud.

    """
    # one draw in each part of the range, so that every cloud is seen fine and coarse
    edges = np.linspace(np.log(FINEST_CELL_M), np.log(COARSEST_CELL_M), draws + 1)
    shared = np.random.default_rng([seed, *site.name.encode()])
    cells = [float(shared.uniform(low, high)) for low, high in pairwise(edges)]
    made = []
    for number, (instrument, points) in enumerate(sorted(site.clouds.items())):
        rng = np.random.default_rng([seed, number, *site.name.encode()])
        for middle in cells:
            cell = float(np.exp(middle + rng.uniform(-CELL_SPREAD, CELL_SPREAD)))
            made.append(_view(instrument, points, cell, rng))
    return made


def _view(instrument: str, points: Points, cell: float, rng: np.random.Generator) -> View:
    covered = len(np.unique(np.floor(points[:, :2]).astype(np.int64), axis=0))
    least = LEAST_PER_CELL / (len(points) / covered * cell**2)
    kept = float(np.exp(rng.uniform(np.log(np.clip(least, LEAST_KEPT, 1.0)), 0.0)))
    xyz = points[rng.random(len(points)) < kept].astype(np.float64)
    xyz += rng.normal(0.0, rng.uniform(0.0, LARGEST_NOISE_M), xyz.shape)
    yaw = float(rng.uniform(0.0, 2 * np.pi))
    R = transforms.yaw_matrix(yaw)
    bev = make_bev(xyz @ R.T, cell)
    # metres to (column, row): rows run south
    axes = np.array([[1.0, 0.0], [0.0, -1.0]]) / cell
    offset = np.array([-bev.grid.west, bev.grid.north]) / cell - 0.5
    to_pixel = np.column_stack([axes @ R[:2, :2], offset])
    return View(instrument, cell, band_image(bev), bev.count > 0, to_pixel)
