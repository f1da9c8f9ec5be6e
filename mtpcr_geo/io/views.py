"""Clouds seen through something: cropped, cut short, moved. Nothing is held; points stream through."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import CrsError
from mtpcr_geo.core.types import Pair
from mtpcr_geo.crs import TransformChain
from mtpcr_geo.io.directions import turned_columns
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.las import xyz_of as placed_xyz

if TYPE_CHECKING:
    import laspy
    from pyproj import CRS

Floats = NDArray[np.float64]
Box = tuple[tuple[float, float], ...]

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = rf"\[\s*({_NUMBER})\s*,\s*({_NUMBER})\s*\]"
# compiled where it is used first, which takes longer than reading the rest of this module
_BOUNDS = rf"\(\s*{_RANGE}(?:\s*,\s*{_RANGE}){{1,2}}\s*\)\Z"


def parse_bounds(text: str) -> Box:
    """Read PDAL's bounds ``([xmin, xmax], [ymin, ymax])``, with or without ``[zmin, zmax]``.

    Raises:
        ValueError: if it is none.

    """
    text = text.strip()
    if not re.match(_BOUNDS, text):
        raise ValueError('bounds are written "([xmin, xmax], [ymin, ymax])", with [zmin, zmax] for height')
    box = tuple((float(low), float(high)) for low, high in re.findall(_RANGE, text))
    if any(low > high for low, high in box):
        raise ValueError("a minimum of the bounds is above its maximum")
    return box


def xyz_of(table: PointTable) -> Floats:
    """Return the (n, 3) float64 coordinates of a table of points."""
    return np.stack([np.asarray(table[axis], np.float64) for axis in "XYZ"], axis=1)


class View(Cloud):
    """A cloud that shows some of another one's points.

    Subclasses say which; the bounds and the count are found by one pass.
    """

    def __init__(self, base: Cloud) -> None:
        self.base = base
        self.name = base.name
        self.crs = base.crs
        self.count = 0
        self.minimum = np.full(3, np.inf)
        self.maximum = np.full(3, -np.inf)
        for xyz in self.xyz_chunks():
            self.count += len(xyz)
            self.minimum = np.minimum(self.minimum, xyz.min(axis=0))
            self.maximum = np.maximum(self.maximum, xyz.max(axis=0))

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates in the cloud's own CRS and units, n <= size."""
        for xyz, keep in self.masked((xyz, xyz) for xyz in self.base.xyz_chunks(size)):
            if keep.any():
                yield xyz[keep]

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name, n <= size rows each."""
        pairs: Iterator[tuple[PointTable, Floats]] = (
            (table, xyz_of(table)) for table in self.base.table_chunks(size)
        )
        for table, keep in self.masked(pairs):
            if keep.any():
                yield {name: values[keep] for name, values in table.items()}

    def noise_chunks(self, size: int = CHUNK_POINTS) -> Iterator[tuple[Floats, NDArray[np.bool_]]]:
        """Yield coordinates (n, 3) and which of them are noise or withheld (n,), n <= size."""
        chunks = (((xyz, noise), xyz) for xyz, noise in self.base.noise_chunks(size))
        for (xyz, noise), keep in self.masked(chunks):
            if keep.any():
                yield xyz[keep], noise[keep]

    def keep(self, until: ExitStack) -> None:
        """Let the first pass over all coordinates of the base keep them in a temporary file."""
        self.base.keep(until)

    def masked(self, chunks: Iterable[tuple[Any, Floats]]) -> Iterator[tuple[Any, NDArray[np.bool_]]]:
        """Yield of chunks, given with their (n, 3) coordinates, which of their points are shown, (n,)."""
        raise NotImplementedError


def las_below(cloud: Cloud) -> LasCloud | None:
    """Return the LAS file of which a cloud shows points as they are stored; None if there is none."""
    while isinstance(cloud, View):
        cloud = cloud.base
    return cloud if isinstance(cloud, LasCloud) else None


def las_records(cloud: Cloud, size: int = CHUNK_POINTS) -> Iterator[laspy.ScaleAwarePointRecord]:
    """Yield laspy point records of what a cloud shows of a LAS file, with every dimension as stored.

    Args:
        cloud: one for which `las_below` finds a file.
        size: points a chunk, at most.

    Raises:
        InputError: if the file is truncated or damaged.

    """
    if isinstance(cloud, LasCloud):
        yield from cloud.record_chunks(size)
    elif isinstance(cloud, View):
        records = las_records(cloud.base, size)
        for record, keep in cloud.masked((one, placed_xyz(one)) for one in records):
            if keep.any():
                yield record if keep.all() else record[keep]


class Cropped(View):
    """The points within any of some boxes, edges included; or those outside all of them."""

    def __init__(self, base: Cloud, boxes: Sequence[Box], outside: bool = False) -> None:
        self.boxes = tuple(boxes)
        self.outside = outside
        super().__init__(base)

    def masked(self, chunks: Iterable[tuple[Any, Floats]]) -> Iterator[tuple[Any, NDArray[np.bool_]]]:
        """Yield of chunks, given with their (n, 3) coordinates, which of their points are shown, (n,)."""
        for chunk, xyz in chunks:
            keep = np.zeros(len(xyz), bool)
            for box in self.boxes:
                inside = np.ones(len(xyz), bool)
                for axis, (low, high) in enumerate(box):
                    inside &= (xyz[:, axis] >= low) & (xyz[:, axis] <= high)
                keep |= inside
            yield chunk, ~keep if self.outside else keep


class Head(View):
    """The first points of a cloud."""

    def __init__(self, base: Cloud, first: int) -> None:
        self.first = first
        super().__init__(base)

    def masked(self, chunks: Iterable[tuple[Any, Floats]]) -> Iterator[tuple[Any, NDArray[np.bool_]]]:
        """Yield of chunks, given with their (n, 3) coordinates, which of their points are shown, (n,)."""
        left = self.first
        for chunk, xyz in chunks:
            yield chunk, np.arange(len(xyz)) < left
            left -= len(xyz)
            if left <= 0:
                return


class Moved(Cloud):
    """A cloud whose points are moved as they are read, into another CRS and other units.

    The bounds enclose the cloud, and may be wider than it.

    Args:
        base: the cloud as it stands.
        move: takes (n, 3) coordinates of `base` to the new ones; by a `Motion` normals turn with the points.
        crs: CRS of the new coordinates, or None for local ones.

    """

    def __init__(self, base: Cloud, move: Callable[[Floats], Floats], crs: CRS | None) -> None:
        self.base = base
        self.move = move
        self.name = base.name
        self.crs = crs
        self.count = base.count
        self.minimum, self.maximum = self._bounds()

    def _bounds(self) -> tuple[Floats, Floats]:
        """Return the bounds by those of the base, or by its points where those make no sense."""
        axes = np.stack([self.base.minimum, self.base.maximum], axis=1)
        if np.isfinite(axes).all():
            try:
                moved = self.move(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
            except CrsError:
                pass
            else:
                return moved.min(axis=0), moved.max(axis=0)
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for xyz in self.xyz_chunks():
            low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
        return low, high

    def keep(self, until: ExitStack) -> None:
        """Let the first pass over all coordinates of the base keep them in a temporary file."""
        self.base.keep(until)

    def _moved(self, xyz: Floats) -> Floats:
        # points of a broken file may lie anywhere; whoever takes them refuses what is not finite
        with np.errstate(over="ignore", invalid="ignore"):
            return self.move(xyz)

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 moved coordinates, n <= size."""
        for xyz in self.base.xyz_chunks(size):
            yield self._moved(xyz)

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name, n <= size rows each."""
        for table in self.base.table_chunks(size):
            xyz = self._moved(xyz_of(table))
            moved: PointTable = {axis: xyz[:, i] for i, axis in enumerate("XYZ")}
            yield {**table, **turned_columns(table, self.move), **moved}

    def noise_chunks(self, size: int = CHUNK_POINTS) -> Iterator[tuple[Floats, NDArray[np.bool_]]]:
        """Yield moved coordinates (n, 3) and which of them are noise or withheld (n,), n <= size."""
        for xyz, noise in self.base.noise_chunks(size):
            yield self._moved(xyz), noise


def moved_source(pair: Pair) -> Moved:
    """Return the source of a solved pair, brought to the target: in the target's CRS and units.

    Points stream through the work frame, so that no digits are lost far from the origin.

    Raises:
        ValueError: if the pair has no transform yet.

    """
    chain = TransformChain.of(pair)
    return Moved(pair.source.cloud, chain.motion(), chain.target.file_crs)
