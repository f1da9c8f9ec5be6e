"""What every reader gives: a `Cloud`, known by its header and streamed in chunks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pyproj import CRS

CHUNK_POINTS = 1_000_000
PointTable = Mapping[str, NDArray[np.generic]]


class Cloud(ABC):
    """A point cloud that can be streamed any number of times.

    Attributes:
        name: what to call it in messages; the path for a file.
        crs: its coordinate reference system, or None where neither file nor user says one.
        count: number of points, from the header.
        minimum, maximum: (3,) bounds in the cloud's own coordinates and units, from the header.

    """

    name: str
    crs: CRS | None
    count: int
    minimum: NDArray[np.float64]
    maximum: NDArray[np.float64]

    @abstractmethod
    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[NDArray[np.float64]]:
        """Yield (n, 3) float64 coordinates in the cloud's own CRS and units, n <= size."""

    @abstractmethod
    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name (X, Y, Z in float64 first), n <= size rows each."""

    def to_array(self) -> NDArray[np.float64]:
        """Return all (n, 3) float64 coordinates in the cloud's own CRS and units."""
        chunks = list(self.xyz_chunks())
        return np.concatenate(chunks) if chunks else np.empty((0, 3))

    def noise_chunks(
        self, size: int = CHUNK_POINTS
    ) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
        """Yield coordinates (n, 3) and which of them are noise or withheld (n,), n <= size.

        Noise is class 7 or 18; it is left out of what is matched, never out of what is written.
        """
        from mtpcr_geo.io.dimensions import noise_of_table

        for table in self.table_chunks(size):
            yield np.column_stack([table[axis] for axis in "XYZ"]).astype(np.float64), noise_of_table(table)


@dataclass
class ArrayCloud(Cloud):
    """A cloud held in memory: simulated, or handed over by PDAL.

    Attributes:
        xyz: (n, 3) float64 coordinates in `crs` units.
        extra: further dimensions by PDAL name, each (n,).

    """

    xyz: NDArray[np.float64]
    crs: CRS | None = None
    name: str = "memory"
    extra: dict[str, NDArray[np.generic]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.count = len(self.xyz)
        empty = np.full(3, np.nan)
        self.minimum = self.xyz.min(axis=0) if self.count else empty
        self.maximum = self.xyz.max(axis=0) if self.count else empty

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[NDArray[np.float64]]:
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
