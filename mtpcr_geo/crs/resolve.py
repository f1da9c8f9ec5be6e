"""The frame in which two clouds are registered, and how each is converted to it and back."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.core.frames import FrameLink, OperationReport, Vertical, WorkFrame, box_points, run_pipeline
from mtpcr_geo.core.scanner import PLAIN, Scanner
from mtpcr_geo.crs.facts import CrsFacts, facts_of, metric, same_datum, same_heights, same_place, unbound
from mtpcr_geo.crs.faults import crs_errors
from mtpcr_geo.crs.operation import area_of, best_operation, grid_scale, local_projection

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.cloud import Cloud

LOCAL = "local"
SCALE_NOTED, SCALE_REFUSED = 0.002, 0.01  # departure of a map's metre from a metre on the ground
FARTHEST_APART = 100_000.0  # metres between the bounds of two clouds that both claim a place on earth


def parse_crs(text: str) -> CRS | None:
    """Return the CRS that a text names: ``EPSG:25832``, WKT, a PROJ string, or ``local``.

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
        with warnings.catch_warnings():
            # pyproj would have "+init=epsg:25832" written in another way
            warnings.simplefilter("ignore", FutureWarning)
            return CRS.from_user_input(text)
    except (CRSError, UnicodeError) as error:
        raise CrsError(
            f"{_short(text)} is not a coordinate reference system; give for example EPSG:25832, EPSG:7415 or "
            "local"
        ) from error


def _short(text: str) -> str:
    quoted = repr(text)
    return quoted if len(quoted) <= 100 else f"{quoted[:60]}...{quoted[-37:]}"


@crs_errors()
def resolve_frames(
    target: Cloud,
    source: Cloud,
    *,
    target_crs: str | CRS | None = None,
    source_crs: str | CRS | None = None,
    local: bool = False,
    vertical: Vertical = "refuse",
    out_crs: str | CRS | None = None,
    target_bounds: Floats | None = None,
    source_bounds: Floats | None = None,
    target_scanner: Scanner = PLAIN,
    source_scanner: Scanner = PLAIN,
) -> tuple[WorkFrame, FrameLink, FrameLink]:
    """Return the frame in which two clouds are registered, and how each is converted to it.

    The work frame is the target's projection in metres, or for geographic and geocentric targets a
    transverse Mercator of true scale in their middle; its heights are the target's, in metres. The source
    comes there by the best operation that PROJ has. Each side is shifted by an origin of its own, whole
    metres near the middle of its bounds, so that a shift of a file by whole metres changes nothing.

    Args:
        target: the cloud that stays; its CRS is what its file or reader states.
        source: the cloud that moves, likewise.
        target_crs: the CRS to use for the target instead: a CRS, its text, or "local".
        source_crs: the same for the source.
        local: both clouds are local, in metres, whatever the files state.
        vertical: what to do where heights have different or unknown datums: "refuse"; "assume-same" takes
            them as equal; "estimate" takes them as they are and leaves the offset to the registration.
        out_crs: CRS of the result where that is not the target's.
        target_bounds: (2, 3) least and greatest coordinates of the target's points, where they are known;
            what its header states if None.
        source_bounds: the same of the source.
        target_scanner: unit and axes of the target, where it is local.
        source_scanner: the same of the source.

    Returns:
        The work frame (with the way out to `out_crs` as its `output`), the target's and the source's link.

    Raises:
        CrsError: if a CRS is missing or not handled, a grid is missing, or the two do not go together.
        InputError: if the bounds make no sense.

    """
    target_facts = facts_of(None if local else _claimed(target, target_crs, "target"), target_scanner)
    source_facts = facts_of(None if local else _claimed(source, source_crs, "source"), source_scanner)
    _require_local(target_facts, target_scanner, "target")
    _require_local(source_facts, source_scanner, "source")
    target_bounds = _bounds(target) if target_bounds is None else target_bounds
    source_bounds = _bounds(source) if source_bounds is None else source_bounds

    work = _work_crs(target_facts, target_bounds)
    target_link = _link(target_facts, work, target_facts, target_bounds, "assume-same")
    if not (target_facts.georeferenced and source_facts.georeferenced):
        source_work = _work_crs(source_facts, source_bounds)
        source_link = _link(source_facts, source_work, source_facts, source_bounds, "assume-same")
        source_link = _with_scale(source_link, source_facts, source_work, beside_local=True)
        target_link = _with_scale(target_link, target_facts, work, beside_local=True)
    else:
        source_link = _link(source_facts, work, target_facts, source_bounds, vertical)
        target_link = _with_scale(target_link, target_facts, work, beside_local=False)
        _require_near(target_link, source_link)
    frame = WorkFrame(None if work is None else unbound(work), target_link.origin)
    if out_crs is not None:
        frame = replace(frame, output=_output(out_crs, frame, target_link, target_facts, vertical))
    return frame, target_link, source_link


def _require_local(facts: CrsFacts, scanner: Scanner, role: str) -> None:
    """Refuse a unit or axes for a cloud whose CRS states both.

    Raises:
        CrsError: naming the option.

    """
    for option, given in (("unit", scanner.unit is not None), ("axes", scanner.axes != "z-up")):
        if given and facts.crs is not None:
            raise CrsError(
                f"--{role}-{option} is for local coordinates, and the {role} is in {facts.name}, which "
                f"states its own; give --{role}-crs local too, if that does not hold"
            )


def _claimed(cloud: Cloud, declared: str | CRS | None, role: str) -> CRS | None:
    if isinstance(declared, str):
        return parse_crs(declared)
    crs = cloud.crs if declared is None else declared
    if crs is None:
        problem = getattr(cloud, "crs_problem", "") or "it states none"
        raise CrsError(
            f"the {role} {cloud.name} has no coordinate reference system ({problem}); "
            f"give --{role}-crs EPSG:..., or --{role}-crs local (--local for both clouds) "
            "if its coordinates are local metres"
        )
    return crs


def _bounds(cloud: Cloud) -> Floats:
    bounds = np.stack([cloud.minimum, cloud.maximum]).astype(np.float64)
    if not np.isfinite(bounds).all():
        raise InputError(f"{cloud.name} has bounds that are not finite; check its header")
    return bounds


def _work_crs(facts: CrsFacts, bounds: Floats) -> CRS | None:
    from pyproj.crs import BoundCRS

    if facts.horizontal is None:
        return None
    if facts.kind == "projected":
        return metric(facts.horizontal)
    area = area_of(facts, box_points(bounds, 2))
    if area is None:
        raise CrsError(
            f"coordinates like {bounds[0].tolist()} are no place in {facts.name}; check the CRS, "
            "or whether x and y are swapped"
        )
    made = local_projection(facts, area)
    bound = facts.horizontal
    return BoundCRS(made, bound.target_crs, bound.coordinate_operation) if bound.is_bound else made


def _link(
    facts: CrsFacts, work: CRS | None, heights: CrsFacts, bounds: Floats, vertical: Vertical
) -> FrameLink:
    """Return the link from a cloud's CRS to the horizontal work CRS and the heights of another CRS."""
    factor = np.array([facts.unit, facts.unit, facts.height_unit])
    pipeline: str | None = None
    report = OperationReport()
    height_notes: list[str] = []
    if work is not None and facts.horizontal is not None:
        agree = _heights_agree(facts, heights, vertical, height_notes)
        start, end, solid = _ends(facts, work, heights, agree)
        if solid or facts.kind != "projected" or not same_place(metric(facts.horizontal), work):
            operation = best_operation(start, end, area_of(facts, box_points(bounds, 2)))
            pipeline, report = operation.pipeline, operation.report
            factor = np.ones(3) if solid else np.array([1.0, 1.0, facts.height_unit])
    if factor[:2].tolist() == [1.0, 1.0] and factor[2] == 1.0 and pipeline is None:
        report = replace(report, operation="none: the file is in the work frame's metres")
    report = replace(
        report,
        heights=facts.height_name,
        vertical=vertical,
        height_notes=tuple(height_notes),
        unit_notes=_unit_notes(facts),
    )
    link = FrameLink(
        facts.crs, np.zeros(3), factor, pipeline, bounds, report, facts.georeferenced, facts.scanner
    )
    return replace(link, origin=_origin(link, bounds))


def _ends(facts: CrsFacts, work: CRS, heights: CrsFacts, agree: bool) -> tuple[CRS, CRS, bool]:
    """Return the two CRSs between which PROJ works, and whether heights go through it too."""
    from pyproj.crs import CompoundCRS

    if facts.crs is None or facts.horizontal is None:
        raise ValueError("a local frame has no coordinate operations")
    work_or_bound, work = work, unbound(work)
    if agree and facts.kind != "geocentric":
        return facts.horizontal, work_or_bound, False
    if heights.height == "datum" and heights.vertical is not None and not agree:
        level = metric(heights.vertical)
        return facts.crs, CompoundCRS(f"{work.name} + {level.name}", components=[work, level]), True
    return facts.crs, work.to_3d(), True


def _heights_agree(facts: CrsFacts, other: CrsFacts, vertical: Vertical, notes: list[str]) -> bool:
    """Return whether heights can be taken over as they are; note why, or refuse.

    Raises:
        CrsError: if the datums differ in a way that no operation can settle.

    """
    if same_heights(facts, other):
        if facts.height == "unsaid" and facts is not other and vertical == "refuse":
            notes.append(
                "neither cloud states what its heights are above: taken as above the same surface; "
                "a shift between them is solved with the rest"
            )
        return facts.height != "ellipsoidal" or same_datum(facts, other)
    if vertical != "refuse":
        how = "taken as equal" if vertical == "assume-same" else "their offset is left to the registration"
        notes.append(f"heights differ in kind ({facts.height_name}; {other.height_name}): {how}")
        return True
    if "unsaid" in (facts.height, other.height):
        raise CrsError(
            f"heights do not go together: {facts.height_name} in {facts.name}, "
            f"{other.height_name} in {other.name}; name a CRS with its vertical part (such as EPSG:7415), "
            "or give --vertical assume-same or --vertical estimate"
        )
    return False


def _unit_notes(facts: CrsFacts) -> tuple[str, ...]:
    if facts.height != "unsaid" or facts.height_unit_stated or not facts.georeferenced:
        return ()
    return (f"the CRS states no unit of height: taken as {facts.height_unit_name}",)


def _origin(link: FrameLink, bounds: Floats) -> Floats:
    corners = link.metric(bounds) if link.pipeline is None else link.to_work(box_points(bounds, 3))
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    # the odd fraction keeps bounds on a decimal grid off the rounding edge, where a far shift could flip it
    return np.asarray(np.floor(middle + 0.123456))


def _with_scale(link: FrameLink, facts: CrsFacts, work: CRS | None, beside_local: bool) -> FrameLink:
    """Add to a link's report how true the metres of the work frame are.

    A local cloud has metres of the ground, which must go with them.

    Raises:
        CrsError: if a local cloud would have to be stretched.

    """
    if work is None or facts.kind != "projected" or link.bounds is None:
        return link
    area = area_of(facts, box_points(link.bounds, 2))
    scale = None if area is None else grid_scale(unbound(work), area)
    if scale is None:
        return link
    worst = max(scale, key=lambda one: abs(one - 1.0))
    stretch = f"a metre on the ground is {worst:.4f} m in {facts.name} here"
    if beside_local and abs(worst - 1.0) > SCALE_REFUSED:
        raise CrsError(
            f"{stretch}, and a local cloud has metres of the ground: no rigid transform fits both; "
            "reproject the other one to a system of true scale, such as its UTM zone"
        )
    notes = link.report.unit_notes
    if abs(worst - 1.0) > SCALE_NOTED:
        notes = (*notes, f"{stretch}: distances in metres are off by that")
    return replace(link, report=replace(link.report, unit_notes=notes, grid_scale=scale))


def _require_near(target: FrameLink, source: FrameLink) -> None:
    boxes = []
    for link in (target, source):
        if link.bounds is None:
            continue
        corners = link.to_work(box_points(link.bounds, 3))[:, :2] + link.origin[:2]
        boxes.append((corners.min(axis=0), corners.max(axis=0)))
    (low, high), (other_low, other_high) = boxes
    gap = np.maximum(np.maximum(low - other_high, other_low - high), 0.0)
    distance = float(np.linalg.norm(gap))
    if distance > FARTHEST_APART:
        raise CrsError(
            f"by their CRSs, source and target lie {distance / 1000:.0f} km apart; check that they show the "
            "same place, or give --source-crs local if the source's coordinates are not in its CRS"
        )


def _output(
    declared: str | CRS, frame: WorkFrame, target: FrameLink, target_facts: CrsFacts, vertical: Vertical
) -> FrameLink:
    """Return the link from the target's work coordinates to a CRS that the user wants."""
    crs = parse_crs(declared) if isinstance(declared, str) else declared
    if crs is None or frame.crs is None or target_facts.horizontal is None or target.bounds is None:
        raise CrsError(
            "--out-crs needs a target with a coordinate reference system, and one to go to; "
            "leave it out, or give --target-crs"
        )
    if target_facts.crs is not None and same_place(crs, target_facts.crs):
        return target
    facts = facts_of(crs)
    if facts.horizontal is None:
        raise CrsError(f"--out-crs {crs.name} is no place on earth; name a projected or geographic system")
    area = area_of(target_facts, box_points(target.bounds, 2))
    there = best_operation(frame.crs, facts.horizontal, area)
    corners = target.to_work(box_points(target.bounds, 3)) + target.origin
    if there.pipeline is not None:
        corners = run_pipeline(there.pipeline, corners)
    corners[:, 2] /= facts.height_unit
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    return replace(_link(facts, frame.crs, target_facts, bounds, vertical), origin=target.origin)
