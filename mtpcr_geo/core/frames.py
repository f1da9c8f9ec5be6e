"""The metric work frame, and the exact conversion between it and the coordinates of a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mtpcr_geo.core.arrays import ComparesArrays, Floats
from mtpcr_geo.core.errors import CrsError
from mtpcr_geo.core.scanner import PLAIN, Scanner, rotation_of

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


Vertical = Literal["refuse", "assume-same", "estimate"]
"""What to do where two clouds' heights have different or unknown vertical datums."""


@dataclass(frozen=True, eq=False)
class WorkFrame(ComparesArrays):
    """The frame of all computation: a projected metric CRS, shifted to an integer origin.

    Attributes:
        crs: the projected metric CRS, or None for a local frame in metres.
        origin: (3,) whole metres, subtracted from CRS coordinates.
        output: the link from the target's work coordinates to another CRS, where one was asked for.

    """

    crs: CRS | None
    origin: Floats
    output: FrameLink | None = None


@dataclass(frozen=True)
class OperationReport:
    """How a file's coordinates come to the work frame, and what had to be assumed for it.

    Attributes:
        operation: name of the coordinate operation, as in the EPSG registry.
        accuracy_m: its accuracy in metres, or None where nobody stated one.
        grids: names of the grid files that it uses.
        heights: what the file's heights refer to.
        vertical: what was to be done with different or unknown vertical datums.
        height_notes: how heights of different or unknown datums were taken, a sentence each.
        unit_notes: what had to be assumed of units and scale, a sentence each.
        grid_scale: least and greatest length, on the map, of a metre on the ground; None where not known.

    """

    operation: str = "units only"
    accuracy_m: float | None = 0.0
    grids: tuple[str, ...] = ()
    heights: str = "heights of no stated datum"
    vertical: Vertical = "assume-same"
    height_notes: tuple[str, ...] = ()
    unit_notes: tuple[str, ...] = ()
    grid_scale: tuple[float, float] | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """All that had to be assumed, a sentence each."""
        return (*self.unit_notes, *self.height_notes)

    def as_dict(self) -> dict[str, Any]:
        """Return what goes into ``transform.json`` and ``run.json``; a grid scale only where it is known."""
        known: dict[str, Any] = {
            "operation": self.operation,
            "accuracy_m": self.accuracy_m,
            "grids": list(self.grids),
            "heights": self.heights,
            "vertical": self.vertical,
            "notes": list(self.notes),
        }
        return known if self.grid_scale is None else known | {"grid_scale": list(self.grid_scale)}


@dataclass(frozen=True, eq=False)
class FrameLink(ComparesArrays):
    """The conversion between a file's coordinates and work coordinates of its side.

    File coordinates go through a PROJ pipeline where the CRSs differ, are turned by quarters where another
    axis is up, are multiplied by a factor where the units differ, and are shifted by the origin.

    Attributes:
        file_crs: the CRS of the file's coordinates, or None for local.
        origin: (3,) whole metres near the cloud, subtracted to come to work coordinates.
        factor: (3,) metres a unit, applied after the pipeline.
        pipeline: PROJ pipeline from the file's CRS to the work frame's, or None.
        bounds: (2, 3) file coordinates in which the link is used; needed with a pipeline only.
        report: the operation by name, its accuracy and grids, and what had to be assumed.
        georeferenced: whether the file's CRS is tied to the earth, so that its vertical and its place are
            known. False for local coordinates, and for an engineering CRS, which has a name but no place.
        scanner: unit and axes that are declared for local coordinates; the unit is in `factor` already.

    """

    file_crs: CRS | None
    origin: Floats
    factor: Floats = field(default_factory=lambda: np.ones(3))
    pipeline: str | None = None
    bounds: Floats | None = None
    report: OperationReport = field(default_factory=OperationReport)
    georeferenced: bool = False
    scanner: Scanner = PLAIN

    def metric(self, xyz: Floats) -> Floats:
        """Take (n, 3) coordinates, past the pipeline, to metres with z up, not shifted."""
        turned = self._turned(xyz)
        return turned if self._is_metric else np.asarray(turned * self.factor)

    def to_work(self, xyz: Floats) -> Floats:
        """Take (n, 3) file coordinates to (n, 3) work coordinates in metres.

        Raises:
            CrsError: if the pipeline cannot take a point there.

        """
        xyz = np.asarray(xyz, np.float64)
        if self.pipeline is not None:
            xyz = run_pipeline(self.pipeline, xyz)
        return np.asarray(self.metric(xyz) - self.origin)

    def to_file(self, xyz: Floats) -> Floats:
        """Take (n, 3) work coordinates in metres to (n, 3) file coordinates.

        Raises:
            CrsError: if the pipeline cannot take a point back.

        """
        xyz = np.asarray(xyz, np.float64) + self.origin
        if not self._is_metric:
            xyz /= self.factor
        if self.scanner.axes != "z-up":
            xyz = xyz @ rotation_of(self.scanner.axes)
        if self.pipeline is not None:
            xyz = run_pipeline(self.pipeline, xyz, inverse=True)
        return np.asarray(xyz)

    @property
    def _is_metric(self) -> bool:
        return bool((self.factor == 1.0).all())

    def _turned(self, xyz: Floats) -> Floats:
        return xyz if self.scanner.axes == "z-up" else xyz @ rotation_of(self.scanner.axes).T

    @property
    def T_work_file(self) -> Floats:
        """4x4 from file to work coordinates; with a pipeline, the best fit within the bounds."""
        return self._fit[0]

    @property
    def T_file_work(self) -> Floats:
        """4x4 from work to file coordinates; with a pipeline, the best fit within the bounds."""
        if self.pipeline is None:
            T = np.eye(4)
            T[:3, :3] = rotation_of(self.scanner.axes).T / self.factor
            T[:3, 3] = rotation_of(self.scanner.axes).T @ (self.origin / self.factor)
            return T
        return np.asarray(np.linalg.inv(self._fit[0]))

    @property
    def departure(self) -> float:
        """How far, in metres, the 4x4 is from the link within its bounds; 0 where it is exact."""
        return self._fit[1]

    @cached_property
    def _fit(self) -> tuple[Floats, float]:
        if self.pipeline is None:
            T = np.eye(4)
            T[:3, :3] = rotation_of(self.scanner.axes) * self.factor[:, None]
            T[:3, 3] = -self.origin
            return T, 0.0
        if self.bounds is None:
            raise CrsError("a link through a PROJ pipeline needs the bounds within which it holds")
        return fit_affine(self.to_work, self.bounds)


@lru_cache(maxsize=32)
def _transformer(pipeline: str) -> Transformer:
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        return Transformer.from_pipeline(pipeline)
    except (ProjError, UnicodeEncodeError) as error:  # half a character, as JSON may hold, is no text
        raise CrsError(
            f"PROJ cannot run the pipeline {pipeline!r} ({error}); is a grid missing on this machine?"
        ) from error


def run_pipeline(pipeline: str, xyz: Floats, inverse: bool = False) -> Floats:
    """Take (n, 3) coordinates through a PROJ pipeline, or back.

    Raises:
        CrsError: if PROJ does not know the pipeline, or it is not defined at some point.

    """
    from pyproj.enums import TransformDirection
    from pyproj.exceptions import ProjError

    direction = TransformDirection.INVERSE if inverse else TransformDirection.FORWARD
    # pyproj tries to take an array of one as a number, which numpy warns of; a list of one it does not
    single = len(xyz) == 1
    x, y, z = (list(axis) if single else np.array(axis, np.float64) for axis in xyz.T)
    try:
        moved = _transformer(pipeline).transform(x, y, z, direction=direction, errcheck=False)
    except ProjError as error:
        raise CrsError(f"PROJ cannot run the pipeline {pipeline!r}: {error}") from error
    result = np.column_stack(moved)
    bad = ~np.isfinite(result).all(axis=1) & np.isfinite(xyz).all(axis=1)
    if bad.any():
        place = ", ".join(f"{value:.6f}" for value in xyz[int(bad.argmax())])
        raise CrsError(
            f"{int(bad.sum())} points lie outside the area of the coordinate operation, the first at "
            f"({place}); check the CRS against the coordinates"
        )
    return result


def fit_affine(move: Callable[[Floats], Floats], bounds: Floats, steps: int = 5) -> tuple[Floats, float]:
    """Fit a 4x4 affine transform to a smooth one, on a grid of points within bounds.

    Args:
        move: takes (n, 3) coordinates to (n, 3) others.
        bounds: (2, 3) lowest and highest coordinates.
        steps: grid points an axis.

    Returns:
        The 4x4, and the largest distance on the grid by which it is off, in units of the result.

    """
    low, high = np.asarray(bounds, np.float64)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    axis = np.linspace(-1.0, 1.0, steps)
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    moved = move(middle + unit * half)
    centre = moved.mean(axis=0)
    # on a symmetric grid the columns are orthogonal: no solver is needed, and no precision is lost
    A = ((moved - centre).T @ unit) / (unit**2).sum(axis=0)
    worst = float(np.linalg.norm(moved - centre - unit @ A.T, axis=1).max())
    T = np.eye(4)
    T[:3, :3] = A / half
    T[:3, 3] = centre - T[:3, :3] @ middle
    return T, worst


def box_points(bounds: Floats, steps: int = 5) -> Floats:
    """Return a grid of points over a box, (steps**3, 3), its corners among them."""
    axes = [np.linspace(low, high, steps) for low, high in np.asarray(bounds).T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
