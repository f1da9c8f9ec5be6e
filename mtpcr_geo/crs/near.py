"""Places that a user names: into the target's coordinates, and whether they can be meant."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import CrsError, OptionError
from mtpcr_geo.core.frames import FrameLink
from mtpcr_geo.crs.facts import facts_of, same_place
from mtpcr_geo.crs.faults import crs_errors
from mtpcr_geo.crs.operation import area_of
from mtpcr_geo.crs.resolve import parse_crs

if TYPE_CHECKING:
    from pyproj import CRS

Place = tuple[float, float]


def place_in_work(near: Place, near_crs: str | None, link: FrameLink, height: float = 0.0) -> Floats:
    """Return a place that the user named in the target's work coordinates, (3,) metres.

    Args:
        near: x and y of it; easting before northing, longitude before latitude.
        near_crs: the CRS they are in; that of the target's file if None.
        link: between the target's file and work coordinates.
        height: of the place, in the target's work coordinates, metres.

    Raises:
        CrsError: if the CRS cannot be used, or the place lies outside of it.

    """
    x, y = near if near_crs is None else _in_target_crs(near, near_crs, link)
    z = float(link.to_file(np.array([[0.0, 0.0, height]]))[0, 2])
    facts = facts_of(link.file_crs)
    if facts.kind == "geocentric":
        raise CrsError(
            f"a place in plan is not defined in {facts.name}, which is geocentric; "
            "give --near-crs EPSG:4326 with longitude and latitude"
        )
    try:
        found = link.to_work(np.array([[x, y, z]]))[0]
    except CrsError as error:
        raise CrsError(
            f"--near {near[0]:g} {near[1]:g} is no place in {facts.name}; {_order(facts.kind)}"
        ) from error
    found[2] = height
    return np.asarray(found)


def check_reach(
    place: Floats,
    radius_m: float,
    rim_m: float,
    bounds: Floats,
    near: Place,
    link: FrameLink,
    declared: bool,
) -> None:
    """Refuse a place from which the source cannot reach the target.

    Args:
        place: (3,) the place, target work coordinates, metres.
        radius_m: how far from there the middle of the source may lie.
        rim_m: how far the source reaches from its middle.
        bounds: (2, 3) of the target, work coordinates.
        near: the place as the user gave it.
        link: between the target's file and work coordinates.
        declared: whether the user named a CRS for it.

    Raises:
        OptionError: saying how far off it is, and what may be meant.

    """
    gap = distance_to_box(place, bounds)
    if gap <= radius_m + rim_m:
        return
    far = f"{gap / 1000:,.1f} km" if gap >= 1000 else f"{gap:.0f} m"
    hint = "check it, and its CRS, or give a larger --within"
    if not declared:
        if _hits(near[::-1], None, link, bounds, radius_m + rim_m):
            hint = f"x and y seem exchanged: try --near {near[1]:.10g} {near[0]:.10g}"
        elif _hits(near, "EPSG:4326", link, bounds, radius_m + rim_m):
            hint = "it is longitude and latitude in degrees: add --near-crs EPSG:4326"
        elif _hits(near[::-1], "EPSG:4326", link, bounds, radius_m + rim_m):
            hint = (
                "it is latitude and longitude in degrees, and longitude comes first: try "
                f"--near {near[1]:.10g} {near[0]:.10g} --near-crs EPSG:4326"
            )
    raise OptionError(
        f"--near {near[0]:.10g} {near[1]:.10g} lies {far} outside the target, and the source reaches only "
        f"{radius_m + rim_m:.0f} m from there; {hint}"
    )


def rim_of(xyz: Floats, middle: Floats) -> float:
    """Return how far (n, 3) points reach from their middle in plan, metres."""
    return float(np.sqrt(((xyz[:, :2] - middle[:2]) ** 2).sum(axis=1).max()))


def distance_to_box(place: Floats, bounds: Floats) -> float:
    """Return how far a place lies outside a box in plan, metres; 0 inside."""
    gap = np.maximum(np.maximum(bounds[0] - place, place - bounds[1]), 0.0)
    return float(np.hypot(gap[0], gap[1]))


def _hits(near: Place, crs: str | None, link: FrameLink, bounds: Floats, reach: float) -> bool:
    """Return whether a place, read another way, would do."""
    if crs is not None and not link.georeferenced:
        return False
    try:
        place = place_in_work(near, crs, link)
    except CrsError:
        return False
    return distance_to_box(place, bounds) <= reach


@crs_errors()
def _in_target_crs(near: Place, text: str, link: FrameLink) -> Place:
    named = parse_crs(text)
    target = facts_of(link.file_crs)
    if named is None:
        raise CrsError("--near-crs local says nothing; leave it out for coordinates of the target itself")
    if target.horizontal is None:
        raise CrsError(
            "--near-crs needs a target with a coordinate reference system; give --target-crs, or the place "
            "in the target's own coordinates"
        )
    facts = facts_of(named)
    if facts.horizontal is None or facts.kind == "geocentric":
        raise CrsError(f"--near-crs {facts.name} has no plan; name a projected or geographic system")
    if same_place(facts.horizontal, target.horizontal):
        return near
    area = area_of(facts, np.array([[*near, 0.0]]))
    if area is None:
        raise CrsError(f"--near {near[0]:g} {near[1]:g} is no place in {facts.name}; {_order(facts.kind)}")
    x, y = _moved(near, facts.horizontal, target.horizontal)
    if not np.isfinite([x, y]).all():
        raise CrsError(
            f"--near {near[0]:g} {near[1]:g} in {facts.name} is no place in {target.name}; "
            f"{_order(facts.kind)}"
        )
    return x, y


def _moved(near: Place, start: CRS, end: CRS) -> Place:
    """Take a place to another CRS by the best operation at hand; a metre is good enough for a place."""
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    try:
        with warnings.catch_warnings():
            # a grid that is missing costs a metre or so, which does not matter here
            warnings.simplefilter("ignore", UserWarning)
            group = TransformerGroup(start, end, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise CrsError(f"PROJ knows no operation from {start.name} to {end.name}: {error}") from error
    for one in group.transformers:
        x, y = one.transform(near[0], near[1], errcheck=False)[:2]
        if np.isfinite([x, y]).all():
            return float(x), float(y)
    if not group.transformers:
        raise CrsError(
            f"PROJ knows no operation from {start.name} to {end.name} without a grid that is not installed; "
            "give --near in the target's CRS"
        )
    return np.inf, np.inf


def _order(kind: str) -> str:
    if kind == "geographic":
        return "longitude comes before latitude, in the CRS's units"
    return "easting comes before northing"
