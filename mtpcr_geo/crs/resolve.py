"""Settling in which frame two clouds are registered."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.crs.link import FrameLink, WorkFrame
from mtpcr_geo.errors import CrsError, InputError

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.cloud.base import Cloud

Floats = NDArray[np.float64]
LOCAL = "local"
FARTHEST_APART = 100_000.0  # metres between the bounds of two clouds that claim the same CRS


def parse_crs(text: str) -> CRS | None:
    """Read what a user says of a CRS: ``EPSG:25832``, WKT, a PROJ string, or ``local``.

    Returns:
        The CRS, or None for ``local``.

    Raises:
        CrsError: if it cannot be understood.

    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if text.strip().lower() == LOCAL:
        return None
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise CrsError(
            f"{text!r} is not a coordinate reference system; say for example EPSG:25832, EPSG:7415 or local"
        ) from error


def resolve_frames(
    target: Cloud,
    source: Cloud,
    *,
    target_crs: str | CRS | None = None,
    source_crs: str | CRS | None = None,
    local: bool = False,
) -> tuple[WorkFrame, FrameLink, FrameLink]:
    """Settle in which frame two clouds are registered, and how each comes there.

    Each side is shifted by an origin of its own, whole metres near the middle of its bounds, so that a
    shift of a file by whole metres changes nothing in its work coordinates.

    Args:
        target: the cloud that stays; its CRS is what its file or reader states.
        source: the cloud that moves, likewise.
        target_crs: what the user says of the target instead: a CRS, its text, or "local".
        source_crs: what the user says of the source instead.
        local: both clouds are local, in metres, whatever the files say.

    Returns:
        The work frame, the target's link, the source's link.

    Raises:
        CrsError: if a CRS is missing, not handled, or the two do not go together.
        InputError: if the bounds make no sense.

    """
    target_side = None if local else _claimed(target, target_crs, "target")
    source_side = None if local else _claimed(source, source_crs, "source")
    for cloud, crs in ((target, target_side), (source, source_side)):
        if crs is not None:
            _require_projected_metric(cloud, crs)
    target_origin, source_origin = _origin(target), _origin(source)
    if target_side is not None and source_side is not None:
        _require_same(target_side, source_side)
        _require_near(target, source)
    return (
        WorkFrame(target_side, target_origin),
        FrameLink(target_side, target_origin),
        FrameLink(source_side, source_origin),
    )


def _claimed(cloud: Cloud, said: str | CRS | None, role: str) -> CRS | None:
    if isinstance(said, str):
        return parse_crs(said)
    crs = cloud.crs if said is None else said
    if crs is None:
        problem = getattr(cloud, "crs_problem", "") or "it says none"
        raise CrsError(
            f"the {role} {cloud.name} has no coordinate reference system ({problem}); "
            f"give --{role}-crs EPSG:..., or --{role}-crs local (--local for both clouds) "
            "if its coordinates are local metres"
        )
    return crs


def _require_projected_metric(cloud: Cloud, crs: CRS) -> None:
    if not crs.is_projected:
        raise CrsError(
            f"{cloud.name} is in {crs.name}, which is not a projected system; "
            "reproject it to one in metres first"
        )
    units = {axis.unit_name for axis in crs.axis_info}
    if units != {"metre"}:
        names = ", ".join(sorted(units))
        raise CrsError(f"{cloud.name} is in {crs.name} with units {names}; reproject it to metres first")


def same_place(one: CRS, other: CRS) -> bool:
    """Tell whether the same coordinates mean the same place in two CRSs, however their WKT is written."""
    if one.equals(other, ignore_axis_order=True):
        return True
    code = one.to_epsg()
    return code is not None and code == other.to_epsg()


def _require_same(target: CRS, source: CRS) -> None:
    if not same_place(target, source):
        raise CrsError(
            f"the target is in {target.name} and the source in {source.name}; reproject one of them first, "
            "or say with --target-crs or --source-crs what they are"
        )


def _origin(cloud: Cloud) -> Floats:
    if not (np.isfinite(cloud.minimum).all() and np.isfinite(cloud.maximum).all()):
        raise InputError(f"{cloud.name} has bounds that are not finite; check its header")
    middle = (cloud.minimum + cloud.maximum) / 2
    # the odd fraction keeps bounds on a decimal grid off the rounding edge, where a far shift could flip it
    return np.asarray(np.floor(middle + 0.123456))


def _require_near(target: Cloud, source: Cloud) -> None:
    gap = np.maximum(target.minimum - source.maximum, source.minimum - target.maximum)[:2]
    distance = float(np.linalg.norm(np.maximum(gap, 0.0)))
    if distance > FARTHEST_APART:
        raise CrsError(
            f"source and target claim the same CRS and lie {distance / 1000:.0f} km apart; check that they "
            "show the same place, or say --source-crs local if the source's coordinates are not in it"
        )
