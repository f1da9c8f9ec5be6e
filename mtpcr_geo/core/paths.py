"""Names of files, whatever they are: loops of links, no names at all, files without an end."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from mtpcr_geo.core.errors import InputError

LARGEST_TEXT = 2**28
"""Bytes of the largest description, transform or pipeline that is read whole."""


def real(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a file with links followed; where that cannot be told, the path itself."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError):
        return Path(path)


def fault_of(path: str | os.PathLike[str]) -> str:
    """Return why a file can have no such name, whether it is there or not; "" if it can."""
    try:
        os.lstat(path)
    except ValueError:
        return "holds a character that no name of a file may"
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return "is longer than names of files may be"
    return ""


def short(path: str | os.PathLike[str]) -> str:
    """Return a path for a message, its middle left out where it is very long."""
    text = os.fspath(path)
    return text if len(text) <= 200 else f"{text[:80]}...{text[-80:]}"


def read_whole(path: str | os.PathLike[str]) -> bytes:
    """Return what stands in a small file.

    Raises:
        InputError: if it is larger than any description is, or has no end.
        OSError: if it cannot be read.

    """
    with Path(path).open("rb") as file:
        found = file.read(LARGEST_TEXT + 1)
    if len(found) > LARGEST_TEXT:
        raise InputError(f"{path} is larger than {LARGEST_TEXT // 2**20} MB, which no description is")
    return found
