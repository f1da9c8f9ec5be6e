"""What the readers of other formats share: a cloud of columns, and the names of these."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.dimensions import PDAL_NAMES

if TYPE_CHECKING:
    from pyproj import CRS

_KNOWN = dict(PDAL_NAMES)
_KNOWN.update((pdal.lower(), pdal) for pdal in PDAL_NAMES.values())
_KNOWN.update(r="Red", g="Green", b="Blue", i="Intensity", time="GpsTime", label="Classification")
_KNOWN.update(scalar_intensity="Intensity", scalar_classification="Classification")
_KNOWN.update(diffuse_red="Red", diffuse_green="Green", diffuse_blue="Blue")
_KNOWN["class"] = "Classification"
COARSE_SINGLE = 0.005
"""Steps of single-precision coordinates, in metres (or units like them), from which on they are remarked."""
_RANGES = {"Intensity": 65535, "Red": 65535, "Green": 65535, "Blue": 65535, "Infrared": 65535}
_FLOATS = {"GpsTime"}
_TAKEN = {dimension.name.lower() for dimension in laspy.PointFormat(8).dimensions}


class FileCloud(Cloud):
    """A cloud in a file of another format than LAS; its bounds are known when its points are read.

    Attributes:
        path: the file.
        format: its name, such as "PLY".
        crs_problem: "", since these formats hardly state a CRS.

    """

    def __init__(self, path: Path, crs: CRS | None, kind: str, count: int) -> None:
        self.path = path
        self.name = str(path)
        self.crs = crs
        self.crs_problem = ""
        self.format = kind
        self.count = count
        self.minimum = np.full(3, np.nan)
        self.maximum = np.full(3, np.nan)

    def columns(self, size: int) -> Iterator[PointTable]:
        """Yield columns as they are in the file, under the names of `named`; n <= size rows each."""
        raise NotImplementedError

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name (X, Y, Z in float64 first), n <= size rows each.

        Raises:
            InputError: if the file is damaged.

        """
        with reported(self.path):
            for table in self.columns(size):
                yield {
                    **{axis: np.asarray(table[axis], np.float64) for axis in "XYZ"},
                    **{name: values for name, values in table.items() if name not in ("X", "Y", "Z")},
                }

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates, n <= size."""
        for table in self.table_chunks(size):
            yield np.column_stack([table[axis] for axis in "XYZ"])


def named(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return columns under the names that LAS files and PDAL have for them.

    What fits the dimension of that name becomes it; all others are extra dimensions of their own name.
    Columns that are no numbers are left out.

    Args:
        columns: by their name in the file; x, y and z in any case.

    """
    found: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if values.dtype.kind not in "buif" or values.ndim != 1:
            continue
        lower = name.strip().lower()
        if lower in ("x", "y", "z"):
            found[lower.upper()] = values
            continue
        pdal = _KNOWN.get(lower)
        if pdal is not None and pdal not in found and _fits(pdal, values):
            found[pdal] = values
        else:
            own = name.strip() or "column"
            found[_unique(f"{own}_value" if own.lower() in _TAKEN else own, found)] = values
    return found


def _fits(pdal: str, values: NDArray[Any]) -> bool:
    if pdal in _FLOATS:
        return True
    return values.dtype.kind in "bui" and values.dtype.itemsize <= (2 if pdal in _RANGES else 1)


def _unique(name: str, taken: Mapping[str, object]) -> str:
    lower = {one.lower() for one in taken} | _TAKEN
    base = name.encode()[:28].decode(errors="ignore")
    unique, number = base, 2
    while unique.lower() in lower:
        unique, number = f"{base}_{number}", number + 1
    return unique


def require_xyz(path: Path, names: Sequence[str]) -> None:
    """Refuse a file whose points have no x, y and z.

    Raises:
        InputError: naming what they have.

    """
    lower = [name.strip().lower() for name in names]
    if not {"x", "y", "z"} <= set(lower):
        raise InputError(
            f"{path} has no columns x, y and z but {', '.join(names) or 'none'}; name them so in its header"
        )


@contextmanager
def reported(path: Path) -> Iterator[None]:
    """Turn what a broken file makes the readers raise into an InputError that names it."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror or error}; check the file and its rights"
        ) from error
    except (ValueError, KeyError, IndexError, TypeError, RuntimeError, EOFError, UnicodeError) as error:
        detail = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is truncated or damaged ({detail}); copy or export it again") from error


def single_precision_step(xyz: Floats) -> Floats | None:
    """Return the steps between single-precision numbers as large as some coordinates; None if they are finer.

    Args:
        xyz: (n, 3) coordinates.

    Returns:
        (3,) the largest step on each axis, in units of the coordinates, where all of them are such numbers.

    """
    if not len(xyz) or not np.isfinite(xyz).all() or np.abs(xyz).max() > np.finfo(np.float32).max:
        return None
    single = xyz.astype(np.float32)
    if not np.array_equal(single, xyz):
        return None
    return np.asarray(np.spacing(np.abs(single).max(axis=0)), np.float64)


def precision_remark(cloud: Cloud, xyz: Floats) -> str | None:
    """Return in a sentence that a cloud's coordinates are coarse single-precision numbers; None if not.

    Args:
        cloud: it; LAS has whole numbers, whatever they were made of.
        xyz: (n, 3) a sample of it, in its units.

    """
    step = single_precision_step(xyz) if isinstance(cloud, FileCloud) else None
    if step is None or float(step.max()) < COARSE_SINGLE:
        return None
    return (
        f"its coordinates are single-precision numbers, in steps of {step.max():.2g} where they are as large "
        f"as {np.abs(xyz).max():,.0f}: what is finer was lost when it was written"
    )
