"""How the command shows an option: the group of its help, its name, its metavar."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

from pydantic.fields import FieldInfo

INPUTS = "Inputs and CRS"
RASTERS = "Levelling and rasters"
MATCHING = "Matching"
PRIOR = "Prior"
RESULT = "Result"
RUN = "Run"
OUTPUT = "Output"
GROUPS = (INPUTS, RASTERS, MATCHING, PRIOR, RESULT, RUN, OUTPUT)
"""Groups of the command's help, in order."""


@dataclass(frozen=True)
class Shown:
    """How the command shows an option.

    Attributes:
        group: heading under which it stands in the help.
        names: what is written on the command line; ``--name-of-the-field`` if empty, and for a switch that
            is on by default ``--no-name-of-the-field``, so that its description follows "do not".
        argument: it is given by its place, without a name.
        metavar: what stands for its value, where its type does not say enough.

    """

    group: str
    names: tuple[str, ...] = ()
    argument: bool = False
    metavar: str = ""


def description_of(kind: Any) -> str:
    """Return the description of an option's `Annotated` type."""
    return next(str(part.description) for part in get_args(kind)[1:] if isinstance(part, FieldInfo))


def shown_of(kind: Any) -> Shown:
    """Return how the command shows an option, from its `Annotated` type."""
    return next(part for part in get_args(kind)[1:] if isinstance(part, Shown))
