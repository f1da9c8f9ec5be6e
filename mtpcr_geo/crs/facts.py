"""What a coordinate reference system states about coordinates: kind, units, height, datum."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

from mtpcr_geo.core.errors import CrsError
from mtpcr_geo.core.scanner import PLAIN, Scanner
from mtpcr_geo.crs.faults import crs_errors

if TYPE_CHECKING:
    from pyproj import CRS

# what stands for a vertical datum where none is known, in letters alone
_NO_NAMES = {"", "unknown", "unnamed", "undefined", "notspecified", "notspecifiedbasedonunspecifiedellipsoid"}
_NOT_SPECIFIED = "notspecified"
# metres or radians a unit: from micrometres to light years, or to a tenth of a microsecond of arc
_SMALLEST_UNIT, _LARGEST_UNIT = 1e-13, 1e17

Kind = Literal["projected", "geographic", "geocentric", "local"]
Height = Literal["datum", "ellipsoidal", "unsaid"]


@dataclass(frozen=True)
class CrsFacts:
    """A CRS, taken apart.

    Attributes:
        crs: the whole CRS, or None for local metres.
        kind: what its horizontal part is; engineering systems are local.
        horizontal: the horizontal part, two axes; a bound one keeps its shift parameters. None if local.
        unit: metres a horizontal unit (projected, geocentric, local), or degrees a unit (geographic).
        unit_name: of the horizontal unit.
        height: heights above a named vertical datum, above the ellipsoid, or nothing stated ("unsaid").
        vertical: the vertical CRS where there is one.
        height_unit: metres a unit of height.
        height_unit_name: of the unit of height.
        height_unit_stated: whether the CRS states that unit, and it is not taken from the plan.
        scanner: unit and axes declared for local coordinates.

    """

    crs: CRS | None
    kind: Kind
    horizontal: CRS | None
    unit: float
    unit_name: str
    height: Height
    vertical: CRS | None
    height_unit: float
    height_unit_name: str
    height_unit_stated: bool = True
    scanner: Scanner = PLAIN

    @property
    def name(self) -> str:
        """Return what to call it in messages."""
        return "local coordinates" if self.crs is None else self.crs.name

    @property
    def georeferenced(self) -> bool:
        """Return whether it is tied to the earth: neither local coordinates nor an engineering system."""
        return self.kind != "local"

    @property
    def height_name(self) -> str:
        """Return what its heights refer to."""
        if self.vertical is not None:
            return str(self.vertical.name)
        if self.height == "ellipsoidal":
            return "ellipsoidal height"
        return "heights of no stated datum"


@crs_errors()
def facts_of(crs: CRS | None, scanner: Scanner = PLAIN) -> CrsFacts:
    """Take a CRS apart; None means local coordinates.

    Args:
        crs: the CRS.
        scanner: unit and axes of local coordinates; metres and z up if nothing is declared.

    Raises:
        CrsError: if it is of a kind, or has axes, that cannot be handled.

    """
    if crs is None:
        unit, name = scanner.metres, scanner.unit_name
        return CrsFacts(None, "local", None, unit, name, "unsaid", None, unit, name, True, scanner)
    horizontal, vertical = _parts(crs)
    plain = unbound(horizontal)
    axes = plain.axis_info
    if plain.is_geocentric:
        unit = _factor(axes[0])
        return CrsFacts(
            crs,
            "geocentric",
            horizontal,
            unit,
            axes[0].unit_name,
            "ellipsoidal",
            None,
            unit,
            axes[0].unit_name,
        )
    kind: Kind = "projected" if plain.is_projected else "geographic" if plain.is_geographic else "local"
    if kind == "local" and plain.type_name != "Engineering CRS":
        raise CrsError(
            f"{crs.name} is a {plain.type_name}, in which clouds cannot be registered; "
            "name a projected, geographic, geocentric or local system"
        )
    _check_axes(crs.name, axes[:2])
    unit, unit_name = _factor(axes[0]), axes[0].unit_name
    if kind == "geographic":
        unit *= 180.0 / 3.141592653589793
    height: Height = "unsaid"
    height_unit, height_unit_name = (1.0, "metre") if kind == "geographic" else (unit, unit_name)
    unit_stated = vertical is not None or len(axes) == 3
    if vertical is not None:
        axis = unbound(vertical).axis_info[0]
        if axis.direction.lower() != "up":
            raise CrsError(f"{vertical.name} counts {axis.direction}, not up; reproject the heights first")
        height_unit, height_unit_name = _factor(axis), axis.unit_name
        if _is_nameless(vertical):
            vertical = None  # it states a unit, and no datum
        else:
            height = "datum"
    elif len(axes) == 3:
        height = "unsaid" if kind == "local" else "ellipsoidal"
        height_unit, height_unit_name = _factor(axes[2]), axes[2].unit_name
    if len(axes) == 3 and kind != "local":
        horizontal = horizontal.to_2d()
    return CrsFacts(
        crs=crs,
        kind=kind,
        horizontal=None if kind == "local" else horizontal,
        unit=unit,
        unit_name=unit_name,
        height=height,
        vertical=vertical,
        height_unit=height_unit,
        height_unit_name=height_unit_name,
        height_unit_stated=unit_stated,
    )


def _is_nameless(vertical: CRS) -> bool:
    """Return whether a vertical CRS has a datum that is none, put where the unit alone was known."""
    datum = unbound(vertical).datum
    name = _letters("" if datum is None else datum.name)
    return name in _NO_NAMES or (name.startswith(_NOT_SPECIFIED) and not vertical.name.strip())


def unbound(crs: CRS) -> CRS:
    """Return the CRS without the shift to another datum that a bound one carries."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


@crs_errors()
def metric(crs: CRS) -> CRS:
    """Return the same projected or vertical CRS in metres; itself if it is. A bound one stays bound."""
    from pyproj import CRS
    from pyproj.crs import BoundCRS

    plain = unbound(crs)
    if plain is not crs:
        rewritten = metric(plain)
        return crs if rewritten is plain else BoundCRS(rewritten, crs.target_crs, crs.coordinate_operation)
    if all(abs(_factor(axis) - 1.0) < 1e-15 for axis in plain.axis_info):
        return plain
    data: dict[str, Any] = plain.to_json_dict()
    for axis in data["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    data.pop("id", None)
    data["name"] = f"{plain.name} in metres"
    return CRS.from_json_dict(data)


def same_place(one: CRS, other: CRS) -> bool:
    """Return whether the same coordinates mean the same place in two CRSs, however their WKT is written."""
    if one.equals(other, ignore_axis_order=True):
        return True
    code = one.to_epsg()
    if code is not None and code == other.to_epsg():
        return True
    try:
        return _signature(facts_of(one)) == _signature(facts_of(other))
    except CrsError:
        return False


def leaves_heights_open(one: CRS, whole: CRS) -> bool:
    """Return whether a CRS is the horizontal part of another one, and states nothing of heights.

    Args:
        one: it.
        whole: a CRS with a vertical part, or with ellipsoidal heights.

    """
    try:
        facts, other = facts_of(one), facts_of(whole)
    except CrsError:
        return False
    if facts.horizontal is None or other.horizontal is None or facts.height != "unsaid":
        return False
    # unsaid heights are in the unit of the plan
    if abs(facts.height_unit / other.height_unit - 1.0) > 1e-9:
        return False
    return facts.kind == other.kind and same_place(facts.horizontal, other.horizontal)


def same_heights(one: CrsFacts, other: CrsFacts) -> bool:
    """Return whether two CRSs count heights from the same surface, whatever their units."""
    if one.height != other.height:
        return False
    if one.vertical is None or other.vertical is None:
        return one.vertical is other.vertical
    return _vertical_datum(one.vertical) == _vertical_datum(other.vertical)


def same_datum(one: CrsFacts, other: CrsFacts) -> bool:
    """Return whether two CRSs rest on the same geodetic datum."""
    if one.horizontal is None or other.horizontal is None:
        return False
    return _datum(one.horizontal) == _datum(other.horizontal)


@lru_cache(maxsize=64)
def _signature(facts: CrsFacts) -> tuple[Any, ...]:
    """Reduce a CRS to what decides about places: projection with its parameters in metres, datum, units."""
    common = (
        facts.kind,
        f"{facts.unit:.12g}",
        facts.height,
        f"{facts.height_unit:.12g}",
        None if facts.vertical is None else _vertical_datum(facts.vertical),
    )
    if facts.horizontal is None:
        return common
    plain = unbound(facts.horizontal)
    operation = plain.coordinate_operation if plain.is_projected else None
    parameters: tuple[Any, ...] = ()
    if operation is not None:
        # ten micrometres or 1e-10 degrees: how different writers round false origins in feet
        parameters = (
            _letters(operation.method_name),
            *sorted(
                (
                    _letters(parameter.name),
                    _rounded(parameter.value, parameter.unit_conversion_factor),
                )
                for parameter in operation.params
            ),
        )
    return (*common, _datum(facts.horizontal), parameters)


def _rounded(value: Any, factor: float) -> float:
    return round(float(value) * (factor or 1.0), 5) if isinstance(value, int | float) else 0.0


def _datum(horizontal: CRS) -> tuple[str, str, str]:
    plain = unbound(horizontal)
    ellipsoid = plain.ellipsoid
    size = "" if ellipsoid is None else f"{ellipsoid.semi_major_metre:.3f}/{ellipsoid.inverse_flattening:.6f}"
    name = "" if plain.datum is None else _letters(plain.datum.name.removesuffix(" ensemble"))
    meridian = plain.prime_meridian
    return name, size, "" if meridian is None else f"{meridian.longitude:.9f}"


def _vertical_datum(vertical: CRS) -> str:
    plain = unbound(vertical)
    return _letters(plain.datum.name if plain.datum is not None else plain.name)


def _letters(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _parts(crs: CRS) -> tuple[CRS, CRS | None]:
    whole = unbound(crs) if crs.is_bound and unbound(crs).is_compound else crs
    if not whole.is_compound:
        return whole, None
    horizontal, vertical, *rest = whole.sub_crs_list
    if rest or not unbound(vertical).is_vertical:
        raise CrsError(
            f"{crs.name} is composed of more than a horizontal and a vertical system; name a simpler one"
        )
    return horizontal, vertical


def _factor(axis: Any) -> float:
    factor = float(axis.unit_conversion_factor)
    if not _SMALLEST_UNIT <= factor <= _LARGEST_UNIT:
        raise CrsError(f"a unit of {factor:g} metres or radians, as a CRS states it, is none; check its WKT")
    return factor


def _check_axes(name: str, axes: list[Any]) -> None:
    directions = {axis.direction.lower() for axis in axes}
    # polar grids have both axes pointing the same way, along two meridians
    if directions & {"west"} or directions == {"south", "east"}:
        raise CrsError(
            f"the axes of {name} point {' and '.join(sorted(directions))}, which is not handled; "
            "reproject to a system of easting and northing"
        )
