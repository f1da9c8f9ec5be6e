"""Advice in the words of where the reader is: errors name options as the command spells them.

Who calls from Python, or runs a pipeline, has the same options under other spellings. What raises an error
does not know who called: the outermost function that does, spells the option anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

from mtpcr_geo.core.errors import MtpcrError

P = ParamSpec("P")
R = TypeVar("R")
Spelling = Callable[[str, str], str]
"""Takes the name of an option, as in Python, and its value, "" where none is named; returns its writing."""

SWITCHES = frozenset({"local", "force", "overwrite", "allow_code", "allow_network", "inverse", "no_prior"})
"""Options that are on or off, of those that messages name."""

_NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
_WORDS = {
    "unit": "m|mm|cm|dm|km|in|ft|us-ft|yd",
    "axes": "[xyz]-(?:up|down)",
    "vertical": "refuse|assume-same|estimate",
    "level": "auto|ransac|none",
    "profile": "default|paper",
    "motion": "rigid|yaw|translation",
    "also": r"input|ply|pcd|xyz|csv|npy|e57|las|copc\.laz",
    "matcher": "correlation|bev|rootsift|orb|xfeat|superpoint",
    "prior": "georef",
}
"""Values that an option takes, by the end of its name; behind another they are words of the sentence."""
_CHOICE = "|".join(rf"(?<=-{name} )(?:{words})" for name, words in _WORDS.items())
_VALUE = rf"EPSG:(?:\.\.\.|\d+)|(?:local|{_CHOICE})(?![\w-])|{_NUMBER}|[XY](?!\w)"
_OPTION = re.compile(rf"(?<![\w-])--([a-z]+(?:-[a-z]+)*)(?![\w.=-])((?: (?:{_VALUE}))*)")

_in_command: ContextVar[bool] = ContextVar("in_command", default=False)


@contextmanager
def in_command() -> Iterator[None]:
    """Say that the command was called: its own spelling stays."""
    token = _in_command.set(True)
    try:
        yield
    finally:
        _in_command.reset(token)


@contextmanager
def advising(spelling: Spelling, *, command: bool = False) -> Iterator[None]:
    """Spell the options that an error from within names.

    Args:
        spelling: how an option is written where the caller is.
        command: also where the command was called, as for the options of its pipelines.

    """
    try:
        yield
    except MtpcrError as error:
        if (command or not _in_command.get()) and error.args and isinstance(error.args[0], str):
            error.args = (spelt(error.args[0], spelling), *error.args[1:])
        raise


def python_words(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of the Python interface: its errors name keywords, ``source_crs="local"``."""
    return advising(as_keyword)(function)


def as_called(text: str) -> str:
    """Return a text that names options of the command as its reader calls them: by keywords in Python."""
    return text if _in_command.get() else spelt(text, as_keyword)


def spelt(text: str, spelling: Spelling) -> str:
    """Return a text with every option of the command written as `spelling` has it."""

    def anew(found: re.Match[str]) -> str:
        return spelling(found[1].replace("-", "_"), found[2].strip())

    return _OPTION.sub(anew, text)


def as_keyword(name: str, value: str) -> str:
    """Return an option as a keyword of Python; its name alone where no value is known."""
    if name.startswith("no_") and name not in SWITCHES:
        return f"{name.removeprefix('no_')}=False"
    if name in SWITCHES:
        return f"{name}=True{' ' + value if value else ''}"
    return f"{name}={as_value(value)}" if value else name


def as_value(text: str) -> str:
    """Return a value of the command as JSON and Python both write it: a number, a list of them, or text."""
    words = text.split()
    if len(words) > 1:
        return f"[{', '.join(words)}]"
    return text if re.fullmatch(rf"{_NUMBER}|[XY]", text) else f'"{text}"'
