"""How the lines of a text file are laid out, where nobody says so: found by its first lines."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.formats.text_layout import TextLayout

LOOKED_AT = 200
"""Lines by which a layout is found."""
_MARK = b"\xef\xbb\xbf"
_WIDE_MARKS = (b"\xff\xfe", b"\xfe\xff")
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)"
_IS_NUMBER = re.compile(_NUMBER, re.IGNORECASE)
_OF_COMMA = re.compile(r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?")
_QUOTED_COMMA = re.compile(r'"\s*[+-]?\d+,\d+\s*"')


def to_text(path: Path, stream: BinaryIO) -> None:
    """Go behind the mark with which some programs begin a text in UTF-8.

    Args:
        path: the file, for messages.
        stream: it, at its begin.

    Raises:
        InputError: if the text has characters of 16 bits.

    """
    begin = stream.read(len(_MARK))
    if begin[:2] in _WIDE_MARKS:
        raise InputError(f"{path} is text in UTF-16; save it as UTF-8 or ASCII")
    if begin != _MARK:
        stream.seek(0)


def found_layout(path: Path, lines: Sequence[bytes], layout: TextLayout) -> TextLayout:
    """Return a layout with separator and decimal sign, as far as first lines show what nobody declares.

    A comma is the decimal sign where columns are apart by semicolons, tabs or blanks, each number holds
    one comma at most, and none a point. Commas or semicolons are taken one by one, so that an empty field
    keeps its column, where all lines have as many of them.

    Args:
        path: the file, for messages.
        lines: its first lines.
        layout: what is declared; one with columns is left as it is.

    Raises:
        InputError: if numbers with commas stand in quotes, and commas between them.

    """
    if layout.columns:
        return layout
    texts = [line.decode("utf-8", errors="replace").split("#")[0].strip() for line in lines]
    if any(_QUOTED_COMMA.search(text) and re.search(r'",|,"', text) for text in texts):
        raise InputError(
            f"{path} has commas in its numbers and between them; export it with semicolons between columns"
        )
    texts = [text.replace('"', "") for text in texts]
    points = [i for i, text in enumerate(texts) if _is_point(text)]
    if not points:
        return layout
    rows = [texts[i] for i in points]
    if layout.decimal == "." and layout.separator != "," and _has_decimal_commas(rows):
        layout = replace(layout, decimal=",")
    if layout.separator is None:
        title = texts[points[0] - 1] if points[0] else ""
        for sign in (";",) if layout.decimal == "," else (";", ","):
            if _is_between(sign, rows, title, layout.decimal):
                return replace(layout, separator=sign)
    return layout


def _is_point(text: str) -> bool:
    """Return whether a line holds two numbers or more, whatever stands between them."""
    words = [word for word in re.split(r"[,;\s]+", text) if word]
    return len(words) > 1 and all(_IS_NUMBER.fullmatch(word) for word in words)


def _has_decimal_commas(rows: Sequence[str]) -> bool:
    if "." in "".join(rows):
        return False
    fields = [re.split(r"\s*;\s*|\s+", row.rstrip("; \t")) for row in rows]
    return any("," in row for row in rows) and all(
        len(one) >= 3 and all(not field or _OF_COMMA.fullmatch(field) for field in one) for one in fields
    )


def _is_between(sign: str, rows: Sequence[str], title: str, decimal: str) -> bool:
    """Return whether each of a sign parts two columns in all lines.

    Args:
        sign: it.
        rows: lines of numbers.
        title: the line before them, which may name the columns.
        decimal: the decimal sign.

    """
    fields = [[field.strip() for field in row.split(sign)] for row in rows]
    count = len(fields[0])
    if count < 3 or any(len(one) != count for one in fields):
        return False
    if not all(
        not field or _IS_NUMBER.fullmatch(field.replace(decimal, ".")) for one in fields for field in one
    ):
        return False
    # some programs put one behind the last column too
    names = title.split(sign)
    return any(one[-1] for one in fields) or (len(names) == count and bool(names[-1].strip()))


def empty_place(
    stream: BinaryIO, layout: TextLayout, places: Sequence[int], head: int
) -> tuple[int, int] | None:
    """Return where a field is empty that must not be: the line, counted from 1, and which of the columns.

    Args:
        stream: a file at its begin.
        layout: with a separator.
        places: columns to look at.
        head: lines before the points.

    Returns:
        None if there is no such field.

    """
    sign = (layout.separator or "").encode()
    for number, line in enumerate(stream, 1):
        fields = line.split(b"#")[0].replace(b'"', b"").split(sign)
        if number <= head or len(fields) < 2:
            continue
        for i, place in enumerate(places):
            if place >= len(fields) or not fields[place].strip():
                return number, i
    return None
