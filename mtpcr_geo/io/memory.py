"""Clouds from Python: arrays, laspy's data and files, all as `Cloud`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mtpcr_geo.core.cloud import ArrayCloud, Cloud
from mtpcr_geo.core.errors import InputError

if TYPE_CHECKING:
    import laspy
    from pyproj import CRS

    # what a cloud can be given as: a file, (n, 3) coordinates, PDAL's structured array, laspy's data
    CloudLike: TypeAlias = str | os.PathLike[str] | ArrayLike | laspy.LasData | Cloud

Floats = NDArray[np.float64]


def read(path: str | os.PathLike[str], crs: str | CRS | None = None) -> Cloud:
    """Open a cloud: LAS, LAZ, COPC, PLY, PCD, text, PTS, PTX, E57 or NPY; points are streamed when asked for.

    Args:
        path: the file.
        crs: CRS to take instead of what the file states, such as "EPSG:2154".

    Returns:
        The cloud: `crs`, `count`, bounds; `to_array` reads all coordinates, `xyz_chunks` streams them.

    Raises:
        InputError: if it is missing, unreadable, or not such a file.
        CrsError: if `crs` is not understood.

    """
    from mtpcr_geo.crs import parse_crs
    from mtpcr_geo.io.formats import open_any

    return open_any(os.fspath(path), parse_crs(crs) if isinstance(crs, str) else crs)


def cloud_of(points: CloudLike, name: str = "the cloud") -> Cloud:
    """Return a cloud of whatever holds points.

    Args:
        points: a file that `read` takes; (n, 3) coordinates, list-like accepted; a structured array with
            X, Y, Z and further dimensions by PDAL's names; `laspy.LasData`; or a `Cloud`, which is returned
            as it is. Float64 coordinates are not copied.
        name: what messages call it; a file has its path.

    Returns:
        The cloud. Coordinates in an array have no CRS; those of a file or of laspy have the one stated.

    Raises:
        InputError: if it is none of these, or holds NaN or infinite coordinates.

    """
    if isinstance(points, Cloud):
        return points
    if isinstance(points, str | os.PathLike):
        from mtpcr_geo.io.formats import open_any

        return open_any(os.fspath(points))
    if is_las_data(points):
        return _cloud_of_las(points, name)
    if isinstance(points, np.ndarray) and points.dtype.names is not None:
        return _cloud_of_records(points, name)
    return ArrayCloud(coordinates(points, name), None, name)


def coordinates(points: Any, name: str) -> Floats:
    """Return finite (n, 3) float64 coordinates of an array or of what numpy can make one of.

    Raises:
        InputError: saying what was given instead.

    """
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise InputError(f"{name} must be (n, 3) coordinates; its rows differ in length") from error
    if array.dtype.kind not in "fiu":
        kind = type(points).__name__
        what = kind if array.ndim == 0 else f"a {kind} of dtype {array.dtype}"
        raise InputError(
            f"{name} must be a file, (n, 3) coordinates, laspy.LasData or a Cloud, and is {what}"
        )
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(
            f"{name} must be (n, 3) coordinates, a row x, y, z for each point, and has shape {array.shape}"
        )
    xyz = np.asarray(array, np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{name} has {int((~finite).sum())} points that are not finite (the first is row "
            f"{int((~finite).argmax())}); remove them: xyz[np.isfinite(xyz).all(axis=1)]"
        )
    return xyz


def is_array(points: CloudLike) -> bool:
    """Return whether points are given as bare coordinates: not as a file, laspy's data or a cloud."""
    return not (isinstance(points, str | os.PathLike | Cloud) or is_las_data(points))


def is_las_data(points: object) -> bool:
    """Return whether something is `laspy.LasData`."""
    import laspy

    return isinstance(points, laspy.LasData)


def _cloud_of_las(las: Any, name: str) -> ArrayCloud:
    """Take over points, all dimensions and the CRS of `laspy.LasData`."""
    from mtpcr_geo.io.dimensions import las_table
    from mtpcr_geo.io.las import xyz_of
    from mtpcr_geo.io.vlr import Record, crs_of_records

    listed = [*las.header.vlrs, *(las.header.evlrs or [])]
    records = [Record(vlr.user_id, vlr.record_id, vlr.description, vlr.record_data_bytes()) for vlr in listed]
    crs, _ = crs_of_records(records)
    xyz = xyz_of(las.points)
    table = las_table(las.points, xyz)
    extra = {dimension: values for dimension, values in table.items() if dimension not in ("X", "Y", "Z")}
    return ArrayCloud(xyz, crs, name, extra)


def _cloud_of_records(records: NDArray[np.void], name: str) -> ArrayCloud:
    """Take over a structured array as python-pdal has it."""
    names = records.dtype.names or ()
    missing = [axis for axis in "XYZ" if axis not in names]
    if missing or records.ndim != 1:
        raise InputError(
            f"{name} must have the fields X, Y and Z in one dimension, as PDAL's arrays do, and has "
            f"{', '.join(names)} in shape {records.shape}"
        )
    xyz = coordinates(np.column_stack([records[axis] for axis in "XYZ"]), name)
    extra = {dimension: records[dimension] for dimension in names if dimension not in ("X", "Y", "Z")}
    return ArrayCloud(xyz, None, name, extra)
