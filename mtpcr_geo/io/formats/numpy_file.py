"""NumPy's NPY: (n, 3) coordinates, or a structured array with the fields x, y and z."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.file_cloud import FileCloud, named, reported, require_xyz

if TYPE_CHECKING:
    from pyproj import CRS


class NumpyCloud(FileCloud):
    """An array in a file, which is mapped and not held."""

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns by name."""
        array = _mapped(self.path)
        for start in range(0, len(array), size):
            part = array[start : start + size]
            if part.dtype.names is not None:
                yield named({name: np.array(part[name]) for name in part.dtype.names})
            else:
                names = ["x", "y", "z", *(f"column_{i}" for i in range(4, part.shape[1] + 1))]
                yield named({name: np.array(part[:, i]) for i, name in enumerate(names)})


def open_file(path: Path, crs: CRS | None) -> NumpyCloud:
    """Open an NPY file.

    Raises:
        InputError: if it holds no points.

    """
    with reported(path):
        array = _mapped(path)
        if array.dtype.names is not None and array.ndim == 1:
            require_xyz(path, array.dtype.names)
        elif array.dtype.kind not in "iuf" or array.ndim != 2 or array.shape[1] < 3:
            raise InputError(
                f"{path} holds an array of shape {array.shape} and type {array.dtype}; give (n, 3) "
                "coordinates, or fields x, y, z"
            )
    return NumpyCloud(path, crs, "NPY", len(array))


def _mapped(path: Path) -> NDArray[Any]:
    try:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (SyntaxError, TokenError, RecursionError, MemoryError, OverflowError) as error:
        # numpy reads the header as Python would
        raise ValueError(f"its header cannot be read: {type(error).__name__}") from error
    return array
