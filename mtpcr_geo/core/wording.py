"""How numbers are worded, so that what is printed says what was decided."""

from __future__ import annotations

from math import isfinite

MOST_DECIMALS = 6


def beside(value: float, limit: float, decimals: int = 0, scale: float = 1.0) -> tuple[str, str]:
    """Print a value and the limit it was compared with, so that rounding hides no difference.

    Args:
        value: what was found.
        limit: what it was compared with.
        decimals: of both, unless more are needed to tell them apart.
        scale: both are multiplied by this before they are printed, such as 100 for percent.

    Returns:
        Both as text: equal texts only where the numbers are equal to six decimals.

    """
    value, limit = value * scale, limit * scale
    wanted = f"{limit:g}" if limit == round(limit, MOST_DECIMALS) else f"{limit:.{decimals}f}"
    if not isfinite(value) or value == limit:
        return (wanted if value == limit else f"{value}"), wanted
    for places in range(decimals, MOST_DECIMALS + 1):
        shown = round(value, places)
        if shown != round(limit, places) and (shown < float(wanted)) == (value < limit):
            return f"{value:.{places}f}", wanted
    return f"{value:.{MOST_DECIMALS}f}", f"{limit:.{MOST_DECIMALS}f}"


def percent(value: float, limit: float) -> tuple[str, str]:
    """Print a share and its limit as percent, as `beside`."""
    found, wanted = beside(value, limit, 0, 100.0)
    return f"{found} %", f"{wanted} %"


def counted(number: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun, such as "1 tie point" and "3 tie points"."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"
