"""Sorting points into the nodes of an octree, out of core: each point is in exactly one node.

A node holds one point a cell of a 128-cell grid over its cube, and hands the others down; a node with
few points keeps them all. So every level is an even subset of the cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats

Key = tuple[int, int, int, int]  # level, x, y, z
Cells = NDArray[np.int32]

_BITS = 30  # of a quantised coordinate
_GRID_BITS = 7  # 128 cells a side of a node
_LEAF = 60_000
_DEEPEST = 16
_GROUP = 1_500_000
_GROUP_LEVEL = 6
_CHUNK = 1_000_000


def quantise(xyz: Floats, side: float) -> Cells:
    """Turn coordinates within a cube, (n, 3) from its low corner, into integers of 30 bits."""
    scaled = np.floor(xyz * (2.0**_BITS / side))
    return np.clip(scaled, 0, 2**_BITS - 1).astype(np.int32)


class Spool:
    """Records of one kind in a file, read and written by position.

    Plain reads, not a memory map: the pages of a map would count as this process's memory.

    Args:
        file: open for reading and writing; stays the caller's to close.
        dtype: of a record.
        count: how many records it holds, or shall hold.

    """

    def __init__(self, file: BinaryIO, dtype: np.dtype[Any], count: int) -> None:
        self.file, self.dtype, self.count = file, dtype, count

    def read(self, start: int, count: int) -> NDArray[Any]:
        """Read up to `count` records from position `start`: (n,), writable."""
        count = min(count, self.count - start)
        self.file.seek(start * self.dtype.itemsize)
        return np.frombuffer(bytearray(self.file.read(count * self.dtype.itemsize)), self.dtype)

    def write(self, start: int, records: NDArray[Any]) -> None:
        """Write records from position `start` on."""
        self.file.seek(start * self.dtype.itemsize)
        self.file.write(records.tobytes())


class OctreeSorter:
    """Gives the nodes of a cloud's octree, one after the other.

    Args:
        records: the points, as packed records.
        cells: gives the quantised coordinates (n, 3) of some records.
        temporary: opens a temporary file.

    """

    def __init__(
        self,
        records: Spool,
        cells: Callable[[NDArray[Any]], Cells],
        temporary: Callable[[], BinaryIO],
    ) -> None:
        self.records = records
        self.cells = cells
        self.temporary = temporary
        self.rng = np.random.default_rng(0)

    def nodes(self) -> Iterator[tuple[Key, NDArray[Any]]]:
        """Yield the key and the points of every node that is not empty."""
        level, codes, counts = self._groups()
        records = self._by_group(level, codes, counts) if level else self.records
        upper: dict[Key, list[NDArray[Any]]] = {}
        taken: dict[Key, NDArray[np.int64]] = {}
        start = 0
        for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
            group = records.read(start, count)
            start += count
            # the first point of a cell is the one that is kept: without a shuffle, always that of one edge
            group = group[self.rng.permutation(count)]
            cells = self.cells(group)
            mask = (1 << level) - 1
            x, y, z = code >> 2 * level, code >> level & mask, code & mask
            left = np.ones(count, bool)
            for above in range(level):
                key = (above, x >> level - above, y >> level - above, z >> level - above)
                chosen = _one_a_cell(cells, np.flatnonzero(left), above, taken.setdefault(key, _NOTHING))
                if len(chosen):
                    taken[key] = np.union1d(taken[key], _grid_code(cells[chosen], above))
                    upper.setdefault(key, []).append(group[chosen])
                    left[chosen] = False
            yield from _subtree((level, x, y, z), group, cells, np.flatnonzero(left))
        for key, parts in upper.items():
            yield key, np.concatenate(parts)

    def _groups(self) -> tuple[int, NDArray[np.int64], NDArray[np.int64]]:
        """Find the level at which nodes are small enough to be held, and how many points each has."""
        if self.records.count <= _GROUP:
            return 0, np.zeros(1, np.int64), np.array([self.records.count])
        tally: dict[int, int] = {}
        for start in range(0, self.records.count, _CHUNK):
            chunk = self.records.read(start, _CHUNK)
            found = np.unique(self._codes(chunk, _GROUP_LEVEL), return_counts=True)
            for code, count in zip(found[0].tolist(), found[1].tolist(), strict=True):
                tally[code] = tally.get(code, 0) + count
        deep = np.array(sorted(tally), np.int64)
        deep_counts = np.array([tally[code] for code in deep.tolist()])
        for level in range(1, _GROUP_LEVEL + 1):
            down, mask = _GROUP_LEVEL - level, (1 << _GROUP_LEVEL) - 1
            axes = [(deep >> _GROUP_LEVEL * place & mask) >> down for place in (2, 1, 0)]
            codes, inverse = np.unique(axes[0] << 2 * level | axes[1] << level | axes[2], return_inverse=True)
            counts = np.bincount(inverse, weights=deep_counts).astype(np.int64)
            if counts.max() <= _GROUP:
                break
        return level, codes, counts

    def _codes(self, records: NDArray[Any], level: int) -> NDArray[np.int64]:
        cells = self.cells(records).astype(np.int64) >> _BITS - level
        return np.asarray(cells[:, 0] << 2 * level | cells[:, 1] << level | cells[:, 2])

    def _by_group(self, level: int, codes: NDArray[np.int64], counts: NDArray[np.int64]) -> Spool:
        """Sort all records by group, into a second temporary file."""
        output = Spool(self.temporary(), self.records.dtype, self.records.count)
        places = np.concatenate([[0], np.cumsum(counts)[:-1]])
        for start in range(0, self.records.count, _CHUNK):
            chunk = self.records.read(start, _CHUNK)
            group = np.searchsorted(codes, self._codes(chunk, level))
            part = chunk[np.argsort(group, kind="stable")]
            numbers = np.bincount(group, minlength=len(codes))
            done = 0
            for index in np.flatnonzero(numbers).tolist():
                n = int(numbers[index])
                output.write(int(places[index]), part[done : done + n])
                places[index] += n
                done += n
        return output


_NOTHING = np.zeros(0, np.int64)


def _grid_code(cells: Cells, level: int) -> NDArray[np.int64]:
    """Return the number of the cell of its node's grid in which each point lies, (n,)."""
    grid = (cells >> _BITS - level - _GRID_BITS).astype(np.int64) & (1 << _GRID_BITS) - 1
    return np.asarray(grid[:, 0] << 2 * _GRID_BITS | grid[:, 1] << _GRID_BITS | grid[:, 2])


def _one_a_cell(
    cells: Cells, among: NDArray[np.int64], level: int, taken: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Choose the first point of each cell of the node's grid that is not taken yet."""
    codes, first = np.unique(_grid_code(cells[among], level), return_index=True)
    return among[first[~np.isin(codes, taken)]]


def _subtree(
    root: Key, points: NDArray[Any], cells: Cells, chosen: NDArray[np.int64]
) -> Iterator[tuple[Key, NDArray[Any]]]:
    """Build the octree below a node from points that are held in memory."""
    open_nodes = [(root, chosen)]
    while open_nodes:
        key, here = open_nodes.pop()
        if not len(here):
            continue
        level, x, y, z = key
        if len(here) <= _LEAF or level == _DEEPEST:
            yield key, points[here]
            continue
        kept = _one_a_cell(cells, here, level, _NOTHING)
        yield key, points[kept]
        rest = np.setdiff1d(here, kept, assume_unique=True)
        octant = cells[rest] >> _BITS - level - 1 & 1
        number = octant[:, 0] << 2 | octant[:, 1] << 1 | octant[:, 2]
        for child in range(8):
            place = (level + 1, x * 2 + (child >> 2), y * 2 + (child >> 1 & 1), z * 2 + (child & 1))
            open_nodes.append((place, rest[number == child]))
