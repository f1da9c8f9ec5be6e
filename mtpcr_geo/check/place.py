"""Where the coordinates of a cloud lie by its CRS, and whether that can be."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.check.findings import Finding, Role
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import CrsError
from mtpcr_geo.core.frames import box_points
from mtpcr_geo.core.scanner import PLAIN, Scanner, unit_by_size
from mtpcr_geo.core.units import UNITS
from mtpcr_geo.crs import CrsFacts, facts_of, parse_crs, same_place
from mtpcr_geo.crs.facts import unbound
from mtpcr_geo.crs.operation import area_of
from mtpcr_geo.io.vlr import WKT_RECORD

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.io.file_cloud import FileCloud
    from mtpcr_geo.io.las import LasCloud

# grids are used a little beyond their area, and neighbouring zones for one another; they do not break there
BEYOND_AREA_DEG, NEIGHBOUR_DEG = 0.5, 6.0
NEAR_ORIGIN_M = 10_000.0
EXCHANGE = "exchange them, for example with PDAL's filters.ferry, or name the CRS that has them so"
_COORDINATE_EPOCH = re.compile(r"COORDINATEMETADATA\b.*[,\s]EPOCH\s*\[\s*([0-9.]+)\s*\]", re.S | re.I)


@dataclass(frozen=True)
class Claim:
    """The CRS in which a cloud's coordinates are taken to be.

    Attributes:
        facts: it, taken apart; None where neither file nor user states one, or it cannot be handled.
        by: what states it: "WKT", "GeoTIFF keys", "option" or "".

    """

    facts: CrsFacts | None
    by: str


def claim_of(
    cloud: LasCloud | FileCloud, declared: str | None, local: bool, scanner: Scanner = PLAIN
) -> Claim:
    """Return the CRS that a cloud is taken to be in: the declared one, else that of its file.

    Args:
        cloud: the file.
        declared: the CRS that the user gives for it, or None.
        local: whether the user declares the cloud to be local.
        scanner: unit and axes that the user declares for it.

    """
    try:
        if local:
            return Claim(facts_of(None, scanner), "option")
        if declared is not None:
            return Claim(facts_of(parse_crs(declared), scanner), "option")
        if cloud.crs is None:
            return Claim(None, "")
        return Claim(facts_of(cloud.crs), _stated_by(cloud))
    except CrsError:
        return Claim(None, "")


def _stated_by(cloud: LasCloud | FileCloud) -> str:
    if not hasattr(cloud, "records"):
        return cloud.format
    wkt = any(record.record_id == WKT_RECORD and record.states_crs for record in cloud.records)
    return "WKT" if wkt else "GeoTIFF keys"


def code_of(crs: CRS | None) -> str:
    """Return a CRS as codes, such as "EPSG:25832+7837"; "" where it has none."""
    if crs is None:
        return ""
    code = crs.to_authority()
    if code is not None:
        return ":".join(code)
    parts = [unbound(part).to_authority() for part in unbound(crs).sub_crs_list]
    if not parts or None in parts:
        return ""
    (first, number), *rest = [part for part in parts if part is not None]
    return "+".join([f"{first}:{number}", *(n if a == first else f"{a}:{n}" for a, n in rest)])


def epochs_of(cloud: LasCloud | FileCloud, facts: CrsFacts | None) -> tuple[float | None, float | None]:
    """Return the epoch of the coordinates, and that at which a dynamic datum is defined, in years."""
    epoch: float | None = None
    for record in getattr(cloud, "records", ()):
        if record.record_id == WKT_RECORD and record.states_crs:
            found = _COORDINATE_EPOCH.search(record.data.decode("utf-8", errors="replace"))
            epoch = float(found[1]) if found else epoch
    frame: float | None = None
    if facts is not None and facts.horizontal is not None:
        base = unbound(facts.horizontal).geodetic_crs
        datum: dict[str, Any] = (
            base.datum.to_json_dict() if base is not None and base.datum is not None else {}
        )
        if "frame_reference_epoch" in datum:
            frame = float(datum["frame_reference_epoch"])
    return epoch, frame


def claim_findings(
    cloud: LasCloud | FileCloud,
    claim: Claim,
    declared: str | None,
    local: bool,
    role: Role,
    one: bool,
    bounds: Floats,
) -> Iterator[Finding]:
    """Yield what is missing or unclear in a cloud's CRS.

    Args:
        cloud: the file.
        claim: the CRS it is taken to be in.
        declared: the CRS that the user gives for it, or None.
        local: whether the user declares it to be local.
        role: which cloud it is.
        one: whether it is the only one.
        bounds: (2, 3) lowest and highest of its coordinates.

    """
    if declared is None and not local and cloud.crs is None:
        option = "--source-crs" if one else f"--{role}-crs"
        unit = unit_by_size(bounds[1] - bounds[0], cloud.count) if np.isfinite(bounds).all() else None
        and_unit = f" and --{'source' if one else role}-unit {unit}" if unit in ("mm", "cm") else ""
        yield Finding(
            "error",
            "crs-missing",
            role,
            f"no coordinate reference system is known ({cloud.crs_problem or 'the file states none'})"
            f"{_guess(bounds, cloud.count)}",
            f"give {option} EPSG:..., or {option} local{and_unit} if its coordinates are local",
        )
    elif cloud.crs is not None and cloud.crs_problem and claim.by != "option":
        yield Finding(
            "note",
            "crs-partly",
            role,
            cloud.crs_problem,
            f"name the whole CRS (--{'source' if one else role}-crs), if it is known",
        )
    elif cloud.crs is None and cloud.crs_problem:
        yield Finding("note", "crs-unreadable", role, f"{cloud.crs_problem}; the one given by option is used")
    elif cloud.crs is not None and claim.facts is not None and claim.by == "option":
        named = claim.facts.crs
        if named is None or not same_place(named, cloud.crs):
            yield Finding(
                "note",
                "crs-overridden",
                role,
                f"the file states {cloud.crs.name}; it is taken as {claim.facts.name}, as given by option",
            )
    epoch, frame = epochs_of(cloud, claim.facts)
    if frame is not None and epoch is None:
        yield Finding(
            "note",
            "epoch-missing",
            role,
            "its datum moves with time (defined at "
            f"{frame:g}) and no epoch is stated: plates drift by centimetres a year",
            "see that both clouds are of about the same epoch",
        )
    if claim.facts is not None and claim.facts.crs is not None and claim.facts.kind == "projected":
        facts = claim.facts
        if facts.height == "unsaid" and not facts.height_unit_stated and facts.height_unit != 1.0:
            yield Finding(
                "note",
                "z-unit-unsaid",
                role,
                f"no unit of height is stated: its z is taken as {facts.height_unit_name}, like x and y",
                "name a CRS with a vertical part if its heights are in metres, such as EPSG:2994+5703",
            )


def looks_local(bounds: Floats, points: int) -> bool:
    """Return whether coordinates of no stated CRS look like those of a scan around its own origin.

    Args:
        bounds: (2, 3) lowest and highest.
        points: their number.

    """
    return "look local" in _guess(bounds, points)


def _guess(bounds: Floats, points: int) -> str:
    low, high = bounds
    if not np.isfinite(bounds).all():
        return ""
    unit = unit_by_size(high - low, points)
    if unit in ("mm", "cm"):
        return f"; its x and y look local, in {UNITS[unit][1]}s"
    plan = np.array([low[:2], high[:2]])
    if np.abs(plan[:, 0]).max() <= 180 and np.abs(plan[:, 1]).max() <= 90:
        if np.ptp(plan, axis=0).max() < 1.0 < np.abs(low[:2]).max():
            return "; its x and y look like degrees"
        return "; its x and y look local"
    # origins of grids lie far outside of what they map
    if np.abs(plan).max() < NEAR_ORIGIN_M or (np.sign(plan[0]) * np.sign(plan[1]) <= 0).all():
        return "; its x and y look local"
    with np.errstate(over="ignore"):
        # the header may state bounds of any size
        geocentric = np.linalg.norm(low) > 6.2e6 and np.ptp([low, high], axis=0).max() < 1e5
    if geocentric and np.abs(low[2]) > 1e5:
        return "; its coordinates look geocentric"
    return "; its x and y look like a national grid or UTM"


def area_findings(facts: CrsFacts, bounds: Floats, role: Role) -> Iterator[Finding]:
    """Yield coordinates beyond the area for which a CRS is made, among them exchanged axes.

    Args:
        facts: the CRS.
        bounds: (2, 3) lowest and highest coordinates in it.
        role: which cloud it is.

    """
    if facts.horizontal is None or facts.kind == "geocentric" or not np.isfinite(bounds).all():
        return
    if within_area(facts, bounds) is not False:
        return
    if within_area(facts, exchanged(bounds)):
        yield Finding(
            "warning",
            "axes-swapped",
            role,
            f"x and y seem exchanged: as they stand they are outside the area of {facts.name}, "
            "the other way round they are inside",
            EXCHANGE,
        )
        return
    degrees = (
        facts.kind == "projected" and np.abs(bounds[:, 0]).max() <= 180 and np.abs(bounds[:, 1]).max() <= 90
    )
    hint = "; they look like degrees" if degrees else ""
    yield Finding(
        "note" if within_area(facts, bounds, NEIGHBOUR_DEG) else "warning",
        "outside-area",
        role,
        f"coordinates about ({bounds[:, 0].mean():.6g}, {bounds[:, 1].mean():.6g}) are outside the area "
        f"for which {facts.name} is made{hint}",
        f"check that it is the right CRS; --{role}-crs names another" if role != "both" else "",
    )


def exchanged(bounds: Floats) -> Floats:
    """Return bounds with x and y exchanged."""
    return np.asarray(bounds)[:, [1, 0, 2]]


def within_area(facts: CrsFacts, bounds: Floats, beyond: float = BEYOND_AREA_DEG) -> bool | None:
    """Return whether the middle of some bounds lies in a CRS's area of use, or little beyond.

    Args:
        facts: the CRS.
        bounds: (2, 3) lowest and highest coordinates in it.
        beyond: degrees around the area that still count.

    Returns:
        None where the area is not known.

    """
    if facts.crs is None or facts.horizontal is None:
        return None
    area = _area_of_use(facts)
    if area is None:
        return None
    here = area_of(facts, box_points(bounds, 2))
    if here is None:
        return False
    west, south, east, north = area
    lon = (here.west_lon_degree + here.east_lon_degree) / 2
    lat = (here.south_lat_degree + here.north_lat_degree) / 2
    if east < west:
        east += 360.0
    inside_lon = any(west - beyond <= lon + turn <= east + beyond for turn in (-360.0, 0.0, 360.0))
    return bool(inside_lon and south - beyond <= lat <= north + beyond)


def _area_of_use(facts: CrsFacts) -> tuple[float, float, float, float] | None:
    """Return the area of a CRS; WKT1 states none, but mostly a code by which it can be looked up."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if facts.crs is None or facts.horizontal is None:
        return None
    for crs in (unbound(facts.horizontal), unbound(facts.crs)):
        if crs.area_of_use is not None:
            return crs.area_of_use.bounds
        code = crs.to_epsg()
        if code is not None:
            try:
                area = CRS.from_epsg(code).area_of_use
            except CRSError:
                continue
            if area is not None:
                return area.bounds
    return None
