"""Poses that a network proposes to the correlation search, where the rasters' own heights do not decide."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from mtpcr_geo.core.arrays import Grey
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.transforms import yaw_of
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.descriptors import Extractor
from mtpcr_geo.match.likelihood import Places, TurnedPlaces, poses_by_likelihood
from mtpcr_geo.match.turning import ZOOM, magnified, places_on_ground, turn_image
from mtpcr_geo.method.bev import coarsen
from mtpcr_geo.method.images import EMPTY_GREY, band_image

TURNS = 8
"""Orientations of the source's image, evenly round the circle: descriptors tolerate half the step between."""
LONGEST_PX = 1400
"""Longest edge of an image that is described; larger rasters are taken at coarser cells."""
COARSEST_CELL_M = 2.0
"""Cell above which nothing is proposed: the network never saw coarser ones."""
PROPOSED = 12


@dataclass
class LearnedProposals:
    """Poses under which a network's descriptors of both rasters agree best.

    Attributes:
        open: makes the extractor, once it is needed; its features must have places.
        workers: orientations described at once.

    """

    open: Callable[[], Extractor]
    workers: int = 1
    _extractor: Extractor | None = field(default=None, init=False, repr=False)
    _target: tuple[Bev, int, Places] | None = field(default=None, init=False, repr=False)

    def poses(self, source: Bev, target: Bev) -> list[Hypothesis]:
        """Propose poses of the source over the target, those first for which most speaks.

        Args:
            source, target: rasters of one cell size, in levelled coordinates.

        Returns:
            Hypotheses whose strength is that of `mtpcr_geo.match.likelihood`; none where the rasters are so
            large that their cells would be too coarse for the network.

        """
        if self._extractor is None:
            self._extractor = self.open()
        longest = max(*source.grid.shape, *target.grid.shape)
        factor = -(-longest // LONGEST_PX)
        if factor * source.grid.cell > COARSEST_CELL_M:
            return []
        zoom = ZOOM if ZOOM * longest <= LONGEST_PX else 1.0
        if self._target is None or self._target[0] is not target or self._target[1] != factor:
            bev = coarsen(target, factor)
            self._target = (
                target,
                factor,
                self._described(magnified(band_image(bev), zoom), zoom, bev.grid, 0.0),
            )
        seen = coarsen(source, factor)
        image = magnified(band_image(seen), zoom)
        turns = [2 * np.pi * k / TURNS for k in range(TURNS)]
        with ThreadPoolExecutor(self.workers) as pool:
            described = list(pool.map(lambda turn: self._described(image, zoom, seen.grid, turn), turns))
        found = poses_by_likelihood(
            [TurnedPlaces(turn, places) for turn, places in zip(turns, described, strict=True)],
            self._target[2],
            most=PROPOSED,
        )
        return [
            Hypothesis(
                yaw_of(one.T[:3, :3]),
                (float(one.T[0, 3]), float(one.T[1, 3])),
                one.strength,
                strength=one.strength,
            )
            for one in found
        ]

    def _described(self, image: Grey, zoom: float, grid: Grid, turn: float) -> Places:
        assert self._extractor is not None
        turned, back = turn_image(image, turn, EMPTY_GREY)
        places = self._extractor.extract(turned, EMPTY_GREY).places
        if places is None:
            raise ValueError("the extractor describes keypoints alone")
        return places_on_ground(places, back, zoom, grid)
