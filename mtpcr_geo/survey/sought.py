"""A source on its way through the levels of a survey, and the levels of a window of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.pyramid import Pyramid
from mtpcr_geo.match.search import Layer
from mtpcr_geo.match.terrain import Terrain


@dataclass(frozen=True, eq=False)
class Sought:
    """One source, or its mirror image, on the way through the levels.

    Attributes:
        bev: its height raster at the survey's finest cell, levelled.
        prior: what is known of its pose.
        ground: its bare ground in coarse cells.
        layers: its channels by level, as far as they were made.

    """

    bev: Bev
    prior: Prior | None
    ground: Terrain
    layers: dict[int, Layer] = field(default_factory=dict)

    def over(self, target: Bev, shared: Pyramid | None = None) -> Pyramid:
        """Return the levels of this source and a window of the survey; its own channels are made once."""
        return Window(self.bev, target, self.layers, shared)

    @property
    def grid(self) -> Grid:
        """Grid of the raster."""
        return self.bev.grid

    @property
    def reach_m(self) -> float:
        """How far the raster reaches from its middle under any yaw, metres."""
        return float(np.hypot(*self.grid.shape)) * self.grid.cell / 2

    def pose_at(self, pose: Pose, of: Grid, to: Grid) -> Pose:
        """Express a pose about the centre of one grid of this source about that of another one."""
        return pose_of(pose.hypothesis(centre_of(of)), centre_of(to))


class Window(Pyramid):
    """The levels of a source, which are kept from window to window, and of a window of the survey."""

    def __init__(self, source: Bev, target: Bev, layers: dict[int, Layer], shared: Pyramid | None) -> None:
        super().__init__(source, target, shared)
        self._source = layers
