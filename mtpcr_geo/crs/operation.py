"""Coordinate operations between CRSs: the most accurate one, never a lesser one unreported."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import CrsError
from mtpcr_geo.core.frames import OperationReport
from mtpcr_geo.crs.faults import crs_errors

if TYPE_CHECKING:
    from pyproj import CRS
    from pyproj.transformer import AreaOfInterest

    from mtpcr_geo.crs.facts import CrsFacts


@dataclass(frozen=True)
class Operation:
    """A coordinate operation of PROJ, fixed down to its parameters.

    Attributes:
        pipeline: the PROJ pipeline, x before y on both sides; None where nothing is to be done.
        name: what the EPSG registry calls it.
        accuracy: in metres, or None where nobody stated one.
        grids: names of the grid files that it uses.

    """

    pipeline: str | None
    name: str
    accuracy: float | None
    grids: tuple[str, ...]

    @property
    def report(self) -> OperationReport:
        """The operation by name, accuracy and grids, for the audit."""
        return OperationReport(self.name, self.accuracy, self.grids)


@crs_errors()
def best_operation(start: CRS, end: CRS, area: AreaOfInterest | None) -> Operation:
    """Return the most accurate operation for an area, and refuse to take a lesser one.

    Args:
        start: the CRS to come from.
        end: the CRS to go to.
        area: where the data lie; None considers the whole world.

    Raises:
        CrsError: if none is known, or the best one needs a grid that this machine lacks.

    """
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    try:
        with warnings.catch_warnings():
            # pyproj warns about missing grids, which are an error here
            warnings.simplefilter("ignore", UserWarning)
            group = TransformerGroup(start, end, always_xy=True, area_of_interest=area, allow_ballpark=False)
    except ProjError as error:
        raise CrsError(f"PROJ knows no operation from {start.name} to {end.name}: {error}") from error
    if not group.best_available and group.unavailable_operations:
        missing = [
            grid.short_name
            for operation in group.unavailable_operations[:1]
            for grid in operation.grids
            if not grid.available
        ]
        names = ", ".join(missing) or "a grid"
        raise CrsError(
            f"the operation from {start.name} to {end.name} needs {names}, which is not installed; "
            f"fetch it with 'pyproj sync --file {(missing or ['...'])[0]}', or reproject one of them first"
        )
    if not group.transformers:
        raise CrsError(
            f"PROJ knows no operation from {start.name} to {end.name}; reproject one of them first, "
            "or name its CRS"
        )
    best = group.transformers[0]
    definition = str(best.definition)
    parts = [best, *(best.operations or ())]
    grids = {grid.short_name for part in parts for grid in getattr(part, "grids", ())}
    return Operation(
        pipeline=None if definition.split()[0] in ("noop", "proj=noop") else definition,
        # a projection made on the way has no name of its own
        name=best.description.replace("unknown", end.name),
        accuracy=float(best.accuracy) if best.accuracy is not None and best.accuracy >= 0 else None,
        grids=tuple(sorted(grids)),
    )


@crs_errors()
def area_of(facts: CrsFacts, points: Floats) -> AreaOfInterest | None:
    """Return the area in degrees that (n, 3) coordinates of a CRS cover; None where they are beyond it."""
    from pyproj import Transformer
    from pyproj.transformer import AreaOfInterest

    from mtpcr_geo.crs.facts import unbound

    if facts.horizontal is None:
        return None
    plain = unbound(facts.horizontal)
    geographic = geographic_of(plain)
    transformer = Transformer.from_crs(plain, geographic, always_xy=True)
    lon, lat = transformer.transform(points[:, 0], points[:, 1], points[:, 2], errcheck=False)[:2]
    degrees = geographic.axis_info[0].unit_conversion_factor * 180.0 / np.pi
    corners = np.column_stack([lon, lat]) * degrees
    if plain.prime_meridian is not None:
        corners[:, 0] += plain.prime_meridian.longitude
    if not np.isfinite(corners).all() or np.abs(corners[:, 1]).max() > 90:
        return None
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    return AreaOfInterest(west, south, east, north)


def grid_scale(crs: CRS, area: AreaOfInterest) -> tuple[float, float] | None:
    """Return how long a metre of a projected CRS is drawn in the middle of an area, at least and at most.

    None where PROJ has no answer.
    """
    from pyproj import Proj
    from pyproj.exceptions import ProjError

    lon = (area.west_lon_degree + area.east_lon_degree) / 2
    lat = (area.south_lat_degree + area.north_lat_degree) / 2
    try:
        factors = Proj(crs).get_factors(lon, lat)
    except ProjError:
        return None
    found = float(factors.tissot_semiminor), float(factors.tissot_semimajor)
    return found if np.isfinite(found).all() and min(found) > 0 else None


def geographic_of(crs: CRS) -> CRS:
    """Return the geographic CRS, two axes, on which a geodetic or projected one rests."""
    from pyproj.crs import GeographicCRS

    base = crs.geodetic_crs
    if base is None:
        raise CrsError(f"{crs.name} rests on no geographic system; name another one")
    if base.is_geocentric:
        return GeographicCRS(name=f"{base.name} (geographic)", datum=base.datum)
    return base.to_2d()


@crs_errors()
def local_projection(facts: CrsFacts, area: AreaOfInterest) -> CRS:
    """Return a transverse Mercator of true scale in the middle of an area, on the same datum, in metres.

    The middle is rounded to hundredths of a degree: scale stays within 1e-8 of true, and the name is short.
    """
    from pyproj.crs import ProjectedCRS
    from pyproj.crs.coordinate_operation import TransverseMercatorConversion

    from mtpcr_geo.crs.facts import unbound

    if facts.horizontal is None:
        raise ValueError("local coordinates need no projection")
    plain = unbound(facts.horizontal)
    meridian = plain.prime_meridian.longitude if plain.prime_meridian is not None else 0.0
    lon = round((area.west_lon_degree + area.east_lon_degree) / 2, 2)
    lat = round((area.south_lat_degree + area.north_lat_degree) / 2, 2)
    return ProjectedCRS(
        TransverseMercatorConversion(
            latitude_natural_origin=lat,
            longitude_natural_origin=lon - meridian,
            scale_factor_natural_origin=1.0,
        ),
        name=f"transverse Mercator at {lat:g}, {lon:g} on {plain.name}",
        geodetic_crs=geographic_of(plain),
    )
