"""Names for the arrays that every room uses; shapes and units stand in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.float32]
Grey = NDArray[np.uint8]
