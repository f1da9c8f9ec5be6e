"""The journal of a set of files that is being put in place: what it began is finished by whoever comes next.

Once the journal stands, the set is as good as in place: a run that is stopped between two renames leaves the
journal, and the next one that writes to its folder goes on with it. A journal is a hint from a folder and not
an order: it may only rename and remove files beneath its own folder, and is taken from its owner alone.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mtpcr_geo.core.paths import real

_NAME = ".mtpcr-geo-{}.journal"
_NAMED = re.compile(r"\.mtpcr-geo-(\d{1,10})\.(journal|new)")
_PART = re.compile(r"\..+\.part-(\d{1,10})(\.[^./\\]*)?")
_LARGEST = 2**24


class Journal:
    """What is to be put in place and what removed, below one folder.

    Args:
        folder: where the journal stands.
        parts: the temporary file that becomes each file.
        removed: files of an earlier set, to be removed.

    """

    def __init__(self, folder: Path, parts: Mapping[Path, Path], removed: Iterable[Path]) -> None:
        self.path = folder / _NAME.format(os.getpid())
        self.parts = dict(parts)
        self.removed = list(removed)

    def write(self) -> None:
        """Put the journal in place, whole; from then on the set is as good as in place.

        Raises:
            OSError: if it cannot be written.

        """
        folder = self.path.parent

        def name(path: Path) -> str:
            return os.path.relpath(path, folder)

        document = {
            "put": [[name(part), name(final)] for final, part in self.parts.items()],
            "remove": [name(path) for path in self.removed],
        }
        new = self.path.with_suffix(".new")
        try:
            with new.open("w", encoding="utf-8") as file:
                json.dump(document, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(new, self.path)
        except BaseException:
            new.unlink(missing_ok=True)
            raise

    def withdraw(self) -> None:
        """Remove the journal: nothing of it was begun."""
        self.path.unlink(missing_ok=True)

    def finish(self) -> None:
        """Put in place what is not there yet, remove what goes, and the journal last; may be repeated.

        Raises:
            OSError: if a file cannot be put in place.

        """
        for final, part in self.parts.items():
            if part.exists():
                os.replace(part, final)
        for path in self.removed:
            path.unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)


def folder_of(paths: Iterable[Path]) -> dict[Path, list[Path]]:
    """Group files by the folder where their journal stands: one for all, unless they lie far apart."""
    files = list(paths)
    parents = {path: real(path.parent) for path in files}
    if not files:
        return {}
    try:
        common = Path(os.path.commonpath(list(parents.values())))
    except ValueError:
        common = None
    if common is not None and all(len(p.relative_to(common).parts) <= 2 for p in parents.values()):
        return {common: files}
    groups: dict[Path, list[Path]] = {}
    for path in files:
        groups.setdefault(parents[path], []).append(path)
    return groups


def finish_left(folder: Path) -> None:
    """Finish what journals of stopped runs began, in a folder and the two above it.

    A journal that cannot be read, or that names anything but files beneath its folder, is left alone.

    Raises:
        OSError: if a file cannot be put in place.

    """
    folder = real(folder)
    for place in (folder, *list(folder.parents)[:2]):
        for path in _listed(place):
            found = _NAMED.fullmatch(path.name)
            if found is None or runs(int(found.group(1))):
                continue
            if found.group(2) == "new":
                # nothing was begun
                if path.is_file() and not path.is_symlink():
                    path.unlink(missing_ok=True)
                continue
            journal = _read(path)
            if journal is not None:
                journal.finish()


def remove_left(part: Path) -> None:
    """Remove the temporary files that stopped runs left for the same file.

    Args:
        part: the temporary name that this process uses for it.

    """
    mine = _PART.fullmatch(part.name)
    if mine is None:
        return
    before, after = part.name[: mine.start(1)], part.name[mine.end(1) :]
    for path in _listed(part.parent):
        name = path.name
        found = _PART.fullmatch(name)
        if found is None or name[: found.start(1)] != before or name[found.end(1) :] != after:
            continue
        if path.is_file() and not path.is_symlink() and not runs(int(found.group(1))):
            path.unlink(missing_ok=True)


def runs(process: int) -> bool:
    """Return whether a process runs, as far as can be told: on Windows every one is taken to."""
    if os.name == "nt" or process == os.getpid():
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _listed(folder: Path) -> list[Path]:
    try:
        return [folder / name for name in os.listdir(folder) if name.startswith(".")]
    except OSError:
        return []


def _read(path: Path) -> Journal | None:
    try:
        facts = path.lstat()
        if path.is_symlink() or facts.st_size > _LARGEST or facts.st_uid != os.getuid():
            return None
        document = json.loads(path.read_text(encoding="utf-8"))
        parts = {_below(path, final): _below(path, part) for part, final in document["put"]}
        removed = [_below(path, name) for name in document["remove"]]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    for final, part in parts.items():
        if part.parent != final.parent or _PART.fullmatch(part.name) is None or final.is_dir():
            return None
    if not all(one.is_file() or not one.exists() for one in removed):
        return None
    journal = Journal(path.parent, parts, removed)
    journal.path = path
    return journal


def _below(journal: Path, name: Any) -> Path:
    """Return a file beneath the folder of a journal.

    Raises:
        ValueError: if the name leads elsewhere.

    """
    if not isinstance(name, str):
        raise TypeError("not a name")
    folder = real(journal.parent)
    path = folder / name
    if path.is_symlink() or ".." in Path(name).parts or not real(path).is_relative_to(folder):
        raise ValueError(f"{name} lies elsewhere")
    return path
