"""Bars with their labels: drawn as lines in a 2D view, since rerun's own bar charts carry no text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mtpcr_geo.core.wording import visible

_THICK = 0.3
_ASPECT = 2.6
_FEWEST_ROWS = 4
_SHORTEST = 0.01


@dataclass(frozen=True)
class Bar:
    """A bar.

    Attributes:
        text: what stands on it.
        value: its length; what is negative or not finite has none.
        rgb: its colour.

    """

    text: str
    value: float
    rgb: tuple[int, int, int]


def drawn(bars: Sequence[Bar]) -> Any:
    """Return bars as horizontal lines from the top down, a step of 1 apart, each with its text on it."""
    import rerun as rr

    longest = max((bar.value for bar in bars if bar.value > 0.0), default=1.0)
    shares = [max(_SHORTEST, bar.value / longest if bar.value > 0.0 else 0.0) for bar in bars]
    wide = _wide(len(bars))
    return rr.LineStrips2D(
        [[[0.0, row + 0.5], [share * wide, row + 0.5]] for row, share in enumerate(shares)],
        colors=[bar.rgb for bar in bars],
        radii=[_THICK] * len(bars),
        labels=[visible(bar.text) for bar in bars],
        show_labels=True,
    )


def bounds(number: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the (x, y) ranges that show so many bars and their ends."""
    wide, tall = _wide(number), max(number, _FEWEST_ROWS)
    return (-0.1 * wide, 1.1 * wide), (-0.5, tall + 0.5)


def _wide(number: int) -> float:
    return _ASPECT * max(number, _FEWEST_ROWS)
