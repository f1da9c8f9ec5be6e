"""The dimensions of a point beyond X, Y, Z: laspy's names and PDAL's names."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.cloud import CLASS_FLAGS, PointTable, noise_of

LEGACY_OVERLAP = 12
SCAN_ANGLE_STEP = 0.006  # degrees a unit, point formats 6 and up

# PDAL's name of each dimension that laspy knows; the scan angle is apart, since its unit changes.
PDAL_NAMES = {
    "intensity": "Intensity",
    "return_number": "ReturnNumber",
    "number_of_returns": "NumberOfReturns",
    "scan_direction_flag": "ScanDirectionFlag",
    "edge_of_flight_line": "EdgeOfFlightLine",
    "classification": "Classification",
    "synthetic": "Synthetic",
    "key_point": "KeyPoint",
    "withheld": "Withheld",
    "overlap": "Overlap",
    "scanner_channel": "ScanChannel",
    "user_data": "UserData",
    "point_source_id": "PointSourceId",
    "gps_time": "GpsTime",
    "red": "Red",
    "green": "Green",
    "blue": "Blue",
    "nir": "Infrared",
}
_PLACE = {"X", "Y", "Z"}


def las_table(record: Any, xyz: Floats) -> PointTable:
    """Return a laspy point record as columns by PDAL name, X, Y, Z (float64) first."""
    table: dict[str, NDArray[np.generic]] = {axis: xyz[:, i] for i, axis in enumerate("XYZ")}
    for dimension in record.point_format.dimensions:
        name = dimension.name
        if name in _PLACE:
            continue
        values = np.asarray(record[name])
        if name == "scan_angle":
            table["ScanAngleRank"] = (values * SCAN_ANGLE_STEP).astype(np.float32)
        elif name == "scan_angle_rank":
            table["ScanAngleRank"] = values.astype(np.float32)
        else:
            table[PDAL_NAMES.get(name, name)] = values
    return table


def noise_of_record(record: Any) -> Mask:
    """Return which points of a laspy record are classified as noise or flagged withheld, (n,)."""
    return noise_of(np.asarray(record["classification"]), np.asarray(record["withheld"]))


def separate_legacy_flags(table: PointTable) -> PointTable:
    """Take the flags out of the upper three bits of ``Classification``, where old programs keep them.

    PDAL before 2.6 gives the classification byte of LAS point formats 0-5 as it stands in the file: five
    bits of class, then synthetic, key point and withheld. That depends on the
    file read; it cannot be known from the values.

    Args:
        table: dimensions by PDAL name.

    Returns:
        The same table with ``Classification`` 0-31 and the flags as dimensions of their own; the table
        itself where it has no classification, or has flags already.

    """
    has_flags = any(name in table for name in (*CLASS_FLAGS, "ClassFlags"))
    if "Classification" not in table or has_flags:
        return table
    raw = np.asarray(table["Classification"]).astype(np.uint8)
    flags = {name: (raw >> (5 + place)) & 1 for place, name in enumerate(CLASS_FLAGS[:3])}
    return {**table, "Classification": raw & 31, **flags}
