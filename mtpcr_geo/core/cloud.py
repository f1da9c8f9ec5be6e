"""What every reader gives: a `Cloud`, known by its header and streamed in chunks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Mask

if TYPE_CHECKING:
    from pyproj import CRS

CHUNK_POINTS = 1_000_000
LOW_NOISE, HIGH_NOISE = 7, 18
CLASS_FLAGS = ("Synthetic", "KeyPoint", "Withheld", "Overlap")
"""The flags of a point by PDAL name, in the order of their bits in ``ClassFlags``."""

PointTable = Mapping[str, NDArray[np.generic]]


class Cloud(ABC):
    """A point cloud that can be streamed any number of times.

    Attributes:
        name: what to call it in messages; the path for a file.
        crs: its coordinate reference system, or None where neither the file nor the user states one.
        count: number of points, from the header.
        minimum, maximum: (3,) bounds in the cloud's own coordinates and units, from the header.

    """

    name: str
    crs: CRS | None
    count: int
    minimum: Floats
    maximum: Floats

    @abstractmethod
    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates in the cloud's own CRS and units, n <= size."""

    @abstractmethod
    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name (X, Y, Z in float64 first), n <= size rows each."""

    def to_array(self) -> Floats:
        """Return all (n, 3) float64 coordinates in the cloud's own CRS and units."""
        chunks = list(self.xyz_chunks())
        return np.concatenate(chunks) if chunks else np.empty((0, 3))

    def keep(self, until: ExitStack) -> None:  # noqa: B027 - what is not compressed need not be kept
        """Let the first pass over all coordinates keep them in a temporary file, where that saves time.

        Args:
            until: the file is gone when this is closed.

        """

    def noise_chunks(self, size: int = CHUNK_POINTS) -> Iterator[tuple[Floats, Mask]]:
        """Yield coordinates (n, 3) and which of them are noise or withheld (n,), n <= size.

        Noise is class 7 or 18; it is left out of what is matched, never out of what is written.
        """
        for table in self.table_chunks(size):
            yield np.column_stack([table[axis] for axis in "XYZ"]).astype(np.float64), noise_of_table(table)


@dataclass(eq=False)
class ArrayCloud(Cloud):
    """A cloud held in memory: simulated, or given as arrays.

    Two such clouds are equal only if they are the same object.

    Attributes:
        xyz: (n, 3) float64 coordinates in `crs` units.
        extra: further dimensions by PDAL name, each (n,). ``Classification`` is the class alone, 0-255;
            flags are the dimensions ``Synthetic``, ``KeyPoint``, ``Withheld`` and ``Overlap``, or the bits
            of ``ClassFlags``, and are unset where there are none of these.

    """

    xyz: Floats
    crs: CRS | None = None
    name: str = "memory"
    extra: dict[str, NDArray[np.generic]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.count = len(self.xyz)
        empty = np.full(3, np.nan)
        self.minimum = self.xyz.min(axis=0) if self.count else empty
        self.maximum = self.xyz.max(axis=0) if self.count else empty

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates, n <= size."""
        for start in range(0, self.count, size):
            yield self.xyz[start : start + size]

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name, n <= size rows each."""
        for start in range(0, self.count, size):
            part = slice(start, start + size)
            table: dict[str, NDArray[np.generic]] = {axis: self.xyz[part, i] for i, axis in enumerate("XYZ")}
            table.update({name: values[part] for name, values in self.extra.items()})
            yield table


def noise_of(classification: NDArray[Any], withheld: NDArray[Any]) -> Mask:
    """Return which points are noise (class 7 or 18) or flagged withheld, (n,)."""
    noise = (classification == LOW_NOISE) | (classification == HIGH_NOISE) | (withheld != 0)
    return np.asarray(noise, bool)


def noise_of_table(table: PointTable) -> Mask:
    """Return which points of a table are classified as noise or flagged withheld, (n,)."""
    classification = np.asarray(table.get("Classification", np.zeros(len(table["X"]), np.uint8)))
    return noise_of(classification, flags_of_table(table)["Withheld"])


def flags_of_table(table: PointTable) -> dict[str, NDArray[np.uint8]]:
    """Return Synthetic, KeyPoint, Withheld and Overlap of a table, each (n,) of 0 or 1.

    They are taken from the dimensions of these names, else from the bits of ``ClassFlags``; a table that
    has neither has no flags. A class is never taken for flags, whatever its value.
    """
    none = np.zeros(len(table["X"]), np.uint8)
    if "ClassFlags" in table and not any(name in table for name in CLASS_FLAGS):
        bits = np.asarray(table["ClassFlags"]).astype(np.uint8)
        return {name: ((bits >> place) & 1).astype(np.uint8) for place, name in enumerate(CLASS_FLAGS)}
    return {name: (np.asarray(table.get(name, none)) != 0).astype(np.uint8) for name in CLASS_FLAGS}
