"""The figures of tie points: how far they are off in plan, by which they are judged, and in height."""

from __future__ import annotations

import numpy as np

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export import charts, drawing
from mtpcr_geo.export.report import pictures
from mtpcr_geo.export.report.facts import Words, metric
from mtpcr_geo.export.report.shown import Key, Plot, Tick, css_of, key, ticks
from mtpcr_geo.export.tie_points import footprints, tie_positions

_HISTOGRAM_REACH = 1.6


def tie_plots(pair: Pair) -> tuple[Plot, ...]:
    """Show how far tie points are off: in plan, by which they are judged, and apart from that in height."""
    if pair.tie_points is None or pair.T_target_source is None or not len(pair.tie_points):
        return ()
    target, registered = tie_positions(pair)
    assert registered is not None
    off = registered - target
    plan = np.hypot(off[:, 0], off[:, 1])
    inlier = np.asarray(pair.tie_points.inlier, bool)
    _, bad = drawing.residual_limits(plan, inlier)
    limit = max(2.0 * bad, float(np.percentile(plan, 60)) * 1.2, 0.05)
    rings = footprints(pair)
    agree, not_agree = css_of(drawing.GOOD_RGB), css_of(drawing.BAD_RGB)
    agree_keys = (Key(agree, "agrees in plan"), Key(not_agree, "does not"))
    chart = charts.residual_map(target, off[:, :2], _agreeing_colours(inlier), rings, inlier)
    cut = f" {chart.shortened} longer ones are cut." if chart.shortened else ""
    verdict = pair.verdict
    metrics = verdict.metrics if verdict is not None else {}
    count: Words = (f"{len(inlier):,} tie points, {int(inlier.sum()):,} of which agree. ",)
    if verdict is not None and metrics.get("tie_points") and metrics.get("tie_points_agreeing") is not None:
        count = (
            metric(verdict, "tie_points", f"{len(inlier):,}"),
            " tie points, ",
            metric(verdict, "tie_points_agreeing", f"{int(inlier.sum()):,}"),
            " of which agree. ",
        )
    apart = charts.histogram(plan, [(inlier, agree), (~inlier, not_agree)], 0.0, limit, "tie points")
    plots = [
        Plot(
            "In plan",
            chart.chart.svg,
            "Map of the tie points with arrows from the target's to the registered source's end.",
            (
                *count,
                f"Arrows go from the target's end to the source's, {chart.enlarged:g} times their "
                f"length.{cut} Arrows of "
                "the agreeing ones that all point one way, or around one place, would mean that the "
                "transform is off.",
            ),
            (*agree_keys, *(key(c, f"outline of the {n}") for c, n in _RING_NAMES)),
            aspect=chart.chart.aspect,
            bar=Tick(chart.bar, f"{chart.bar_m:g} m"),
        ),
        Plot(
            "Off in plan",
            apart.svg,
            "Histogram of the distances in plan.",
            (
                "Distance in plan between both ends of each tie point after the transform: by this it "
                "agrees or does not. "
                "Most of those that do not are places that look alike and lie elsewhere. The last bar "
                "holds all beyond.",
            ),
            agree_keys,
            ticks(0.0, limit, 5, "m"),
            f"{apart.top:,.0f}",
        ),
    ]
    if inlier.any():
        plots += _height_plots(target[inlier], off[inlier, 2], rings)
    return tuple(plots)


_RING_NAMES = ((drawing.SOURCE_RGB, "source"), (drawing.TARGET_RGB, "target"))


def _agreeing_colours(inlier: Mask) -> drawing.Picture:
    return np.where(inlier[:, None], np.array(drawing.GOOD_RGB), np.array(drawing.BAD_RGB)).astype(np.uint8)


def _height_plots(target: Floats, rise: Floats, rings: dict[str, Floats]) -> list[Plot]:
    """Show the heights apart of the tie points that agree in plan."""
    most = max(drawing.round_number(float(np.percentile(np.abs(rise), 80)) * _HISTOGRAM_REACH), 0.05)
    colours = pictures.difference_colours(rise[None].astype(np.float32), most)[0, :, :3]
    chart = charts.residual_map(target, None, colours, rings)
    middle = float(np.median(rise))
    counted = charts.histogram(
        rise, [(np.ones(len(rise), bool), css_of(drawing.GOOD_RGB))], -2 * most, 2 * most, "tie points"
    )
    return [
        Plot(
            "In height",
            chart.chart.svg,
            "Map of the tie points that agree in plan, coloured by their height differences.",
            (
                "Source less target at the tie points that agree in plan. They are not matched in height: "
                "a crown or an "
                "eave in one cloud may be met by the ground beside it in the other.",
            ),
            (Key("#2166ac", f"−{most:g} m or less"), Key("#b2182b", f"{most:g} m or more")),
            aspect=chart.chart.aspect,
            bar=Tick(chart.bar, f"{chart.bar_m:g} m"),
        ),
        Plot(
            "Off in height",
            counted.svg,
            "Histogram of the height differences of the tie points that agree in plan.",
            (
                f"The same as a histogram; the median is {middle + 0.0:+.2f} m. The outer bars hold all "
                f"beyond.",
            ),
            (),
            ticks(-2 * most, 2 * most, 5, "m"),
            f"{counted.top:,.0f}",
        ),
    ]
