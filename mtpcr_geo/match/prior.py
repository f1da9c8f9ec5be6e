"""What is known of a pose beforehand, and how it narrows the search.

A prior restricts where is searched; it is no evidence, and what is found there is judged like anything else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Hypothesis
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.search import Layer, angle_between
from mtpcr_geo.match.terrain import Terrain
from mtpcr_geo.method.images import Channels

Place = Callable[[float], tuple[float, float]]
"""Where a raster's centre comes to lie under a yaw, metres in the target's frame."""


@dataclass(frozen=True)
class Prior:
    """What is known beforehand of the pose: where a point of the source lies, how it is turned, or both.

    Attributes:
        pivot: (2,) the point, in the levelled source's frame, metres.
        place: (2,) where it lies in the levelled target's frame, metres; None if that is not known.
        radius_m: how far from there it may lie.
        yaw: by how much the source is turned, radians; None if that is not known.
        yaw_range: how far it may be turned from there, radians.
        holds: whether what lies beyond is no rival: what was found by a coarser search, and given by nobody,
            tells where to look, and no more.

    """

    pivot: tuple[float, float]
    place: tuple[float, float] | None = None
    radius_m: float = np.inf
    yaw: float | None = None
    yaw_range: float = np.pi
    holds: bool = True

    @classmethod
    def around(
        cls, hypothesis: Hypothesis, pivot: tuple[float, float], radius_m: float, yaw_range: float
    ) -> Prior:
        """Make a prior of a pose that a coarser search found: the pivot lies near where that puts it."""
        pose = pose_of(hypothesis, np.asarray(pivot))
        return cls(pivot, (pose.east, pose.north), radius_m, pose.yaw, yaw_range, holds=False)

    def mirrored(self) -> Prior:
        """Return what to search the mirrored source under: the same place, and every yaw.

        A reflected scene has no yaw that corresponds to the known one; it agrees best by chance where its
        walls run along the target's, wherever that is.
        """
        return replace(self, pivot=(-self.pivot[0], self.pivot[1]), yaw=None, yaw_range=np.pi)

    def yaws(self, step: float) -> Floats:
        """Return the yaws to search, radians, at most ``step`` apart, the known one among them."""
        if self.yaw is None or self.yaw_range >= np.pi:
            count = max(1, round(2 * np.pi / step))
            return np.asarray((self.yaw or 0.0) + np.arange(count) * (2 * np.pi / count), np.float64)
        count = 2 * max(1, int(np.ceil(self.yaw_range / step))) + 1
        return self.yaw + np.linspace(-self.yaw_range, self.yaw_range, count)

    def place_of(self, grid: Grid) -> Place | None:
        """Return where the centre of a raster of the source lies by yaw; None if no place is known."""
        if self.place is None:
            return None
        (east, north), (x, y) = self.place, centre_of(grid) - self.pivot

        def at(yaw: float) -> tuple[float, float]:
            c, s = np.cos(yaw), np.sin(yaw)
            return float(east + c * x - s * y), float(north + s * x + c * y)

        return at

    def pose(self, grid: Grid) -> Pose | None:
        """Return the pose about the centre of a raster of the source; None if no whole pose is known."""
        at = self.place_of(grid)
        return None if at is None or self.yaw is None else Pose(self.yaw, *at(self.yaw))

    def allows(self, pose: Pose, grid: Grid, slack_m: float) -> bool:
        """Return whether a pose lies within what is known.

        Args:
            pose: about the centre of a raster of the source.
            grid: of that raster.
            slack_m: by how much it may lie beyond in place, or at the rim of the raster by its yaw, metres.

        """
        at = self.place_of(grid)
        if at is not None:
            east, north = at(pose.yaw)
            if float(np.hypot(pose.east - east, pose.north - north)) > self.radius_m + slack_m:
                return False
        rim = np.hypot(grid.width, grid.height) * grid.cell / 2
        return self.yaw is None or angle_between(pose.yaw, self.yaw) <= self.yaw_range + slack_m / rim

    def layer(self, source: Grid, target: Layer) -> Layer | None:
        """Return the part of a target's layer that the source can reach; None if that is empty."""
        cut = self._window(source, target.grid)
        if cut is None:
            return None
        grid, rows, columns = cut
        parts = target.channels
        kept = (parts.height[rows, columns], parts.steps[rows, columns], parts.mask[rows, columns])
        return Layer(grid, Channels(*kept))

    def terrain(self, source: Grid, target: Terrain) -> Terrain | None:
        """Return the part of a target's terrain that the source can reach; None if that is empty."""
        cut = self._window(source, target.grid)
        if cut is None:
            return None
        grid, rows, columns = cut
        return Terrain(grid, target.low[rows, columns], target.mask[rows, columns])

    def _window(self, source: Grid, target: Grid) -> tuple[Grid, slice, slice] | None:
        """Cut out of the target's grid what the source reaches under any yaw; two cells more each way."""
        if self.place is None:
            return target, slice(None), slice(None)
        off = float(np.hypot(*(centre_of(source) - self.pivot)))
        half = np.hypot(source.width, source.height) * source.cell / 2
        reach = self.radius_m + off + half + 3 * target.cell
        corners = np.asarray(self.place) + np.array([[-reach, reach], [reach, -reach]])
        (column0, row0), (column1, row1) = target.to_pixel(corners)
        column0, column1 = (int(np.clip(v, 0, target.width)) for v in (np.floor(column0), np.ceil(column1)))
        row0, row1 = (int(np.clip(v, 0, target.height)) for v in (np.floor(row0), np.ceil(row1)))
        if column1 <= column0 or row1 <= row0:
            return None
        rows, columns = slice(row0, row1), slice(column0, column1)
        return target.part(rows, columns), rows, columns
