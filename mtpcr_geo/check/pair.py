"""How two clouds lie to each other: their overlap, their heights, and points that both hold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from mtpcr_geo.check.findings import Finding
from mtpcr_geo.check.place import EXCHANGE, area_findings, exchanged, within_area
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.wording import beside
from mtpcr_geo.crs.resolve import FARTHEST_APART
from mtpcr_geo.method.scales import LEAST_OVERLAP_SHARE, MAX_LEAST_OVERLAP_M2

if TYPE_CHECKING:
    from mtpcr_geo.check.inspection import Inspection
    from mtpcr_geo.crs import FrameLink
    from mtpcr_geo.method.overlap import Overlap


MOST_CELLS = 4_000_000
FEET_A_METRE = 1.0 / 0.3048
FEWEST_CELLS = 50
DATUM_STEP_M, SMALL_STEP_M = 10.0, 2.0
SAME_POINTS = 0.2
SAME_STEP = 0.001  # of coordinates that are no whole numbers of steps
AERIAL_TIMES = 3.0  # by which an aerial cloud is wider, and sparser, than one from the ground
_COMPARED = 20_000


@dataclass(frozen=True)
class Relation:
    """Where two clouds lie to each other by their CRSs.

    Attributes:
        name: "overlapping", "apart" or "unknown".
        distance_m: how far apart in plan, metres; 0 where they overlap, None where unknown.
        overlap_m2: ground that both see; None where unknown.
        source_share, target_share: share of each cloud's ground that both see.
        why: why it is not known, or "".
        by_middles: whether the distance is that of their middles.

    """

    name: Literal["overlapping", "apart", "unknown"]
    distance_m: float | None = None
    overlap_m2: float | None = None
    source_share: float | None = None
    target_share: float | None = None
    why: str = ""
    by_middles: bool = False


def relate(source: Floats, target: Floats) -> tuple[Relation, Overlap | None]:
    """Return how two clouds lie to each other.

    Args:
        source, target: (n, 3) and (m, 3) samples in one frame, metres.

    Returns:
        The relation, and the overlap it rests on; None where even the bounds do not meet.

    """
    from scipy.spatial import cKDTree

    from mtpcr_geo.method.overlap import OVERLAP_CELL_M, overlap_of

    low = np.maximum(source.min(axis=0), target.min(axis=0))[:2]
    high = np.minimum(source.max(axis=0), target.max(axis=0))[:2]
    overlap = None
    if (low <= high).all():
        size = np.maximum(high - low, OVERLAP_CELL_M)
        # a sample of a large cloud leaves holes between its points
        sparsest = max(_spacing(source), _spacing(target))
        cell = max(OVERLAP_CELL_M, float(np.sqrt(size.prod() / MOST_CELLS)), sparsest / 2.0)
        overlap = overlap_of(source, target, cell)
        if overlap.area_m2 > 0:
            area = [_area(xyz, cell) for xyz in (source, target)]
            shared = overlap.area_m2
            relation = Relation(
                "overlapping", 0.0, shared, min(shared / area[0], 1.0), min(shared / area[1], 1.0)
            )
            return relation, overlap
    few = [xyz[:: max(1, len(xyz) // 100_000), :2] for xyz in (source, target)]
    distance, _ = cKDTree(few[0]).query(few[1])
    return Relation("apart", float(distance.min()), 0.0, 0.0, 0.0), overlap


def by_area(source: Inspection, target: Inspection) -> Relation:
    """Return roughly how far apart two clouds are that came to no common frame, from their middles."""
    from pyproj import Geod

    from mtpcr_geo.core.frames import box_points
    from mtpcr_geo.crs.operation import area_of

    for cloud in (source, target):
        if cloud.claim.facts is None:
            return Relation("unknown", why=f"the CRS of the {cloud.role} is not known")
    middles = []
    for cloud in (source, target):
        facts = cloud.claim.facts
        if facts is None or cloud.is_local:
            return Relation("unknown", why=f"the {cloud.role} has local coordinates")
        area = area_of(facts, box_points(cloud.bounds, 2)) if np.isfinite(cloud.bounds).all() else None
        if area is None:
            return Relation("unknown", why=f"the coordinates of the {cloud.role} are no place in its CRS")
        middles += [
            (area.west_lon_degree + area.east_lon_degree) / 2,
            (area.south_lat_degree + area.north_lat_degree) / 2,
        ]
    distance = float(Geod(ellps="WGS84").line_length(middles[0::2], middles[1::2]))
    if distance < FARTHEST_APART:
        return Relation("unknown", why="their CRSs do not go together")
    return Relation("apart", distance, 0.0, 0.0, 0.0, by_middles=True)


def _spacing(xyz: Floats) -> float:
    """Mean distance between neighbours, metres, were the points spread evenly over their bounds."""
    size = np.maximum(np.ptp(xyz[:, :2], axis=0), 1.0)
    return float(np.sqrt(size.prod() / len(xyz)))


def _area(xyz: Floats, cell: float) -> float:
    cells = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / cell).astype(np.int64)
    return float(len(np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]))) * cell**2


def relation_findings(relation: Relation, smaller_m2: float) -> Iterator[Finding]:
    """Yield what keeps clouds from being registered by where they lie: a gap, or little overlap.

    Args:
        relation: where they lie.
        smaller_m2: area of the smaller cloud, square metres.

    """
    least = min(LEAST_OVERLAP_SHARE * smaller_m2, MAX_LEAST_OVERLAP_M2)
    if relation.name == "apart" and relation.distance_m:
        yield Finding(
            "warning",
            "apart",
            "both",
            f"by their CRSs the clouds do not touch: {distance_text(relation.distance_m)} lie between them",
            "check that they show the same place; registering searches at any distance, but a wrong CRS "
            "also bends and scales",
        )
    elif relation.name == "overlapping" and (relation.overlap_m2 or 0.0) < least:
        shared, wanted = beside(relation.overlap_m2 or 0.0, least)
        yield Finding(
            "warning",
            "little-overlap",
            "both",
            f"by their CRSs they share {shared} square metres only, and a registration wants {wanted}",
            "give parts of them that share more",
        )


def distance_text(metres: float) -> str:
    """Put a distance in metres or kilometres."""
    if metres >= 100_000:
        return f"{metres / 1000:,.0f} km"
    return f"{metres / 1000:,.1f} km" if metres >= 1000 else f"{metres:.1f} m"


def height_pair_findings(overlap: Overlap, height: float) -> Iterator[Finding]:
    """Compare the heights of two clouds where both see the same ground: is one in feet, or off its datum.

    Args:
        overlap: what both see.
        height: metres to add to its heights for those of the CRS.

    """
    _, step = overlap.ground_steps()
    both = (overlap.source.count > 0) & (overlap.target.count > 0)
    source = overlap.source.low[both].astype(np.float64) + height
    target = overlap.target.low[both].astype(np.float64) + height
    if len(source) < FEWEST_CELLS:
        return
    feet = in_feet(source, target)
    if feet is not None:
        factor, role = feet
        yield Finding(
            "warning",
            "z-feet",
            role,
            f"where both see the same ground its heights are {factor:.2f} times those of the other: "
            "they seem to be in feet, and are taken as metres",
            f"name its CRS with heights in feet, such as --{role}-crs EPSG:...+6360",
        )
        return
    if len(step) < FEWEST_CELLS:
        return
    middle = float(np.median(step))
    spread = 1.4826 * float(np.median(np.abs(step - middle)))
    if abs(middle) <= SMALL_STEP_M or abs(middle) <= 3.0 * spread:
        return
    higher = "target" if middle > 0 else "source"
    if abs(middle) > DATUM_STEP_M:
        yield Finding(
            "warning",
            "z-offset",
            "both",
            f"where both see ground the {higher} is {abs(middle):.1f} m higher: one may have ellipsoidal "
            "heights, the other heights above sea level",
            "name the CRS of each with its vertical part (--source-crs, --target-crs); the registration "
            "solves a shift in height, but then it is no true datum",
        )
    else:
        yield Finding(
            "note",
            "z-offset",
            "both",
            f"where both see ground the {higher} is {abs(middle):.1f} m higher",
            "check the vertical datums, if you trust the heights of both",
        )


def in_feet(source: Floats, target: Floats) -> tuple[float, Literal["source", "target"]] | None:
    """Return whether one of two sets of heights of the same ground is in feet, the other in metres.

    Both how high they lie and how much they vary must differ by the factor, so that neither a shift of
    the datum nor trees in one of them can look like it.

    Args:
        source, target: (n,) heights at the same places.

    Returns:
        The factor and which one is in feet, or None.

    """
    relief = [float(np.subtract(*np.percentile(z, [95.0, 5.0]))) for z in (source, target)]
    level = [float(np.median(z)) for z in (source, target)]
    if min(relief) < 1.0 or min(map(abs, level)) < 5.0:
        return None
    varied, risen = relief[0] / relief[1], level[0] / level[1]
    for role, ratios in (("source", (varied, risen)), ("target", (1 / varied, 1 / risen))):
        if abs(ratios[0] / FEET_A_METRE - 1) < 0.25 and abs(ratios[1] / FEET_A_METRE - 1) < 0.05:
            return ratios[1], "source" if role == "source" else "target"
    return None


def link_findings(source: FrameLink, target: FrameLink) -> Iterator[Finding]:
    """Yield by which operation the source comes to the target's frame, and how its heights are taken."""
    report = source.report
    if source.pipeline is not None and source.georeferenced and target.georeferenced:
        accuracy = report.accuracy_m
        grids = ", ".join(report.grids)
        yield Finding(
            "note",
            "crs-different",
            "both",
            f"they are in different CRSs; the source comes to the target's by {report.operation} "
            f"({f'accuracy {accuracy:g} m' if accuracy is not None else 'accuracy not stated'}"
            f"{f', grids {grids}' if grids else ''})",
        )
    for note in report.height_notes:
        yield Finding("note", "vertical-taken", "both", note)


def lookalike_findings(source: Inspection, target: Inspection) -> Iterator[Finding]:
    """Yield that a cloud without a CRS has coordinates where those of the other one lie."""
    from mtpcr_geo.check.place import code_of

    box = [source.bounds[:, :2], target.bounds[:, :2]]
    apart = np.maximum(box[0][0] - box[1][1], box[1][0] - box[0][1])
    unknown = [one for one in (source, target) if one.claim.facts is None and one.cloud.crs is None]
    if not unknown or not (apart < 0).all() or all(one.seems_local for one in (source, target)):
        return
    if len(unknown) > 1:
        yield Finding(
            "note",
            "same-coordinates",
            "both",
            "as they stand their coordinates overlap: they seem to be in one CRS",
            "name it for both (--source-crs and --target-crs)",
        )
        return
    (one,) = unknown
    other = target if one is source else source
    facts = other.claim.facts
    if facts is None or not facts.georeferenced:
        return
    code = code_of(facts.crs)
    yield Finding(
        "note",
        "same-coordinates",
        one.role,
        f"its coordinates lie where those of the {other.role} do: it seems to be in its CRS, {facts.name}",
        f"give --{one.role}-crs {code or 'with that of the ' + other.role}, if it is",
    )


def result_findings(source: Inspection, target: Inspection) -> Iterator[Finding]:
    """Yield that a result has no CRS, where the target has none and the source does."""
    if target.is_local and source.claim.facts is not None and not source.is_local:
        yield Finding(
            "note",
            "target-local",
            "target",
            "it is local, so that the result has local coordinates and no CRS, though the source has one",
            "exchange the two clouds, if the result shall be in the source's CRS",
        )
    elif target.seems_local and source.claim.facts is not None and source.claim.facts.georeferenced:
        yield Finding(
            "warning",
            "exchanged",
            "both",
            "the source has a CRS, and the target looks local: are they the wrong way round? It is the "
            "source that moves, and the result would have local coordinates",
            "name the local cloud first, and the one with the CRS second",
        )


def exchanged_findings(source: Inspection, target: Inspection) -> Iterator[Finding]:
    """Yield that the source looks like the aerial cloud of the two: far wider and far sparser."""
    one, other = source.measured, target.measured
    if one is None or other is None:
        return
    if one.area_m2 > AERIAL_TIMES * other.area_m2 and AERIAL_TIMES * one.per_m2 < other.per_m2:
        yield Finding(
            "note",
            "exchanged",
            "both",
            f"the source looks aerial: it covers {one.area_m2:,.0f} m2 with {one.per_m2:.3g} points per m2, "
            f"the target {other.area_m2:,.0f} m2 with {other.per_m2:.3g}; it is the source that moves",
            "exchange them, if the other one shall move",
        )


def swapped_findings(source: Inspection, target: Inspection) -> Iterator[Finding]:
    """Find x and y exchanged in one cloud against the other: apart as they stand, together if exchanged."""
    if source.claim.facts is None or target.claim.facts is None:
        return
    if "local" in (source.claim.facts.kind, target.claim.facts.kind):
        return
    if _meet(source, target, ()):
        return
    for cloud, role in ((source, "source"), (target, "target")):
        if cloud.claim.facts is None or list(area_findings(cloud.claim.facts, cloud.bounds, "both")):
            continue  # reported already
        other_way = within_area(cloud.claim.facts, exchanged(cloud.bounds))
        if other_way is not False and _meet(source, target, (role,)):
            yield Finding(
                "warning",
                "axes-swapped",
                "source" if role == "source" else "target",
                "x and y seem exchanged: as they stand the clouds are far from each other, with x and y of "
                f"the {role} exchanged they lie together",
                EXCHANGE,
            )
            return


def _meet(source: Inspection, target: Inspection, turned: tuple[str, ...]) -> bool:
    """Return whether the bounds of two clouds come near each other, x and y exchanged in those named."""
    from mtpcr_geo.core.cloud import ArrayCloud
    from mtpcr_geo.core.errors import MtpcrError
    from mtpcr_geo.crs import resolve_frames

    boxes = [
        ArrayCloud(exchanged(cloud.bounds) if cloud.role in turned else cloud.bounds)
        for cloud in (source, target)
    ]
    crs = [cloud.claim.facts.crs if cloud.claim.facts is not None else None for cloud in (source, target)]
    try:
        frame, to_target, to_source = resolve_frames(
            boxes[1], boxes[0], target_crs=crs[1], source_crs=crs[0], vertical="assume-same"
        )
        if frame.crs is None:
            return False
        corners = [
            link.to_work(box.xyz) + link.origin
            for link, box in ((to_source, boxes[0]), (to_target, boxes[1]))
        ]
    except MtpcrError:
        return False
    low = [part.min(axis=0)[:2] for part in corners]
    high = [part.max(axis=0)[:2] for part in corners]
    near = float(max(np.ptp(part[:, :2], axis=0).max() for part in corners))
    return bool((np.maximum(low[0] - high[1], low[1] - high[0]) <= near).all())


def same_points_findings(source: Inspection, target: Inspection) -> Iterator[Finding]:
    """Find points that stand in both clouds, coordinate by coordinate: a cloud fits itself perfectly."""
    if source.scan is None or target.scan is None:
        return
    step = max(
        float(np.max(getattr(getattr(one.cloud, "header", None), "scales", 0.001)))
        for one in (source, target)
    )
    farthest = max(float(np.abs(one.scan.sample).max(initial=0.0)) for one in (source, target) if one.scan)
    if not step > farthest / 2**62:
        return
    few = source.scan.sample[:: max(1, len(source.scan.sample) // _COMPARED)]
    there = {row.tobytes() for row in np.rint(target.scan.sample / step).astype(np.int64)}
    found = sum(row.tobytes() in there for row in np.rint(few / step).astype(np.int64))
    # both samples of one file are the same points; others hit a sample by its share of the cloud
    kept = (
        1.0 if len(there) == 0 else len(target.scan.sample) / max(target.scan.count - target.scan.dropped, 1)
    )
    share = found / len(few)
    if share < SAME_POINTS * kept:
        return
    share = min(share / kept, 1.0)
    yield Finding(
        "warning",
        "same-points",
        "both",
        f"about {share:.0%} of the source's points stand in the target too, coordinate by coordinate: "
        "they fit by themselves, which proves nothing",
        "give two clouds that were measured independently",
    )
