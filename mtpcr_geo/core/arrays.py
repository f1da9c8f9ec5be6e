"""Names for the arrays that pass between the rooms."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
"""Coordinates, matrices, distances: float64."""

Indices: TypeAlias = NDArray[np.int64]
"""Row numbers or cells: int64."""

Mask: TypeAlias = NDArray[np.bool_]
"""One boolean for each point or cell."""

Image: TypeAlias = NDArray[np.float32]
"""A raster, (rows, columns) float32; NaN where nothing is known."""

Grey: TypeAlias = NDArray[np.uint8]
"""A grey image, (rows, columns) uint8."""
