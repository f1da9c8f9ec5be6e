"""The links between both clouds as a GeoPackage: tie points, residuals, footprints, hypotheses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export import styles
from mtpcr_geo.export.geopackage import Layer, write_geopackage
from mtpcr_geo.export.raster_styles import qml

Fields = dict[str, NDArray[Any]]

ALIASES = {
    "tie_point": "Tie point",
    "plan_m": "Distance in plan (m)",
    "residual_m": "Distance in space (m)",
    "dx_m": "East, source minus target (m)",
    "dy_m": "North, source minus target (m)",
    "dz_m": "Height, source minus target (m)",
    "score": "Score",
    "inlier": "Agrees with the transform",
    "held_out": "Held out from the solve",
    "spacing_m": "Stands for others within (m)",
    "source_x": "Source x, as in its file",
    "source_y": "Source y, as in its file",
    "source_z": "Source z, as in its file",
    "role": "Cloud is",
    "cloud": "File",
    "points": "Points",
    "rank": "Rank",
    "yaw_deg": "Turned by (degrees)",
    "shift_x_m": "Shift x, levelled frames (m)",
    "shift_y_m": "Shift y, levelled frames (m)",
    "overlap_cells": "Cells that both would fill",
}
"""What a GIS shows for each field of the layers."""

_FOOTPRINT_POINTS = 40_000
_AT_A_TIME = 256
_PLACED_POINTS = 4_000
_ARROW_SHARE = 0.02
_ROUND = (1.0, 2.0, 5.0)


def write_tie_points(path: str | Path, pair: Pair) -> None:
    """Write what links the clouds, as far as the run came, for viewing in a GIS.

    Layers, all in the CRS of the work frame (the target's; none for local clouds), coordinates absolute:

    - ``tie_points``: 3D points at the target's end, with ``plan_m`` and ``residual_m``, the distance of both
      ends in plan and in space (its parts ``dx_m``, ``dy_m``, ``dz_m``: registered source minus target),
      ``score``, ``inlier``, ``held_out``, ``spacing_m``, the distance to the nearest tie point of a higher
      score, by which they thin out on small maps, and the source's coordinates as they stand in its file;
    - ``links``: 3D lines from the registered source's end to the target's end of each tie point;
    - ``footprints``: convex outlines of the target and of the registered source;
    - ``hypotheses``: the middle of what both clouds would share under each candidate pose, which is always
      inside the target, with yaw and score.

    Each has a style for QGIS, and names of its fields for people.

    Args:
        path: the GeoPackage to write; a layer for which there is nothing yet is left out.
        pair: the registration in any state.

    Raises:
        OutputError: if the file cannot be written.

    """
    limits = _limits(pair)
    layers = []
    if pair.tie_points is not None and len(pair.tie_points.target):
        layers.append(_drawn(_tie_points(pair), styles.residual_style(limits)))
        if pair.T_target_source is not None:
            layers.append(_drawn(_links(pair), styles.link_style(limits, _exaggeration(pair))))
    if pair.matches is not None and pair.matches.hypotheses:
        layers.append(_drawn(_hypotheses(pair), styles.hypothesis_style()))
    layers.append(_drawn(_footprints(pair), styles.footprint_style()))
    write_geopackage(path, layers, pair.frame.crs)


def _drawn(layer: Layer, style: Sequence[Element]) -> Layer:
    """Return a layer with a style and names for its fields."""
    named = (*style, styles.aliases({name: ALIASES[name] for name in layer.fields}))
    return replace(layer, style=qml(named).decode())


def tie_positions(pair: Pair) -> tuple[Floats, Floats | None]:
    """Return the tie points in upright work coordinates of the target, metres.

    Returns:
        (n, 3) target ends and (n, 3) source ends as the transform places them (None if not solved).

    Raises:
        ValueError: if the pair has no tie points yet.

    """
    if pair.tie_points is None:
        raise ValueError("the pair has no tie points yet")
    target = transforms.apply(transforms.inverse(pair.target.T_level_work), pair.tie_points.target)
    if pair.T_target_source is None:
        return target, None
    T_target_levelled = pair.T_target_source @ transforms.inverse(pair.source.T_level_work)
    return target, transforms.apply(T_target_levelled, pair.tie_points.source)


def outline(plan: Floats) -> NDArray[np.int64]:
    """Return the indices of those of (n, 2) points that make their convex outline, in order."""
    import cv2

    near = np.asarray(plan[:, :2] - plan[:1, :2], np.float32)
    return np.asarray(cv2.convexHull(near, returnPoints=False)[:, 0], np.int64)


def footprints(pair: Pair) -> dict[str, Floats]:
    """Return the convex outlines, as closed (m, 2) rings in work coordinates of the target, metres.

    Some ten thousand points of each sample are used: enough for a footprint.

    Returns:
        the rings by role: the target's, and the registered source's once there is a transform; a cloud
        without points has none.

    """
    rings: dict[str, Floats] = {}
    for side in (pair.target, pair.source):
        T = pair.T_target_source if side.role == "source" else np.eye(4)
        if T is None or len(side.sample) == 0:
            continue
        some = side.sample[:: max(1, len(side.sample) // _FOOTPRINT_POINTS)]
        # the outermost points stay outermost: moving them alone spares moving all
        placed = transforms.apply(T, some[outline(some)])
        ring = placed[outline(placed), :2]
        rings[side.role] = np.vstack([ring, ring[:1]])
    return rings


def _tie_points(pair: Pair) -> Layer:
    tie_points = pair.tie_points
    assert tie_points is not None
    target, registered = tie_positions(pair)
    source_work = transforms.apply(transforms.inverse(pair.source.T_level_work), tie_points.source)
    source_file = pair.source.link.to_file(source_work)
    surface_residual = np.full((len(target), 3), np.nan) if registered is None else registered - target
    fields: Fields = {
        "tie_point": np.arange(len(target), dtype=np.int32),
        "plan_m": np.linalg.norm(surface_residual[:, :2], axis=1),
        "residual_m": np.linalg.norm(surface_residual, axis=1),
        "dx_m": surface_residual[:, 0],
        "dy_m": surface_residual[:, 1],
        "dz_m": surface_residual[:, 2],
        "score": np.asarray(tie_points.score, np.float64),
        "inlier": np.asarray(tie_points.inlier, bool),
        "held_out": np.asarray(tie_points.held_out, bool),
        "spacing_m": _spacing(target[:, :2], np.asarray(tie_points.score, np.float64), tie_points.inlier),
        "source_x": source_file[:, 0],
        "source_y": source_file[:, 1],
        "source_z": source_file[:, 2],
    }
    about = "tie points at the target's end; residual: registered source minus target, metres"
    places = list((target + pair.frame.origin)[:, None, :])
    return Layer("tie_points", "POINT", places, fields, about)


def _links(pair: Pair) -> Layer:
    target, registered = tie_positions(pair)
    assert registered is not None
    assert pair.tie_points is not None
    lines = list(np.stack([registered, target], axis=1) + pair.frame.origin)
    fields: Fields = {
        "tie_point": np.arange(len(target), dtype=np.int32),
        "plan_m": np.linalg.norm((registered - target)[:, :2], axis=1),
        "residual_m": np.linalg.norm(registered - target, axis=1),
        "inlier": np.asarray(pair.tie_points.inlier, bool),
        "held_out": np.asarray(pair.tie_points.held_out, bool),
    }
    about = "from each tie point's registered source end to its target end"
    return Layer("links", "LINESTRING", lines, fields, about)


def _footprints(pair: Pair) -> Layer:
    rings = footprints(pair)
    sides = [{"source": pair.source, "target": pair.target}[role] for role in rings]
    fields: Fields = {
        "role": np.array(list(rings), str),
        "cloud": np.array([Path(side.cloud.name).name for side in sides], str),
        "points": np.array([side.cloud.count for side in sides], np.int64),
    }
    shapes = [ring + pair.frame.origin[:2] for ring in rings.values()]
    about = "convex outlines of the target and of the source as the transform places it"
    return Layer("footprints", "POLYGON", shapes, fields, about)


def _hypotheses(pair: Pair) -> Layer:
    assert pair.matches is not None
    every = pair.matches.hypotheses
    step = max(1, len(pair.source.sample) // _PLACED_POINTS)
    some = transforms.apply(pair.source.T_level_work, pair.source.sample[::step])[:, :2]
    T_work_levelled = transforms.inverse(pair.target.T_level_work)
    height = float(np.median(pair.target.sample[:: max(1, len(pair.target.sample) // 10_000), 2]))
    covered = transforms.bounds(pair.target.levelled_sample)
    places = []
    for one in every:
        moved = some @ transforms.yaw_matrix(one.yaw)[:2, :2].T + np.asarray(one.shift)
        plan = _shared_middle(pair, moved, covered)
        work = transforms.apply(T_work_levelled, np.array([[plan[0], plan[1], height]]))
        places.append(work + pair.frame.origin)
    fields: Fields = {
        "rank": np.arange(1, len(every) + 1, dtype=np.int32),
        "score": np.array([one.score for one in every], np.float64),
        "yaw_deg": np.rad2deg([one.yaw for one in every]),
        "shift_x_m": np.array([one.shift[0] for one in every], np.float64),
        "shift_y_m": np.array([one.shift[1] for one in every], np.float64),
        "overlap_cells": np.array([one.overlap_cells for one in every], np.int64),
    }
    about = "the middle of what both would share under each candidate pose; rank 1 was followed"
    return Layer("hypotheses", "POINT", places, fields, about)


def _shared_middle(pair: Pair, plan: Floats, covered: tuple[Floats, Floats]) -> Floats:
    """Return the middle of those of (n, 2) levelled target coordinates that the target covers, metres.

    A pose may put the middle of a long source far from all that is drawn; what it would share is not.

    Args:
        pair: whose target it is.
        plan: (n, 2) the coordinates.
        covered: least and greatest levelled coordinates of the target, (3,) each.

    """
    low, high = covered
    bev = pair.target.bev
    if bev is None:
        inside = np.all((plan >= low[:2]) & (plan <= high[:2]), axis=1)
    else:
        column, row = bev.grid.cells(plan)
        inside = bev.grid.holds(column, row)
        inside[inside] = bev.count[row[inside], column[inside]] > 0
    middle = (plan[inside] if inside.any() else plan).mean(axis=0)
    return np.asarray(np.clip(middle, low[:2], high[:2]))


def _spacing(plan: Floats, score: Floats, agrees: NDArray[np.bool_]) -> Floats:
    """Return how far each of (n, 2) points is from the nearest one of a higher score that is of its kind.

    Those that agree and those that do not are thinned apart, so that neither hides the other.

    Returns:
        (n,) metres; the best of each kind has the extent of all.

    """
    extent = float(np.hypot(*np.ptp(plan, axis=0))) + 1.0
    spacing = np.full(len(plan), extent)
    for kind in (True, False):
        order = np.flatnonzero(np.asarray(agrees, bool) == kind)
        order = order[np.argsort(-score[order], kind="stable")]
        x, y = plan[order].T
        for start in range(1, len(order), _AT_A_TIME):
            some = np.arange(start, min(start + _AT_A_TIME, len(order)))
            squared = (x[some, None] - x[: some[-1]]) ** 2 + (y[some, None] - y[: some[-1]]) ** 2
            squared[np.arange(some[-1]) >= some[:, None]] = np.inf
            spacing[order[some]] = np.sqrt(squared.min(axis=1))
    return spacing


def _exaggeration(pair: Pair) -> float:
    """Return the round factor, at least 1, by which arrows of the plan residuals become readable."""
    target, registered = tie_positions(pair)
    assert registered is not None
    assert pair.tie_points is not None
    agrees = np.asarray(pair.tie_points.inlier, bool)
    if not agrees.any():
        return 1.0
    typical = float(np.median(np.linalg.norm((registered - target)[agrees, :2], axis=1)))
    wanted = _ARROW_SHARE * float(np.hypot(*np.ptp(target[agrees, :2], axis=0))) / max(typical, 1e-6)
    exponent = np.floor(np.log10(max(wanted, 1.0)))
    round_ones = [step * 10.0**exponent for step in _ROUND]
    return float(min(max((one for one in round_ones if one <= wanted), default=1.0), 1000.0))


def _limits(pair: Pair) -> tuple[float, float]:
    """Return where green ends and red begins, from the inliers' own spread, rounded to centimetres."""
    if pair.tie_points is None or not pair.tie_points.inlier.any():
        return 0.1, 0.5
    target, registered = tie_positions(pair)
    if registered is None:
        return 0.1, 0.5
    apart = np.linalg.norm((registered - target)[:, :2], axis=1)
    spread = float(np.median(apart[pair.tie_points.inlier]))
    low = max(round(2.0 * spread, 2), 0.02)
    return low, round(3.0 * low, 2)
