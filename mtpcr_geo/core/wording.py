"""How numbers and texts are worded, so that what is printed says what was decided, and nothing else."""

from __future__ import annotations

from math import isfinite

SHORT_DECIMALS, MOST_DECIMALS = 2, 6


def beside(value: float, limit: float, decimals: int = 0, scale: float = 1.0) -> tuple[str, str]:
    """Print a value and the limit it was compared with, so that rounding hides no difference.

    Args:
        value: what was found.
        limit: what it was compared with.
        decimals: of both, unless more are needed to tell them apart.
        scale: both are multiplied by this before they are printed, such as 100 for percent.

    Returns:
        Both as text; they are equal only where the numbers are, to six decimals.

    """
    value, limit = value * scale, limit * scale
    short = f"{limit:.{SHORT_DECIMALS}f}".rstrip("0").rstrip(".")
    short = short if float(short) == round(limit, MOST_DECIMALS) else ""
    if not isfinite(value):
        return f"{value}", short or f"{limit:.{decimals}f}"
    for places in range(decimals, MOST_DECIMALS + 1):
        found, wanted = f"{value:.{places}f}", short or f"{limit:.{places}f}"
        if float(found) != float(wanted) and (float(found) < float(wanted)) == (value < limit):
            return found, wanted
    return found, wanted


def percent(value: float, limit: float) -> tuple[str, str]:
    """Print a share and its limit as percent, as `beside`."""
    found, wanted = beside(value, limit, 0, 100.0)
    return f"{found} %", f"{wanted} %"


def counted(number: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun: "1 tile", "3 tiles"."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def only(number: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun: "no tie points", "only 1 tie point", "only 3 tie points"."""
    nouns = one if number == 1 else many or one + "s"
    return f"only {number:,} {nouns}" if number else f"no {nouns}"


def visible(text: str) -> str:
    """Return a text with every character that is not shown written as an escape; line ends stay.

    Names of files, CRSs and stages come from strangers: a terminal obeys escape sequences, a browser
    right-to-left marks, and half a character (of a file name that is no text) cannot be written at all. Every
    text for a person goes through this on its way out.
    """
    if text.isprintable():
        return text
    # whole lines first: a report has half a million letters, and hardly one that is not shown
    return "\n".join(line if line.isprintable() else _escaped(line) for line in text.split("\n"))


def _escaped(line: str) -> str:
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in line)


def in_a_line(text: object) -> str:
    """Return a text as `visible` does, with line ends written as escapes too.

    A name of a file may hold them, and what is printed a line a fact would then hold lines of a stranger's.
    """
    return visible(str(text)).replace("\n", r"\n")
