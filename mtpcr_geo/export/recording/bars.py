"""Bars as text in a table.

rerun's bar charts carry no labels, and the labels of its 2D views cover each other where the view is small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mtpcr_geo.export.descriptions import markdown_table

LONGEST = 14
"""Blocks of the longest bar: a table with it fits into the narrow column of the layout."""
_BLOCK, _HALF, _SLIVER = "\N{FULL BLOCK}", "\N{LEFT HALF BLOCK}", "\N{LEFT ONE EIGHTH BLOCK}"


@dataclass(frozen=True)
class Bar:
    """A bar, and what stands before it.

    Attributes:
        cells: texts of its row.
        value: its length; what is negative or not finite has none.

    """

    cells: tuple[str, ...]
    value: float


def table(head: Sequence[str], bars: Sequence[Bar]) -> str:
    """Return bars as a Markdown table, each in a row behind its texts; the longest is that of the largest."""
    longest = max((bar.value for bar in bars if 0.0 < bar.value < float("inf")), default=1.0)
    rows = [(*bar.cells, drawn(bar.value / longest)) for bar in bars]
    return markdown_table((*head, ""), rows)


def drawn(share: float) -> str:
    """Return a bar of blocks, to half of one; a sliver where it would be shorter, nothing for nothing."""
    if not share > 0.0:
        return ""
    halves = round(2 * LONGEST * min(share, 1.0))
    return _BLOCK * (halves // 2) + _HALF * (halves % 2) or _SLIVER
