"""How the lines of a text file are laid out, where a user says so: columns, separator, lines to skip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

LEFT_OUT = "-"
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " ", "blank": " "}
_KEYS = ("columns", "separator", "decimal", "skip")


@dataclass(frozen=True)
class TextLayout:
    """What is declared of a text file with a point a line.

    Attributes:
        columns: names in the order of the columns, ``-`` for one that is left out; empty where they are to be
            found.
        separator: character between columns, "" for blanks of any number; None where it is to be found.
        decimal: "." or ",".
        skip: lines before the points, or before the line that names the columns; None where they are found.

    """

    columns: tuple[str, ...] = ()
    separator: str | None = None
    decimal: str = "."
    skip: int | None = None

    @classmethod
    def read(cls, given: str | Mapping[str, Any]) -> TextLayout:
        """Read a layout: names of columns, then ``separator=``, ``decimal=`` and ``skip=``, as far as wanted.

        Args:
            given: such as ``x y z - intensity separator=; decimal=, skip=2``, or a mapping of the same.

        Raises:
            ValueError: saying what is wrong, and what is right.

        """
        values = dict(given) if isinstance(given, Mapping) else _parsed(given)
        unknown = [key for key in values if key not in _KEYS]
        if unknown:
            raise ValueError(f"{unknown[0]!r} is none of {', '.join(_KEYS)}")
        columns = values.get("columns", ())
        names = tuple(columns.replace(",", " ").split() if isinstance(columns, str) else map(str, columns))
        lower = [name.lower() for name in names if name != LEFT_OUT]
        if names and (not {"x", "y", "z"} <= set(lower) or len(set(lower)) < len(lower)):
            raise ValueError(
                "columns want x, y and z, and each name once; - stands for a column that is left out"
            )
        separator = values.get("separator")
        if separator is not None:
            separator = _SEPARATORS.get(str(separator).lower(), str(separator))
            if len(separator) != 1:
                raise ValueError(f"the separator is one character, or {', '.join(_SEPARATORS)}")
            separator = separator.strip(" ")
        decimal = str(values.get("decimal", "."))
        if decimal not in (".", ",") or decimal == separator:
            raise ValueError("the decimal sign is . or , and not the separator")
        skip = values.get("skip")
        if skip is not None and not (str(skip).isdecimal() and int(skip) < 1_000_000):
            raise ValueError("skip is a number of lines")
        return cls(names, separator, decimal, None if skip is None else int(skip))

    def __str__(self) -> str:
        """Return it as `read` takes it."""
        words = {"": "space", "\t": "tab"}
        parts = [*self.columns]
        if self.separator is not None:
            parts.append(f"separator={words.get(self.separator, self.separator)}")
        if self.decimal != ".":
            parts.append(f"decimal={self.decimal}")
        if self.skip is not None:
            parts.append(f"skip={self.skip}")
        return " ".join(parts)

    @property
    def kept(self) -> tuple[int, ...]:
        """The columns that are read, by their place."""
        return tuple(i for i, name in enumerate(self.columns) if name != LEFT_OUT)


def _parsed(text: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    names: list[str] = []
    for word in text.split():
        key, equals, value = word.partition("=")
        if not equals:
            names += [name for name in word.split(",") if name]
        elif key == "columns":
            names += [name for name in value.split(",") if name]
        else:
            values[key] = value
    return {**values, "columns": names} if names else values
