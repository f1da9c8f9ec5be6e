"""Names for the arrays that every room uses, how dataclasses of them compare, and a quick median."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Image = NDArray[np.float32]
Grey = NDArray[np.uint8]


class ComparesArrays:
    """Compares dataclasses field by field, arrays exactly (NaN equal to NaN); instances have no hash."""

    def __eq__(self, other: object) -> bool:
        """Return whether both are of one class and every field is equal."""
        if type(self) is not type(other):
            return NotImplemented
        names = [one.name for one in fields(self)]  # type: ignore[arg-type]
        return all(_equal(getattr(self, name), getattr(other, name)) for name in names)

    __hash__ = None  # type: ignore[assignment]


def _equal(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        if not (isinstance(a, np.ndarray) and isinstance(b, np.ndarray)):
            return False
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return bool(a == b)


def median(values: Floats) -> float:
    """Return the median of (n,) numbers, n > 0: that of `numpy.median`, in an eighth of its time for few."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    ordered = np.partition(values, (half - 1, half))
    return (float(ordered[half - 1]) + float(ordered[half])) / 2.0
