"""The links between both clouds as a GeoPackage: tie points, residuals, footprints, hypotheses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export import styles
from mtpcr_geo.export.geopackage import Layer, write_geopackage

Fields = dict[str, NDArray[Any]]

_FOOTPRINT_POINTS = 40_000


def write_tie_points(path: str | Path, pair: Pair) -> None:
    """Write what links the clouds, as far as the run came, for viewing in a GIS.

    Layers, all in the CRS of the work frame (the target's; none for local clouds), coordinates absolute:

    - ``tie_points``: 3D points at the target's end, with ``residual_m`` (and its parts ``dx_m``, ``dy_m``,
      ``dz_m``: registered source minus target), ``score``, ``inlier``, ``held_out`` and the source's
      coordinates as they stand in its file;
    - ``links``: 3D lines from the registered source's end to the target's end of each tie point;
    - ``footprints``: convex outlines of the target and of the registered source;
    - ``hypotheses``: where each candidate pose puts the middle of the source, with yaw and score.

    Args:
        path: the GeoPackage to write; a layer for which there is nothing yet is left out.
        pair: the registration in any state.

    Raises:
        OutputError: if the file cannot be written.

    """
    layers = [_footprints(pair)]
    if pair.tie_points is not None and len(pair.tie_points.target):
        layers.append(_tie_points(pair))
        if pair.T_target_source is not None:
            layers.append(_links(pair))
    if pair.matches is not None and pair.matches.hypotheses:
        layers.append(_hypotheses(pair))
    write_geopackage(path, layers, pair.frame.crs)


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
        "residual_m": np.linalg.norm(surface_residual, axis=1),
        "dx_m": surface_residual[:, 0],
        "dy_m": surface_residual[:, 1],
        "dz_m": surface_residual[:, 2],
        "score": np.asarray(tie_points.score, np.float64),
        "inlier": np.asarray(tie_points.inlier, bool),
        "held_out": np.asarray(tie_points.held_out, bool),
        "source_x": source_file[:, 0],
        "source_y": source_file[:, 1],
        "source_z": source_file[:, 2],
    }
    about = "tie points at the target's end; residual: registered source minus target, metres"
    places = list((target + pair.frame.origin)[:, None, :])
    return Layer("tie_points", "POINT", places, fields, about, styles.residual_style(_limits(pair)))


def _links(pair: Pair) -> Layer:
    target, registered = tie_positions(pair)
    assert registered is not None
    assert pair.tie_points is not None
    lines = list(np.stack([registered, target], axis=1) + pair.frame.origin)
    fields: Fields = {
        "tie_point": np.arange(len(target), dtype=np.int32),
        "residual_m": np.linalg.norm(registered - target, axis=1),
        "inlier": np.asarray(pair.tie_points.inlier, bool),
        "held_out": np.asarray(pair.tie_points.held_out, bool),
    }
    about = "from each tie point's registered source end to its target end"
    return Layer("links", "LINESTRING", lines, fields, about, styles.link_style(_limits(pair)))


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
    return Layer("footprints", "POLYGON", shapes, fields, about, styles.footprint_style())


def _hypotheses(pair: Pair) -> Layer:
    assert pair.matches is not None
    every = pair.matches.hypotheses
    corners = np.stack([pair.source.sample.min(axis=0), pair.source.sample.max(axis=0)])
    middle = transforms.apply(pair.source.T_level_work, corners.mean(axis=0, keepdims=True))[0]
    T_work_levelled = transforms.inverse(pair.target.T_level_work)
    height = float(np.median(pair.target.sample[:: max(1, len(pair.target.sample) // 10_000), 2]))
    places = []
    for one in every:
        plan = transforms.yaw_matrix(one.yaw)[:2, :2] @ middle[:2] + np.asarray(one.shift)
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
    about = "where each candidate pose puts the middle of the source; rank 1 was followed"
    return Layer("hypotheses", "POINT", places, fields, about)


def _limits(pair: Pair) -> tuple[float, float]:
    """Return where green ends and red begins, from the inliers' own spread, rounded to centimetres."""
    target, registered = tie_positions(pair)
    assert pair.tie_points is not None
    if registered is None or not pair.tie_points.inlier.any():
        return 0.1, 0.5
    spread = float(np.median(np.linalg.norm(registered - target, axis=1)[pair.tie_points.inlier]))
    low = max(round(2.0 * spread, 2), 0.02)
    return low, round(3.0 * low, 2)
