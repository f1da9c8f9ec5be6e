"""The result of a run as rows of text, for the report, the recording and the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import IcpResult, Pair, Side, Verdict
from mtpcr_geo.crs import FrameLink, TransformChain, facts_of
from mtpcr_geo.export.tie_points import tie_positions
from mtpcr_geo.export.transform import cloudcompare_of, units_of
from mtpcr_geo.verdict.findings import probability_text

Row = tuple[str, str]

_MEANING = {
    "accepted": "The source fits the target; the checks that did not take part in the fit agree.",
    "doubtful": "A transform was found, but the checks leave room for doubt: inspect it before use.",
    "refused": "The checks do not bear out the pose that was found: do not use it.",
}
_LABELS = {
    "held_out_tie_points": "held-out tie points",
    "held_out_agreeing": "held-out tie points that agree",
    "held_out_agreeing_share": "share of held-out tie points that agree",
    "held_out_tolerance_m": "agreeing within",
    "held_out_median_m": "median residual of held-out tie points, plan",
    "neg_log10_p": "significance of that (-log10 p)",
    "hypothesis_margin": "times stronger than the next distinct pose",
    "null_ratio": "times stronger than the best of the mirrored source",
    "null_p": "probability that a scene without a right pose scores as well",
    "patch_support": "patches that agree on the pose",
    "overlap_m2": "ground that both see",
    "overlap_source": "overlap, share of the source",
    "overlap_target": "overlap, share of the target",
    "ground_cells": "ground that both see, cells compared",
    "ground_agreeing": "of these, cells with heights within 0.5 m",
    "ground_checked": "enough ground to judge by",
    "ground_spread_m": "ground, spread of the height differences",
    "ground_relief_m": "ground, relief",
    "ground_noise_m": "ground, spread that its noise explains",
    "repeats": "scene repeats itself",
    "self_likeness": "correlation of the scene with itself, moved",
    "probability": "probability of being right (5 degrees, 2 m)",
    "probability_precise": "probability of being precise (0.2 degrees, 0.5 m)",
    "refinement_lost": "refinement lost the tie points",
    "refined_away_m": "refined away from the tie points",
    "vertical_offset_m": "height offset found",
    "yaw_deg": "yaw, work frame",
    "tilt_deg": "tilt, work frame",
    "shift_work_m": "translation, work frame",
    "tie_points_agreeing": "tie points that agree with the final transform, in plan",
    "sigma_yaw_deg": "standard deviation of yaw",
    "sigma_tilt_deg": "standard deviation of tilt",
    "sigma_plan_m": "standard deviation in plan, middle of the overlap",
    "sigma_height_m": "standard deviation in height, middle of the overlap",
    "sigma_plan_far_m": "standard deviation in plan, farthest point of the source",
    "sigma_height_far_m": "standard deviation in height, farthest point of the source",
    "within_95_plan_m": "95 % of errors in plan, middle of the overlap",
    "within_95_height_m": "95 % of errors in height, middle of the overlap",
    "within_95_plan_far_m": "95 % of errors in plan, farthest point of the source",
    "within_95_height_far_m": "95 % of errors in height, farthest point of the source",
    "weakest_direction_deg": "direction in which the middle is least sure, from north to east",
    "held_out_effective": "places that the held-out tie points stand for",
    "held_out_effective_agreeing": "of these, places that agree",
    "held_out_expected": "held-out tie points that chance would make agree",
    "tie_points_height_off": "of these, off in height",
}
_UNITS = (("_m2", "m²"), ("_m", "m"), ("_deg", "°"), ("_s", "s"), ("_mb", "MB"), ("_cells", "cells"))
_SHARES = ("_share", "overlap_source", "overlap_target", "_support")
_PROBABILITIES = ("probability", "probability_precise")


def verdict_meaning(pair: Pair) -> str:
    """Return in a sentence what the verdict means for the user; "" before there is one."""
    if pair.verdict is None:
        return ""
    if pair.verdict.name == "refused" and pair.T_target_source is None:
        return "No pose was found."
    return _MEANING[pair.verdict.name]


def written_text(written: Mapping[str, Any]) -> str:
    """Return in a sentence which files a run wrote, and which not and why, by their names.

    Args:
        written: files (paths), withheld (path, why) and forced, as in run.json.

    """
    files = ", ".join(Path(path).name for path in written["files"])
    parts = [f"Written: {files or 'nothing'}."]
    by_reason: dict[str, list[str]] = {}
    for one in written["withheld"]:
        by_reason.setdefault(one["why"], []).append(Path(one["path"]).name)
    parts += [f"Not written: {', '.join(names)}, since {why}." for why, names in by_reason.items()]
    if written["forced"]:
        parts.append("Files that the verdict withholds were written since that was forced.")
    return " ".join(parts)


def metric_rows(metrics: Mapping[str, Any]) -> list[Row]:
    """Return metrics as (label, value with its unit); the unit is read from the end of each key."""
    rows = []
    for key, value in metrics.items():
        if isinstance(value, Mapping):
            rows += [(f"{_label(key)}: {name}", text) for name, text in metric_rows(value)]
        else:
            rows.append(_metric_row(key, value))
    return rows


def side_rows(side: Side) -> list[Row]:
    """Return the facts of a cloud: file, points, CRS, extent, levelling, raster."""
    cloud = side.cloud
    crs = side.link.file_crs.name if side.link.file_crs is not None else "none (local coordinates)"
    extent = np.subtract(*transforms.bounds(side.sample)[::-1]) if len(side.sample) else np.zeros(3)
    rows = [
        ("file", Path(cloud.name).name),
        ("points", f"{cloud.count:,}"),
        *_no_return_rows(side),
        *_stray_rows(side),
        *(("header", remark) for remark in side.remarks),
        ("CRS", crs),
        ("units", units_text(side.link)),
        *_operation_rows(side.link),
        ("extent", f"{extent[0]:.1f} × {extent[1]:.1f} m, {extent[2]:.1f} m high"),
        ("origin of the work frame", ", ".join(f"{value:.0f}" for value in side.link.origin) + " m"),
    ]
    tilt = math.degrees(transforms.rotation_angle(side.T_level_work[:3, :3]))
    kept = f"none: {side.levelling.why or 'upright'}"
    rows.append(("levelling", f"rotated by {tilt:.2f}°" if tilt > 0 else kept))
    if side.bev is not None:
        grid = side.bev.grid
        share = float(np.count_nonzero(side.bev.count)) / max(side.bev.count.size, 1)
        rows.append(("raster", f"{grid.width} × {grid.height} cells of {grid.cell:g} m, {share:.0%} filled"))
    return rows


def _no_return_rows(side: Side) -> list[Row]:
    if not side.no_returns:
        return []
    where = "; ".join(", ".join(f"{value:g}" for value in place) for place in side.no_return_places[:3])
    text = f"{side.no_returns:,} at {where}: kept in what is written, left out of all else"
    return [("points without a return", text)]


def _stray_rows(side: Side) -> list[Row]:
    if not side.strays:
        return []
    text = f"{side.strays:,}, far from all others: kept in what is written, left out of all else"
    return [("stray points", text)]


def transform_rows(pair: Pair) -> list[Row]:
    """Return what the transform does: yaw, tilt, shift of the source's middle, residuals of tie points."""
    if pair.T_target_source is None:
        return []
    R = pair.T_target_source[:3, :3]
    yaw = transforms.yaw_of(R)
    tilt = math.degrees(transforms.tilt_of(R))
    rows = [("yaw", f"{math.degrees(yaw):+.4f}° (counter-clockwise from above)"), ("tilt", f"{tilt:.4f}°")]
    moved = shift_text(pair)
    if moved:
        rows.append(("shift of the source's centroid", moved))
    rows.append(("result in", result_text(pair)))
    chain = TransformChain.of(pair)
    shifts = {
        role: ", ".join(f"{value + 0.0:.10g}" for value in cloudcompare_of(chain)[f"{role}_global_shift"])
        for role in ("source", "target")
    }
    rows.append(
        (
            "in CloudCompare",
            f"global shift of the source ({shifts['source']}), of the target ({shifts['target']}): "
            "transform.cloudcompare.txt holds with these",
        )
    )
    offset = chain.vertical_offset_m
    if offset is not None:
        rows.append(("height offset found", f"{offset:+.3f} m, added to the source's heights"))
    if pair.matches is not None and "second_opinion" in pair.matches.report:
        rows.append(
            ("matched by", "the network, since what the search by heights found could not be accepted")
        )
    if pair.tie_points is not None and len(pair.tie_points.target):
        rows += _tie_point_rows(pair)
    if pair.refinement is not None:
        if pair.refinement.icp is not None:
            rows.append(("refined by", refinement_text(pair.refinement.icp)))
        if pair.refinement.again is not None:
            rows.append(("fed back", pair.refinement.again))
    return rows


def _tie_point_rows(pair: Pair) -> list[Row]:
    """Return how many tie points agree with the transform, in plan, and their heights apart."""
    assert pair.tie_points is not None
    inlier = np.asarray(pair.tie_points.inlier, bool)
    rows = [("tie points", f"{len(inlier)}, of which {int(inlier.sum())} agree with the transform in plan")]
    if not inlier.any():
        return rows
    off = surface_residuals(pair)[inlier]
    plan, height = np.median(np.hypot(off[:, 0], off[:, 1])), np.median(np.abs(off[:, 2]))
    text = f"median {plan:.2f} m in plan, {height:.2f} m in height"
    metrics = pair.verdict.metrics if pair.verdict is not None else {}
    beyond = metrics.get("tie_points_height_off")
    if beyond:
        most = metrics["tie_points_height_tolerance_m"]
        text += (
            f"; {beyond} of them are off by more than {most:.2f} m in height, in which they are not matched: "
            "crowns, eaves"
        )
    return [*rows, ("residual of the agreeing ones", text)]


def uncertainty_rows(verdict: Verdict) -> list[Row]:
    """Return the expected error of the pose, one standard deviation each, and where it is taken about."""
    if verdict.uncertainty is None:
        return []
    known = verdict.uncertainty.metrics
    return [
        (
            "standard deviation in the middle of the overlap",
            f"{_short(known['sigma_plan_m'])} m in plan, {_short(known['sigma_height_m'])} m in height",
        ),
        (
            "at the farthest point of the source",
            f"{_short(known['sigma_plan_far_m'])} m in plan, "
            f"{_short(known['sigma_height_far_m'])} m in height",
        ),
        (
            "of the rotation",
            f"{_short(known['sigma_yaw_deg'])}° in yaw, {_short(known['sigma_tilt_deg'])}° in tilt",
        ),
    ]


def registration_rows(pair: Pair | None, verdict: Verdict) -> list[Row]:
    """Return clouds, transform, overlap and reasons of a verdict: what a registration prints of itself."""
    rows = []
    if pair is not None:
        names = (Path(side.cloud.name).name for side in (pair.source, pair.target))
        rows.append(("clouds", " to ".join(names)))
        if pair.T_target_source is not None:
            R = pair.T_target_source[:3, :3]
            yaw = transforms.yaw_of(R)
            tilt = math.degrees(transforms.tilt_of(R))
            shift = shift_text(pair)
            text = f"yaw {math.degrees(yaw):+.3f}°, tilt {tilt:.3f}°"
            rows.append(("transform", f"{text}, the centroid moves by {shift}" if shift else text))
    overlap = verdict.metrics.get("overlap_m2")
    if overlap is not None:
        shares = [f"{verdict.metrics[f'overlap_{role}']:.0%} of the {role}" for role in ("source", "target")]
        rows.append(("overlap", f"{overlap:,.0f} m², {' and '.join(shares)}"))
    return rows + [("reason", reason) for reason in verdict.reasons[:2]]


def refinement_text(icp: IcpResult) -> str:
    """Return which of the refinements was taken, and why, in one line."""
    surface_residual = icp.tried[icp.chosen].surface_residual
    if icp.followed:
        rounds = ", ".join(f"{one.max_correspondence_distance_m:g}" for one in icp.rounds)
        return (
            f"ICP ({icp.method}) with correspondences up to {rounds} m; "
            f"surface residual {surface_residual:.2f}"
            + ("; the few tie points that had agreed were left" if icp.left_tie_points else "")
        )
    why = "ICP lost the tie points" if icp.lost_tie_points else "after ICP surfaces met worse"
    kept = {"tie_points": "the tie points alone", "ground": "tie points and ground"}[icp.chosen]
    return f"{kept}: {why}; surface residual {surface_residual:.2f}"


def units_text(link: FrameLink) -> str:
    """Return the units of a file's coordinates, in plan and height, and what its heights refer to."""
    across, _, up = units_of(link)
    units = across if across == up else f"{across} in plan, {up} in height"
    axes = "" if link.scanner.axes == "z-up" else f"; {link.scanner.axes}"
    return f"{units}; {facts_of(link.file_crs).height_name}{axes}"


def shift_text(pair: Pair) -> str:
    """Return how far the source's centroid moves: metres in the work frame, or in the clouds' local frame.

    Empty where source and target share no frame, so that no shift has a meaning.
    """
    chain = TransformChain.of(pair)
    shift = chain.shift_m
    if shift is not None and pair.frame.crs is not None:
        return f"{_numbers(shift, 3, sign=True)} m (east, north, up in {pair.frame.crs.name})"
    if not (pair.source.link.georeferenced or pair.target.link.georeferenced):
        moved = chain.forward(chain.pivot[None])[0]
        shift = chain.target.metric(moved) - chain.source.metric(chain.pivot)
        return f"{_numbers(shift, 3, sign=True)} m (x, y, z)"
    return ""


def result_text(pair: Pair) -> str:
    """Return the CRS and the units of the registered cloud."""
    link = pair.frame.output or pair.target.link
    name = link.file_crs.name if link.file_crs is not None else "local coordinates of the target"
    return f"{name}: {units_text(link)}"


def _operation_rows(link: FrameLink) -> list[Row]:
    """Return how a file's coordinates come to the work frame, and what had to be assumed."""
    report = link.report
    accuracy = report.accuracy_m
    how = "accuracy not stated" if accuracy is None else f"accuracy {accuracy:g} m"
    details = f" ({'; '.join([how, *report.grids])})" if link.pipeline is not None else ""
    rows = [("conversion to the work frame", report.operation + details)]
    return rows + [("note", note) for note in report.notes]


def worked_example(pair: Pair) -> tuple[Floats, Floats] | None:
    """Return one point, the source's centroid, before and after: (3,) source and target file coordinates.

    It is moved by the whole chain, not by the single 4x4, so it can serve to check that.
    """
    if pair.T_target_source is None:
        return None
    chain = TransformChain.of(pair)
    before: Floats = np.asarray(np.round(chain.pivot, 3), np.float64)
    return before, chain.forward(before[np.newaxis])[0]


def surface_residuals(pair: Pair) -> Floats:
    """Return registered source minus target of each tie point, (n, 3) metres; NaN without a transform."""
    target, registered = tie_positions(pair)
    return np.full_like(target, np.nan) if registered is None else registered - target


def hypothesis_rows(pair: Pair) -> list[tuple[str, ...]]:
    """Return the candidate poses as texts (rank, yaw, shift, strength, overlap), as the matcher ranks them.

    The strength is what margins are taken of; the score where a matcher has none.
    """
    if pair.matches is None:
        return []
    cell = pair.target.bev.grid.cell if pair.target.bev is not None else math.nan
    return [
        (
            str(rank),
            f"{_half_turn(math.degrees(one.yaw)):+.1f}°",
            f"{one.shift[0]:+.1f}, {one.shift[1]:+.1f} m",
            f"{one.score if one.strength is None else one.strength:.4g}",
            f"{one.overlap_cells * cell * cell:,.0f} m²" if one.overlap_cells else "",
        )
        for rank, one in enumerate(pair.matches.hypotheses, start=1)
    ]


def matrix_text(T: Floats) -> str:
    """Write a 4x4 with 17 significant digits, a row a line."""
    return "\n".join("  ".join(f"{value: .17g}".ljust(24) for value in row).rstrip() for row in T)


def plain(value: Any) -> str:
    """Return any option or property as one short line."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {plain(one)}" for key, one in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(plain(one) for one in value)
    return str(value)


def markdown_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Lay out rows as a Markdown table."""
    head = list(head)
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell.replace("|", "/") for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def markdown_list(rows: Iterable[tuple[str, str]]) -> str:
    """Lay out (what, value) as a Markdown list: its lines wrap, where a table is cut off in a narrow view."""
    return "\n".join(f"- **{what}**: {value}" for what, value in rows)


def _metric_row(key: str, value: Any) -> Row:
    if value is None:
        return _label(key), "not known"
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return _label(key), "yes" if value else "no"
    if isinstance(value, list | tuple | np.ndarray) and key.endswith("_m"):
        return _label(key, "_m"), f"{_numbers(np.asarray(value), 3)} m"
    if not isinstance(value, int | float):
        return _label(key), plain(value)
    if key in _PROBABILITIES:
        return _label(key), probability_text(float(value))
    if key.endswith(_SHARES):
        return _label(key), f"{100 * float(value):.1f} %"
    for suffix, unit in _UNITS:
        if key.endswith(suffix):
            gap = "" if unit == "°" else " "
            return _label(key, suffix), f"{_short(value)}{gap}{unit}"
    return _label(key), _short(value)


def _short(value: float) -> str:
    if float(value).is_integer() and abs(value) < 1e15:
        return f"{int(value):,}"
    return f"{value:,.1f}" if abs(value) >= 1000 else f"{value:.3g}"


def _label(key: str, suffix: str = "") -> str:
    """Return what a metric is called; the keys are explained in `mtpcr_geo.export.run_json`."""
    return _LABELS.get(key) or key.removesuffix(suffix).replace("_", " ")


def _numbers(values: Floats, digits: int, sign: bool = False) -> str:
    return ", ".join(f"{value:{'+' if sign else ''}.{digits}f}" for value in values)


def _half_turn(degrees: float) -> float:
    """Wrap degrees to -180..180 as they will be shown, without a minus before zero."""
    return round((degrees + 180.0) % 360.0 - 180.0, 1) + 0.0
