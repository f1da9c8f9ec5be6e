"""The levels of the search: both rasters' channels at every cell size, and which sizes are searched."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.types import Bev
from mtpcr_geo.match.search import Layer
from mtpcr_geo.method.bev import coarsen
from mtpcr_geo.method.images import channels

COARSEST_SEARCH_M = 8.0
FEWEST_ACROSS = 40
"""Cells along the smaller raster's longer side that the coarsest level of the search leaves at least."""
LARGEST_SEARCH = 840
"""Cells along the larger raster and across the smaller together up to which a level is searched over all yaws
in a few seconds."""
LEVELS = 3


@dataclass(frozen=True)
class Level:
    """One level of a search.

    Attributes:
        factor: its cell as a multiple of the finest.
        cell_m: its cell, metres.
        scores: of the hypotheses it proposed.

    """

    factor: int
    cell_m: float
    scores: tuple[float, ...]


class Pyramid:
    """Both rasters' channels at every cell size asked for, made once."""

    def __init__(self, source: Bev, target: Bev, shared: Pyramid | None = None) -> None:
        self.source, self.target = source, target
        self._source: dict[int, Layer] = {}
        # a second source against the same target finds the target's channels made
        self._target: dict[int, Layer] = {} if shared is None else shared._target

    def at(self, factor: int) -> tuple[Layer, Layer]:
        """Return source and target layers at ``factor`` times the finest cell."""
        return self._layer(self.source, self._source, factor), self._layer(self.target, self._target, factor)

    def prepare(self, factors: Iterable[int], threads: Executor) -> None:
        """Make the layers of several levels at once, so that threads that need them do not each make them."""
        sides = ((self.source, self._source), (self.target, self._target))
        wanted = [(bev, layers, factor) for factor in factors for bev, layers in sides]
        for done in [threads.submit(self._layer, *one) for one in wanted]:
            done.result()

    def _layer(self, bev: Bev, layers: dict[int, Layer], factor: int) -> Layer:
        if factor not in layers:
            coarse = coarsen(bev, factor)
            layers[factor] = Layer(coarse.grid, channels(coarse))
        return layers[factor]


def search_factors(source: Bev, target: Bev) -> list[int]:
    """Choose the levels of the global search, coarsest first, as multiples of the finest cell.

    The coarsest leaves a few dozen cells along the smaller raster, each next one has half its cells, down to
    the finest that can be searched over all yaws in about two seconds.
    """
    cell = source.grid.cell
    longest = max(max(bev.grid.shape) for bev in (source, target))
    shortest = min(max(bev.grid.shape) for bev in (source, target))
    wanted = max(min(shortest / FEWEST_ACROSS, COARSEST_SEARCH_M / cell), 1.0)
    across = min(float(np.hypot(*bev.grid.shape)) for bev in (source, target))
    affordable = max(1, int(np.ceil((longest + across) / LARGEST_SEARCH)))
    factors: list[int] = []
    for _ in range(LEVELS):
        factor = max(round(wanted), affordable)
        if factor not in factors:
            factors.append(factor)
        wanted = max(wanted / 2.0, 1.0)
    return factors
