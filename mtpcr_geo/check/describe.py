"""The facts of a cloud in plain numbers and words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.check.place import code_of, epochs_of

if TYPE_CHECKING:
    from mtpcr_geo.check.preflight import Inspection
    from mtpcr_geo.crs import CrsFacts
    from mtpcr_geo.io.las import LasCloud


def describe(looked: Inspection) -> dict[str, Any]:
    """Gather what is known of a cloud, for the table and for JSON; None stands for what is not known."""
    cloud, facts, scan = looked.cloud, looked.claim.facts, looked.scan
    epoch, frame_epoch = epochs_of(cloud, facts)
    measured = looked.measured
    return {
        "file": str(cloud.path),
        "format": format_of(cloud),
        "points": cloud.count,
        "noise_points": scan.dropped if scan is not None else None,
        "crs": facts.name if facts is not None else None,
        "crs_code": (code_of(facts.crs) or None) if facts is not None else None,
        "crs_by": looked.claim.by or None,
        "horizontal_unit": facts.unit_name if facts is not None else None,
        "vertical_unit": facts.height_unit_name if facts is not None else None,
        "heights": heights_of(facts),
        "epoch": epoch,
        "datum_epoch": frame_epoch,
        "density_per_m2": measured.per_m2 if measured is not None else None,
        "area_m2": measured.area_m2 if measured is not None else None,
        "extent_m": measured.extent.tolist() if measured is not None else None,
        "minimum": looked.bounds[0].tolist(),
        "maximum": looked.bounds[1].tolist(),
        "scale": np.asarray(cloud.header.scales).tolist(),
        "offset": np.asarray(cloud.header.offsets).tolist(),
    }


def format_of(cloud: LasCloud) -> str:
    """Name a file's format, such as "LAZ 1.4, point format 6"."""
    header = cloud.header
    kind = "LAZ" if header.are_points_compressed else "LAS"
    if any(record.user_id == "copc" for record in cloud.records):
        kind = "COPC"
    return f"{kind} {header.version}, point format {header.point_format.id}"


def heights_of(facts: CrsFacts | None) -> str | None:
    """Say what heights refer to: a vertical datum, the ellipsoid, or nothing stated."""
    if facts is None:
        return None
    if facts.kind == "local":
        return "local"
    return facts.height_name
