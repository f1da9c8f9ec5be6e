"""Small charts as inline SVG without texts of their own: a page sets labels beside them, at its own size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.export import drawing

_MAP_SIDE = 1000.0


@dataclass(frozen=True)
class Chart:
    """A chart and what a page sets around it.

    Attributes:
        svg: the drawing, which holds nothing but numbers and colours of this module.
        aspect: its height over its width, where it keeps that.
        low, high: values at the ends of its x axis.
        top: value at the top of its y axis.

    """

    svg: str
    aspect: float = 0.0
    low: float = 0.0
    high: float = 0.0
    top: float = 0.0


def histogram(
    values: Floats, parts: Sequence[tuple[Mask, str]], low: float, high: float, what: str, bins: int = 32
) -> Chart:
    """Return a histogram, its parts stacked; it fills whatever box it is put in.

    Args:
        values: (n,).
        parts: masks (n,) of the values and their CSS colours, from the bottom up.
        low, high: ends of the axis; values beyond are counted in the first and the last bar.
        what: the values are, for the count that a pointer shows.
        bins: number of bars.

    """
    clipped = np.clip(values, low, high)
    counts = [np.histogram(clipped[mask], bins=bins, range=(low, high))[0] for mask, _ in parts]
    top = max(int(np.sum(counts, axis=0).max()), 1) if counts else 1
    step = 100.0 / bins
    drawn = []
    base = np.full(bins, 100.0)
    for count, (_, colour) in zip(counts, parts, strict=True):
        for i, number in enumerate(count):
            if number:
                size = 100.0 * float(number) / top
                base[i] -= size
                drawn.append(
                    f'<rect x="{i * step + 0.15:.2f}" y="{base[i]:.2f}" width="{step - 0.3:.2f}" '
                    f'height="{size:.2f}" fill="{colour}"><title>{int(number)} {what}</title></rect>'
                )
    svg = (
        '<svg viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true" focusable="false">'
        f"{''.join(drawn)}</svg>"
    )
    return Chart(svg, 0.0, low, high, float(top))


@dataclass(frozen=True)
class ResidualMap:
    """A map of tie points.

    Attributes:
        chart: the drawing.
        bar_m: length of a scale bar, metres.
        bar: the same in percent of the width.
        enlarged: times that arrows are longer than what they stand for; 0 where there are none.
        shortened: arrows that are drawn shorter than that, since they would cover the map.

    """

    chart: Chart
    bar_m: float
    bar: float
    enlarged: float
    shortened: int


def residual_map(
    target: Floats,
    residual: Floats | None,
    colours: NDArray[np.uint8],
    rings: dict[str, Floats],
    of: Mask | None = None,
) -> ResidualMap:
    """Return tie points in plan, coloured, with their residuals as arrows, enlarged.

    Args:
        target: (n, 3) target ends in metres.
        residual: (n, 2) registered source minus target in plan, metres; None for no arrows.
        colours: (n, 3) uint8.
        rings: outlines by role, (m, 2) metres.
        of: (n,) the tie points whose median sets the length of the arrows; all if None.

    """
    # outlines are cut where they leave the tie points
    low, high = target[:, :2].min(axis=0), target[:, :2].max(axis=0)
    extent = np.maximum(high - low, 1e-6)
    size = float(max(extent))
    low, high = low - 0.14 * size, high + 0.14 * size
    extent = high - low
    # a strip is shown on a map no narrower than half its length
    pad = np.maximum(0.5 * float(extent.max()) - extent, 0.0) / 2
    low, high = low - pad, high + pad
    extent = high - low
    scale = _MAP_SIDE / float(extent[0])
    height = float(extent[1]) * scale

    def place(plan: Floats) -> Floats:
        return np.column_stack([(plan[:, 0] - low[0]) * scale, (high[1] - plan[:, 1]) * scale])

    drawn = []
    for role, ring in rings.items():
        colour = drawing.SOURCE_RGB if role == "source" else drawing.TARGET_RGB
        points = " ".join(f"{x:.0f},{y:.0f}" for x, y in place(ring))
        drawn.append(
            f'<polyline points="{points}" fill="none" stroke="{_css(colour)}" stroke-width="1.5" '
            'vector-effect="non-scaling-stroke"/>'
        )
    enlarged, shortened = 0.0, 0
    xy = place(target[:, :2])
    # of a strip or a plot all stay apart
    dot = float(np.clip(160.0 / np.sqrt(max(len(target), 1)), 4.0, 9.0))
    if residual is not None and len(residual):
        length = np.linalg.norm(residual, axis=1)
        typical = length if of is None or not of.any() else length[of]
        enlarged = drawing.round_number(0.035 * size / max(float(np.median(typical)), 1e-4))
        longest = 0.12 * size
        cut = np.minimum(1.0, longest / np.maximum(length * enlarged, 1e-9))
        shortened = int((cut < 1.0).sum())
        ends = place(target[:, :2] + residual * cut[:, None] * enlarged)
        for (x, y), (u, v), colour in zip(xy, ends, colours, strict=True):
            drawn.append(_arrow(x, y, u, v, _css(colour), dot))
    # a colour near the paper's is seen by its rim
    drawn.append('<g stroke="#6b7782" stroke-width="0.75">')
    for (x, y), colour in zip(xy, colours, strict=True):
        drawn.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{dot:.1f}" fill="{_css(colour)}"/>')
    drawn.append("</g>")
    svg = (
        f'<svg viewBox="0 0 {_MAP_SIDE:.0f} {height:.0f}" aria-hidden="true" focusable="false">'
        f"{''.join(drawn)}</svg>"
    )
    bar = drawing.round_number(float(extent[0]) * 0.3)
    return ResidualMap(
        Chart(svg, height / _MAP_SIDE), bar, 100.0 * bar / float(extent[0]), enlarged, shortened
    )


def _arrow(x: float, y: float, u: float, v: float, colour: str, dot: float) -> str:
    """Return an arrow from a tie point's target end to where the source's end lies, enlarged."""
    length = float(np.hypot(u - x, v - y))
    line = f'<path d="M{x:.0f} {y:.0f}L{u:.0f} {v:.0f}'
    if length > 2.5 * dot:
        dx, dy = (u - x) / length * 1.6 * dot, (v - y) / length * 1.6 * dot
        line += f"M{u - dx - 0.5 * dy:.0f} {v - dy + 0.5 * dx:.0f}L{u:.0f} {v:.0f}"
        line += f"L{u - dx + 0.5 * dy:.0f} {v - dy - 0.5 * dx:.0f}"
    return f'{line}" fill="none" stroke="{colour}" stroke-width="1.5" vector-effect="non-scaling-stroke"/>'


def _css(colour: Sequence[int] | NDArray[np.uint8]) -> str:
    return "#" + "".join(f"{int(part):02x}" for part in colour)
