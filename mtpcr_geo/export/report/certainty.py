"""The part of the report that says how certain the pose is: checks, expected error, charts, rivals."""

from __future__ import annotations

from collections.abc import Callable
from html import escape

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.export import charts, descriptions, drawing
from mtpcr_geo.export.report.rivals import rival_pose
from mtpcr_geo.export.tie_points import footprints, tie_positions
from mtpcr_geo.verdict.findings import rival_text

STATUS_CLASS = {"passed": "ok", "not passed": "bad", "warning": "warn", "not checked": "none"}
MOST_RIVALS = 2
Figure = Callable[[drawing.Picture, str], str]
Key = Callable[..., str]


def checks_table(pair: Pair) -> str:
    """Return the one table of checks, each figure defined where it stands, and all metrics folded away."""
    verdict = pair.verdict
    if verdict is None:
        return ""
    rows = "".join(
        f"<tr><td>{escape(one.name)}<div class=small>{escape(one.meaning)}</div></td><td>{escape(one.value)}"
        f"</td><td>{escape(one.wanted)}</td><td class={STATUS_CLASS[one.status]}>{escape(one.status)}</td>"
        "</tr>"
        for one in verdict.checks
    )
    head = "<tr><th>check</th><th>value</th><th>wanted</th><th>met</th></tr>"
    table = f'<table class="checks">{head}{rows}</table>' if rows else ""
    metrics = descriptions.metric_rows(verdict.metrics)
    if metrics:
        cells = "".join(f"<tr><td>{escape(a)}</td><td>{escape(b)}</td></tr>" for a, b in metrics)
        table += f"<details><summary>All figures</summary><table>{cells}</table></details>"
    return table


def candidates_chart(pair: Pair) -> str:
    """Return the strengths of the candidate poses as bars, best first."""
    if pair.matches is None or not pair.matches.hypotheses:
        return ""
    best = pair.matches.hypotheses[:10]
    rows = descriptions.hypothesis_rows(pair)[: len(best)]
    known = all(one.strength is not None for one in best)
    values = [one.score if one.strength is None else one.strength for one in best]
    chart = charts.bars(values, [f"{row[0]}.  yaw {row[1]}" for row in rows], [row[3] for row in rows])
    if known:
        text = (
            "Strength of each pose that the search proposed: its score, times the share of patches that "
            "agree with it, times how well the ground agrees. The first was followed."
        )
        if pair.matches.margin is not None and len(best) > 1:
            text += f" Margin over the next distinct pose: {pair.matches.margin:.3g} times."
    else:
        text = "Score of each pose that the search proposed. The first was followed."
    return f"<figure><h3>Candidate poses</h3>{chart}<figcaption>{text}</figcaption></figure>"


def error_map(pair: Pair, figure: Figure) -> str:
    """Return the expected error in plan over the source's extent, as a picture with its range."""
    if pair.verdict is None or pair.verdict.uncertainty is None or pair.T_target_source is None:
        return ""
    if pair.verdict.name == "refused":
        return ""  # no accuracy is claimed
    picture, low, high = expected_error_picture(pair, pair.verdict.uncertainty)
    rows = "".join(
        f"<tr><td>{escape(a)}</td><td>{escape(b)}</td></tr>"
        for a, b in descriptions.uncertainty_rows(pair.verdict)
    )
    caption = (
        "What 95 % of the errors in plan stay below, over the source's extent, in the target's frame: from "
        f"{low:.2f} m (green) to {high:.2f} m (red)."
    )
    return f"<div><h3>Expected error</h3>{figure(picture, caption)}<table>{rows}</table></div>"


def expected_error_picture(
    pair: Pair, uncertainty: Uncertainty, side: int = 400
) -> tuple[drawing.Picture, float, float]:
    """Draw what 95 % of the errors in plan stay below at the source's points.

    Args:
        pair: with a transform.
        uncertainty: of that.
        side: pixels along the longer side at most; fewer where points are sparse.

    Returns:
        The picture, north up, and the least and greatest value, metres.

    """
    assert pair.T_target_source is not None
    moved = transforms.apply(pair.T_target_source, pair.source.sample)
    level: Floats = (moved - uncertainty.pivot) @ uncertainty.R_level.T
    low, high = level[:, :2].min(axis=0), level[:, :2].max(axis=0)
    spacing = float(np.sqrt(np.prod(high - low) / max(len(level), 1)))
    cell = max(float((high - low).max()) / side, 2.0 * spacing, 1e-6)
    column, row = np.floor((level[:, :2] - low) / cell).astype(np.int64).T
    height, width = int(row.max()) + 1, int(column.max()) + 1
    _, first = np.unique(row * width + column, return_index=True)
    within, _ = uncertainty.within_95(moved[first])
    least, most = float(within.min()), float(within.max())
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = drawing.EMPTY_RGB
    colours = drawing.residual_colours(within, least, max(most, least + 1e-9))
    picture[height - 1 - row[first], column[first]] = colours
    return picture, least, most


def rivals_figures(pair: Pair, figure: Figure, key: Key) -> list[str]:
    """Return an overlay for each rival that a verdict names, beside that of the pose found."""
    verdict = pair.verdict
    if verdict is None or not verdict.rivals or pair.tie_points is None or pair.T_target_source is None:
        return []
    if pair.source.bev is None or pair.target.bev is None or not len(pair.tie_points):
        return []
    figures = []
    mapped = pair.frame.crs is not None
    poses = [("The pose found", pair.T_target_source)]
    for number, rival in enumerate(verdict.rivals[:MOST_RIVALS], start=1):
        text = f"Rival {number}: {rival_text(rival, mapped)} (margin {rival.margin:.2f})"
        poses.append((text, rival_pose(pair, rival)))
    for text, T in poses:
        source, target = drawing.common_rasters(pair.with_(T_target_source=T))
        caption = f"{escape(text)}. {key(drawing.SOURCE_RGB, 'source')}{key(drawing.TARGET_RGB, 'target')}"
        figures.append(figure(drawing.edge_overlay(source, target), caption))
    return figures


def tie_charts(pair: Pair, key: Key) -> list[str]:
    """Return how far tie points are off: in plan, by which they are judged, in height, and on the map."""
    target, registered = tie_positions(pair)
    assert registered is not None
    assert pair.tie_points is not None
    off = registered - target
    plan = np.hypot(off[:, 0], off[:, 1])
    inlier = np.asarray(pair.tie_points.inlier, bool)
    good, bad = drawing.residual_limits(plan, inlier)
    limit = max(2.0 * bad, float(np.percentile(plan, 60)) * 1.2, 0.05)
    colours = drawing.residual_colours(plan, good, bad)
    chart = charts.residual_map(target, registered, colours, footprints(pair))
    legend = f"{key(drawing.GOOD_RGB, 'agrees')}{key(drawing.BAD_RGB, 'does not')}"
    parts = [
        f"<figure><h3>Tie points: off in plan</h3>{charts.histogram(plan, inlier, limit)}<figcaption>"
        "Distance in plan between both ends of each tie point after the transform: by this it agrees or does "
        f"not.{legend}</figcaption></figure>"
    ]
    if inlier.any():
        height = np.abs(off[inlier, 2])
        most = max(float(np.percentile(height, 95)) * 1.2, 0.05)
        histogram = charts.histogram(height, np.ones(len(height), bool), most)
        parts.append(
            f"<figure><h3>Tie points: off in height</h3>{histogram}<figcaption>The same of those that agree, "
            "in height, in which they are not matched: a crown or an eave may be met by the ground beside it."
            "</figcaption></figure>"
        )
    parts.append(
        f"<figure><h3>Tie points in plan</h3>{chart}"
        f"<figcaption>Tie points in plan, green below {good:g} m of residual, red from {bad:g} m; lines show "
        "its direction. Lines that all point one way, or around one place, would mean that the transform is "
        f"off.{key(drawing.SOURCE_RGB, 'source')}{key(drawing.TARGET_RGB, 'target')}</figcaption></figure>"
    )
    return parts
