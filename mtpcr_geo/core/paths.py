"""Names of files, whatever they are: loops of links, no names at all, files without an end."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path

from mtpcr_geo.core.errors import InputError

LARGEST_TEXT = 2**28
"""Bytes of the largest description, transform or pipeline that is read whole."""
_OPEN_FILES = ("/dev/fd/", "/proc/")


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


def link_among(paths: Iterable[Path]) -> Path | None:
    """Return the first of some folders that is a link: what is written or removed there lies elsewhere."""
    return next((path for path in paths if path.is_symlink()), None)


def short(path: str | os.PathLike[str]) -> str:
    """Return a path for a message, its middle left out where it is very long."""
    text = os.fspath(path)
    return text if len(text) <= 200 else f"{text[:80]}...{text[-80:]}"


def read_whole(path: str | os.PathLike[str]) -> bytes:
    """Return what stands in a small file.

    What a shell puts in the place of a command's output is read to its end; a pipe with a name of its own,
    which may lie in any folder and never end, is refused.

    Raises:
        InputError: if it is larger than any description is, or has no end.
        OSError: if it cannot be read.

    """
    place = real(path)
    if not str(place).startswith(_OPEN_FILES) and place.is_fifo():
        raise InputError(f"{short(path)} is a named pipe, which may have no end; save it as a file")
    with Path(path).open("rb") as file:
        found = file.read(LARGEST_TEXT + 1)
    if len(found) > LARGEST_TEXT:
        raise InputError(f"{path} is larger than {LARGEST_TEXT // 2**20} MB, which no description is")
    return found
