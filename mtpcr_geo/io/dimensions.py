"""The dimensions of a point beyond X, Y, Z: laspy's names, PDAL's names, and what marks noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import PointTable

LOW_NOISE, HIGH_NOISE, LEGACY_OVERLAP = 7, 18, 12
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


def las_table(record: Any, xyz: NDArray[np.float64]) -> PointTable:
    """Lay out a laspy point record as columns by PDAL name, X, Y, Z (float64) first."""
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


def noise_of_record(record: Any) -> NDArray[np.bool_]:
    """Return which points of a laspy record are classified as noise or flagged withheld, (n,)."""
    return _noise(np.asarray(record["classification"]), np.asarray(record["withheld"]))


def noise_of_table(table: PointTable) -> NDArray[np.bool_]:
    """Return which points of a table are classified as noise or flagged withheld, (n,)."""
    classification, flags = split_classification(table)
    if classification is None:
        return np.zeros(len(table["X"]), bool)
    return _noise(classification, flags["Withheld"])


def _noise(classification: NDArray[Any], withheld: NDArray[Any]) -> NDArray[np.bool_]:
    noise = (classification == LOW_NOISE) | (classification == HIGH_NOISE) | (withheld != 0)
    return np.asarray(noise, bool)


def split_classification(
    table: PointTable,
) -> tuple[NDArray[np.uint8] | None, dict[str, NDArray[np.uint8]]]:
    """Return class and flags of a table, however its version of PDAL holds them.

    PDAL from 2.6 on has one dimension a flag. Before that the flags stand in ``ClassFlags`` for point
    formats 6 and up, and in the upper three bits of ``Classification`` for the others.

    Returns:
        The classes (n,), or None if there are none; and Synthetic, KeyPoint, Withheld and Overlap,
        each (n,) of 0 or 1.

    """
    names = ("Synthetic", "KeyPoint", "Withheld", "Overlap")
    none = np.zeros(len(table["X"]), np.uint8)
    raw = table.get("Classification")
    classification = None if raw is None else np.asarray(raw).astype(np.uint8)
    if any(name in table for name in names):
        flags = {name: np.asarray(table.get(name, none)).astype(np.uint8) for name in names}
    elif "ClassFlags" in table:
        bits = np.asarray(table["ClassFlags"]).astype(np.uint8)
        flags = {name: _bit(bits, place) for place, name in enumerate(names)}
    elif classification is not None:
        flags = {name: _bit(classification, 5 + place) for place, name in enumerate(names[:3])}
        flags["Overlap"] = none
        classification = (classification & 31).astype(np.uint8)
    else:
        flags = dict.fromkeys(names, none)
    return classification, flags


def _bit(values: NDArray[np.uint8], place: int) -> NDArray[np.uint8]:
    return ((values >> place) & 1).astype(np.uint8)
