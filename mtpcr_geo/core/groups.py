"""Figures of many groups of values at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Indices


@dataclass(frozen=True)
class Groups:
    """Values in groups, such as those of cells in blocks.

    Attributes:
        order: (n,) indices of the values that are in a group, group by group.
        number: (n,) the group of each of these, 0 and up.
        starts: (k,) where each group begins in the order.
        sizes: (k,) how many values each has.

    """

    order: Indices
    number: Indices
    starts: Indices
    sizes: Indices

    @classmethod
    def of(cls, column: NDArray[np.int64], row: NDArray[np.int64], fewest: int = 1) -> Groups:
        """Put values into groups by two whole numbers each, (m,); groups below the fewest are left out.

        The groups are in order of column and row, and the values of a group in their own order.
        """
        order = np.lexsort([row, column])
        new = np.diff(column[order], prepend=0) != 0
        new |= np.diff(row[order], prepend=0) != 0
        new[:1] = True
        sizes = np.diff(np.append(np.flatnonzero(new), len(order)))
        kept = np.repeat(sizes >= fewest, sizes)
        sizes = sizes[sizes >= fewest]
        number = np.repeat(np.arange(len(sizes)), sizes)
        return cls(order[kept], number, np.cumsum(sizes) - sizes, sizes)

    def __len__(self) -> int:
        return len(self.sizes)

    def means(self, values: Floats) -> Floats:
        """Return the mean of each group, (k,), of (m,) values."""
        return np.asarray(np.bincount(self.number, values[self.order], minlength=len(self)) / self.sizes)

    def medians(self, values: Floats) -> Floats:
        """Return the median of each group, (k,), of (m,) values."""
        some = values[self.order]
        some = some[np.lexsort([some, self.number])]
        low, high = self.starts + (self.sizes - 1) // 2, self.starts + self.sizes // 2
        return np.asarray((some[low] + some[high]) / 2.0)
