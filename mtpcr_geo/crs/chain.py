"""The whole conversion of a point: source file, work frame, rigid transform, work frame, target file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import ComparesArrays, Floats
from mtpcr_geo.core.frames import FrameLink, box_points, fit_affine

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.types import Pair

_UNITS, _DEGREES = 10.0, 1e-4  # steps about a place, of some ten metres, over which a projection is linear


@dataclass(frozen=True, eq=False)
class TransformChain(ComparesArrays):
    """A registration's result, ready to move points either way at full precision far from the origin.

    Attributes:
        source: between source file coordinates and source work coordinates.
        target: between target work coordinates and those of the target's file, or of the CRS asked for.
        T_target_source: 4x4 rigid transform in work coordinates, metres.
        pivot: (3,) centroid of the source, in source file coordinates.
        bounds: (2, 3) of the source, in source file coordinates.
        source_stated: CRS that the source's file states, or None; another one may have been given by option.
        target_stated: likewise of the target; None where the result is in another CRS, which was asked for.

    """

    source: FrameLink
    target: FrameLink
    T_target_source: Floats
    pivot: Floats
    bounds: Floats
    source_stated: CRS | None = None
    target_stated: CRS | None = None

    @classmethod
    def of(cls, pair: Pair) -> TransformChain:
        """Return the chain of a solved pair.

        Raises:
            ValueError: if the pair has no transform yet.

        """
        if pair.T_target_source is None:
            raise ValueError("the pair has no transform yet")
        link, cloud = pair.source.link, pair.source.cloud
        sample = pair.source.sample
        centre = transforms.centroid(sample) if len(sample) else np.zeros(3)
        return cls(
            source=link,
            target=pair.frame.output or pair.target.link,
            T_target_source=np.asarray(pair.T_target_source, np.float64),
            pivot=link.to_file(centre[None])[0],
            bounds=np.stack([cloud.minimum, cloud.maximum]).astype(np.float64)
            if pair.source.bounds is None
            else pair.source.bounds,
            source_stated=cloud.crs,
            target_stated=None if pair.frame.output is not None else pair.target.cloud.crs,
        )

    def forward(self, xyz: Floats) -> Floats:
        """Take (n, 3) source file coordinates to (n, 3) target file coordinates."""
        return self._moved(
            lambda some: self.target.to_file(
                transforms.apply(self.T_target_source, self.source.to_work(some))
            ),
            xyz,
        )

    def inverse(self, xyz: Floats) -> Floats:
        """Take (n, 3) target file coordinates to (n, 3) source file coordinates."""
        T_source_target = self.T_source_target
        return self._moved(
            lambda some: self.source.to_file(transforms.apply(T_source_target, self.target.to_work(some))),
            xyz,
        )

    def motion(self, inverse: bool = False) -> Motion:
        """Return the chain as a move of points, forward or inverse, that tells how vectors turn with them."""
        return Motion(self, inverse)

    def _moved(self, move: Callable[[Floats], Floats], xyz: Floats) -> Floats:
        # PROJ takes its time to begin
        return transforms.by_blocks(move, np.asarray(xyz, np.float64)) if self.is_affine else move(xyz)

    @property
    def shift_m(self) -> Floats | None:
        """(3,) metres by which the pivot leaves the place that its CRS claims; None for a local source."""
        if not (self.source.georeferenced and self.target.georeferenced):
            return None
        before = self.source.to_work(self.pivot[None])
        after = transforms.apply(self.T_target_source, before)
        return np.asarray((after - before)[0] + (self.target.origin - self.source.origin))

    @property
    def vertical_offset_m(self) -> float | None:
        """Metres added to the source's heights, where that was to be estimated; None elsewhere."""
        shift = self.shift_m
        if shift is None or self.source.report.vertical != "estimate":
            return None
        return float(shift[2])

    @property
    def T_source_target(self) -> Floats:
        """4x4 in work coordinates, metres, from target to source."""
        return transforms.inverse(self.T_target_source)

    @property
    def is_affine(self) -> bool:
        """Return whether one 4x4 on file coordinates is exactly the chain."""
        return self.source.pipeline is None and self.target.pipeline is None

    @property
    def T_file(self) -> Floats:
        """4x4 from source to target file coordinates; the best fit within the bounds if not affine."""
        if self.is_affine:
            return self.target.T_file_work @ self.T_target_source @ self.source.T_work_file
        return fit_affine(self.forward, self.bounds)[0]

    @property
    def departure(self) -> float:
        """How far in metres the 4x4 is from the chain, at most, within the source's bounds; 0 if affine."""
        if self.is_affine:
            return 0.0
        T = self.T_file
        corners = box_points(self.bounds)
        chained = self.target.to_work(self.forward(corners))
        direct = self.target.to_work(transforms.apply(T, corners))
        return float(np.linalg.norm(chained - direct, axis=1).max())

    @property
    def rotation_in_files(self) -> Floats:
        """(3, 3) linear part of the 4x4, which turns about `pivot` without any far origin in the sums."""
        return self.T_file[:3, :3]


class Motion:
    """A move of points by a chain; vectors that points carry turn as the place of the pivot does.

    Args:
        chain: from source to target.
        inverse: go from target to source.

    """

    def __init__(self, chain: TransformChain, inverse: bool = False) -> None:
        self.chain, self.inverse = chain, inverse

    def __call__(self, xyz: Floats) -> Floats:
        """Take (n, 3) file coordinates of one side to (n, 3) of the other."""
        return self.chain.inverse(xyz) if self.inverse else self.chain.forward(xyz)

    @cached_property
    def rotation(self) -> Floats:
        """(3, 3) for vectors of metric length along the axes of the files, such as normals."""
        source, target = (_nearest_rotation(linear) for linear in self._linear_parts)
        R = target.T @ self.chain.T_target_source[:3, :3] @ source
        return np.asarray(R.T if self.inverse else R)

    @cached_property
    def linear(self) -> Floats:
        """(3, 3) for vectors in units of the files' coordinates."""
        source, target = self._linear_parts
        A = np.linalg.solve(target, self.chain.T_target_source[:3, :3] @ source)
        return np.asarray(np.linalg.inv(A) if self.inverse else A)

    @cached_property
    def _linear_parts(self) -> tuple[Floats, Floats]:
        """From file to work coordinates, at the pivot, of source and target."""
        pivot = self.chain.pivot
        return (
            _linear_part(self.chain.source, pivot),
            _linear_part(self.chain.target, self.chain.forward(pivot[None])[0]),
        )


def _linear_part(link: FrameLink, at: Floats) -> Floats:
    """Return the (3, 3) linear part from file to work coordinates, about a point (3,) of the file."""
    if link.pipeline is None:
        return link.T_work_file[:3, :3]
    degrees = link.file_crs is not None and link.file_crs.is_geographic
    steps = np.diag([_DEGREES, _DEGREES, _UNITS] if degrees else [_UNITS] * 3)
    ends = link.to_work(np.concatenate([at + steps, at - steps]))
    return np.asarray((ends[:3] - ends[3:]).T / (2 * np.diag(steps)))


def _nearest_rotation(linear: Floats) -> Floats:
    """Return the rotation next to a (3, 3) linear part, whatever the units of its axes."""
    u, _, vt = np.linalg.svd(linear / np.linalg.norm(linear, axis=0))
    return np.asarray(u @ vt)
