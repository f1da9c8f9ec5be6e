"""The facts of a cloud, as a check reports them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.check.place import code_of, epochs_of
from mtpcr_geo.io.las import LasCloud

if TYPE_CHECKING:
    from mtpcr_geo.check.inspection import Inspection
    from mtpcr_geo.crs import CrsFacts
    from mtpcr_geo.io.file_cloud import FileCloud


@dataclass(frozen=True)
class CloudFacts:
    """What is known of a cloud; None stands for what is not known.

    Attributes:
        file: its path.
        format: such as "LAZ 1.4, point format 6".
        points: their number, by the header.
        noise_points: how many of them are classified as noise (7, 18) or flagged withheld.
        crs, crs_code: name and code of its CRS, such as "EPSG:25832+7837".
        crs_by: what states the CRS: "WKT", "GeoTIFF keys" or "option".
        horizontal_unit, vertical_unit: names of the units of its coordinates.
        heights: what its heights refer to: a vertical datum, the ellipsoid, nothing stated, or "local".
        epoch: of its coordinates, in years.
        datum_epoch: at which its datum is defined, in years, where that moves with time.
        density_per_m2: points per occupied square metre.
        area_m2: area of the occupied cells.
        extent_m: its size along the axes of the work frame.
        minimum, maximum: bounds in its own coordinates and units.
        scale, offset: how coordinates are stored in a LAS file; empty for other formats.

    """

    file: str
    format: str
    points: int
    noise_points: int | None
    crs: str | None
    crs_code: str | None
    crs_by: str | None
    horizontal_unit: str | None
    vertical_unit: str | None
    heights: str | None
    epoch: float | None
    datum_epoch: float | None
    density_per_m2: float | None
    area_m2: float | None
    extent_m: list[float] | None
    minimum: list[float]
    maximum: list[float]
    scale: list[float]
    offset: list[float]


def describe(inspection: Inspection) -> CloudFacts:
    """Gather what is known of a cloud, for the table and for JSON."""
    cloud, facts, scan = inspection.cloud, inspection.claim.facts, inspection.scan
    epoch, datum_epoch = epochs_of(cloud, facts)
    measured = inspection.measured
    return CloudFacts(
        file=str(cloud.path),
        format=format_of(cloud),
        points=cloud.count,
        noise_points=scan.dropped if scan is not None else None,
        crs=facts.name if facts is not None else None,
        crs_code=(code_of(facts.crs) or None) if facts is not None else None,
        crs_by=inspection.claim.by or None,
        horizontal_unit=facts.unit_name if facts is not None else None,
        vertical_unit=facts.height_unit_name if facts is not None else None,
        heights=heights_of(facts),
        epoch=epoch,
        datum_epoch=datum_epoch,
        density_per_m2=measured.per_m2 if measured is not None else None,
        area_m2=measured.area_m2 if measured is not None else None,
        extent_m=measured.extent.tolist() if measured is not None else None,
        minimum=inspection.bounds[0].tolist(),
        maximum=inspection.bounds[1].tolist(),
        scale=np.asarray(cloud.header.scales).tolist() if isinstance(cloud, LasCloud) else [],
        offset=np.asarray(cloud.header.offsets).tolist() if isinstance(cloud, LasCloud) else [],
    )


def format_of(cloud: LasCloud | FileCloud) -> str:
    """Return a file's format, such as "LAZ 1.4, point format 6"."""
    if not isinstance(cloud, LasCloud):
        return cloud.format
    header = cloud.header
    kind = "LAZ" if header.are_points_compressed else "LAS"
    if any(record.user_id == "copc" for record in cloud.records):
        kind = "COPC"
    return f"{kind} {header.version}, point format {header.point_format.id}"


def heights_of(facts: CrsFacts | None) -> str | None:
    """Return what heights refer to: a vertical datum, the ellipsoid, nothing stated, or "local"."""
    if facts is None:
        return None
    if not facts.georeferenced:
        return "local"
    return facts.height_name
