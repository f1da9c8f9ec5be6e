"""Small charts as inline SVG, for a report that needs no other file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.export import drawing

_WIDTH = 640


def bars(values: Sequence[float], labels: Sequence[str], notes: Sequence[str] = ()) -> str:
    """Return horizontal bars, the first one highlighted.

    Args:
        values: lengths, none negative.
        labels: what stands before each bar.
        notes: what stands after each bar; the value if not given.

    """
    top = max([*values, 1e-12])
    row, left, right = 24, 190, 110
    parts = []
    for i, (value, label) in enumerate(zip(values, labels, strict=True)):
        y = i * row
        length = max(1.0, (_WIDTH - left - right) * max(value, 0.0) / top)
        note = notes[i] if notes else f"{value:.3g}"
        fill = "var(--main)" if i == 0 else "var(--quiet)"
        parts.append(
            f'<text x="{left - 8}" y="{y + 16}" text-anchor="end">{escape(label)}</text>'
            f'<rect x="{left}" y="{y + 4}" width="{length:.1f}" height="{row - 8}" rx="2" fill="{fill}"/>'
            f'<text x="{left + length + 6:.1f}" y="{y + 16}">{escape(note)}</text>'
        )
    return _svg(_WIDTH, max(len(values), 1) * row, parts)


def histogram(residual_m: Floats, inlier: Mask, limit_m: float, bins: int = 32) -> str:
    """Return a histogram of the residuals of tie points: agreeing ones green, the others red, stacked.

    Args:
        residual_m: (n,) residuals in metres.
        inlier: (n,) which agree with the transform.
        limit_m: where the axis ends; larger residuals are counted in the last bar.

    """
    height, base, left = 190, 160, 36
    clipped = np.clip(residual_m, 0.0, limit_m)
    good, _ = np.histogram(clipped[inlier], bins=bins, range=(0.0, limit_m))
    bad, _ = np.histogram(clipped[~inlier], bins=bins, range=(0.0, limit_m))
    top = max(int((good + bad).max()), 1)
    step = (_WIDTH - left - 10) / bins
    parts = []
    for i, (g, b) in enumerate(zip(good, bad, strict=True)):
        y = float(base)
        for number, colour in ((g, drawing.GOOD_RGB), (b, drawing.BAD_RGB)):
            size = (base - 12) * float(number) / top
            y -= size
            if number:
                parts.append(
                    f'<rect x="{left + i * step + 1:.1f}" y="{y:.1f}" width="{step - 2:.1f}" '
                    f'height="{size:.1f}" fill="{_css(colour)}">'
                    f"<title>{int(number)} tie points</title></rect>"
                )
    parts.append(f'<line x1="{left}" y1="{base}" x2="{_WIDTH - 10}" y2="{base}" stroke="currentColor"/>')
    parts.append(f'<text x="{left - 6}" y="20" text-anchor="end">{top}</text>')
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = left + share * (_WIDTH - left - 10)
        sign = "≥ " if share == 1.0 else ""
        anchor = "end" if share == 1.0 else "middle"
        text = f"{sign}{share * limit_m:.2g} m"
        parts.append(f'<text x="{x:.1f}" y="{base + 18}" text-anchor="{anchor}">{text}</text>')
    return _svg(_WIDTH, height, parts)


def residual_map(
    target: Floats, registered: Floats, colours: NDArray[np.uint8], rings: dict[str, Floats]
) -> str:
    """Return tie points in plan, coloured by residual, with the residual itself as a line, enlarged.

    Args:
        target: (n, 3) target ends in metres.
        registered: (n, 3) registered source ends in metres.
        colours: (n, 3) uint8.
        rings: outlines by role, (m, 2) metres.

    """
    every = np.vstack([target[:, :2], *rings.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    size = float(max(high - low)) or 1.0
    scale = (_WIDTH - 20) / max(float(high[0] - low[0]), size * 0.5, 1e-6)
    height = float(high[1] - low[1]) * scale + 44
    offset = 10 + (_WIDTH - 20 - float(high[0] - low[0]) * scale) / 2

    def place(plan: Floats) -> Floats:
        x = offset + (plan[:, 0] - low[0]) * scale
        return np.column_stack([x, 10 + (high[1] - plan[:, 1]) * scale])

    parts = []
    for role, ring in rings.items():
        colour = drawing.SOURCE_RGB if role == "source" else drawing.TARGET_RGB
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in place(ring))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{_css(colour)}" stroke-width="1.5"/>')
    surface_residual = registered[:, :2] - target[:, :2]
    length = np.linalg.norm(surface_residual, axis=1)
    enlarge = _round_number(0.04 * size / max(float(np.median(length)), 1e-4))
    # a few wild tie points must not cover the map with lines
    drawn = (
        surface_residual
        * np.minimum(1.0, 0.12 * size / np.maximum(length * enlarge, 1e-9))[:, None]
        * enlarge
    )
    ends = place(target[:, :2] + drawn)
    for (x, y), (u, v), colour in zip(place(target[:, :2]), ends, colours, strict=True):
        parts.append(
            f'<path d="M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" stroke="{_css(colour)}"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{_css(colour)}"/>'
        )
    bar = _round_number(size / 5)
    y = height - 22
    parts.append(
        f'<path d="M10 {y:.0f}h{bar * scale:.1f}" stroke="currentColor" stroke-width="2"/>'
        f'<text x="10" y="{y + 17:.0f}">{bar:g} m; residuals drawn {enlarge:g} times their length</text>'
    )
    return _svg(_WIDTH, height, parts)


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" fill="currentColor" '
        f'font-size="12">{"".join(parts)}</svg>'
    )


def _css(colour: Sequence[int] | NDArray[np.uint8]) -> str:
    return "#" + "".join(f"{int(part):02x}" for part in colour)


def _round_number(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive number."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)) * power)
