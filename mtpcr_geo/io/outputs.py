"""No partial files, no mixed sets: outputs are written beside their place and renamed when all are whole."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.paths import fault_of, short
from mtpcr_geo.io.journal import Journal, finish_left, folder_of, remove_left


class OutputSet:
    """The files of one run, written under temporary names, and put in place together or not at all.

    A journal stands while they are renamed: a run that is killed then leaves it, and the next one that writes
    to the folder finishes what was begun. What an earlier set had beside these goes with `replace`.

    Use as a context manager: leaving it by an exception removes everything it wrote, leaving it
    normally without `commit` does too.

    Args:
        overwrite: whether a file that is already there may be replaced.

    """

    def __init__(self, overwrite: bool = False) -> None:
        self.overwrite = overwrite
        self._parts: dict[Path, Path] = {}
        self._templates: dict[Path, Path] = {}
        self._made_folders: list[Path] = []
        self._kept: list[Path] = []
        self._removed: dict[Path, None] = {}
        self._looked: set[Path] = set()
        self._journals: list[Journal] = []

    def keep(self, paths: Iterable[Path]) -> None:
        """Name files that are read, and are never replaced, whatever name they are written by."""
        self._kept += paths

    def replace(self, paths: Iterable[Path]) -> None:
        """Name files of an earlier set: those that this one does not write are removed when it is in place.

        Without leave to overwrite nothing is removed, nor what is no regular file, nor an input.
        """
        for path in paths:
            if self.overwrite and path.is_file() and not path.is_symlink() and not self._is_kept(path):
                self._removed[path] = None

    def check(self, final: Path) -> None:
        """Refuse early what could not be put in place later.

        Raises:
            OutputError: if the file exists and may not be replaced, or its folder cannot be written.

        """
        # the temporary name is the longer one
        fault = fault_of(_part_of(final))
        if fault:
            raise OutputError(f"the name {short(final)} {fault}; choose another one")
        self._finish_left(final.parent)
        if final.is_dir():
            raise OutputError(f"{final} is a folder; name a file to write")
        there = os.path.lexists(final)
        if there and final.exists() and not final.is_file():
            raise OutputError(f"{final} is no regular file; name a file to write")
        if there and self._is_kept(final):
            raise OutputError(f"{final} is an input, and would be lost; write to another file")
        if there and not self.overwrite:
            raise OutputError(f"{final} exists already; remove it, choose another place, or give --overwrite")
        folder = final.parent
        while not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            raise OutputError(
                f"{folder} is a file, so {final} cannot be written below it; choose another place"
            )
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"cannot write to {folder}; choose a folder you may write to")

    def path(self, final: str | Path) -> Path:
        """Return the temporary name under which to write what becomes `final`.

        Raises:
            OutputError: as `check`, or if two stages want to write the same file.

        """
        final = Path(final)
        if final in self._parts:
            raise OutputError(f"two stages write {final}; give each its own file")
        self.check(final)
        try:
            self._make_folder(final.parent)
        except OSError as error:
            raise OutputError(f"cannot make the folder {final.parent}: {error.strerror}") from error
        # the suffix stays last: drivers choose the format by it
        part = _part_of(final)
        remove_left(part)
        self._parts[final] = part
        return part

    def template(self, final: str | Path) -> Path:
        """Return the temporary name for numbered files: the # in it is for a number, as in PDAL's writers.

        Raises:
            OutputError: if the folder cannot be written.

        """
        final = Path(final)
        part = self.path(final)
        del self._parts[final]
        self._templates[final] = part
        return part

    def adopt(self, final: str | Path) -> None:
        """Take over the numbered files written under a template's temporary name.

        Raises:
            OutputError: if one of them exists and may not be replaced.

        """
        final = Path(final)
        part = self._templates[final]
        before, after = part.name.split("#", 1)
        for path in sorted(part.parent.glob(_pattern(part))):
            number = path.name[len(before) : len(path.name) - len(after)]
            self._parts[final.with_name(final.name.replace("#", number, 1))] = path
        for written in self._parts:
            self.check(written)
        # an earlier set may have had more of them
        named = re.compile(re.escape(final.name).replace(re.escape("#"), r"\d+", 1))
        if final.parent.is_dir():
            self.replace(path for path in sorted(final.parent.iterdir()) if named.fullmatch(path.name))

    def _is_kept(self, final: Path) -> bool:
        return any(kept.exists() and final.exists() and kept.samefile(final) for kept in self._kept)

    def _finish_left(self, folder: Path) -> None:
        if folder in self._looked:
            return
        self._looked.add(folder)
        try:
            finish_left(folder)
        except OSError as error:
            raise OutputError(
                f"a run that was stopped left a set half in place in {folder}, and it cannot be finished: "
                f"{error.strerror}; clear the folder"
            ) from error

    def _make_folder(self, folder: Path) -> None:
        missing = []
        while not folder.exists():
            missing.append(folder)
            folder = folder.parent
        for path in reversed(missing):
            path.mkdir()
            self._made_folders.append(path)

    def written(self) -> list[Path]:
        """Return what has been written so far and waits to be put in place, in order."""
        return [final for final, part in self._parts.items() if part.exists()]

    def part_of(self, final: Path) -> Path | None:
        """Return where a file lies until it is put in place; None if it has not been written."""
        part = self._parts.get(final)
        return part if part is not None and part.exists() else None

    def commit(self) -> list[Path]:
        """Put everything in place; return what was written, in order.

        An interruption waits until all is in place.

        Raises:
            OutputError: if a file cannot be put in place.

        """
        parts = {final: part for final, part in self._parts.items() if part.exists()}
        removed = [path for path in self._removed if path not in parts]
        for final in parts:
            # since it was looked at first, it may have become what cannot be replaced
            self.check(final)
        journals = []
        try:
            for folder, files in folder_of([*parts, *removed]).items():
                mine = {final: part for final, part in parts.items() if final in files}
                journals.append(Journal(folder, mine, [path for path in removed if path in files]))
                journals[-1].write()
            self._journals = journals
        except BaseException as error:
            for journal in journals:
                journal.withdraw()
            if isinstance(error, OSError):
                raise OutputError(f"cannot put the outputs in place: {error.strerror}") from error
            raise
        _finish(journals)
        self._journals = []
        written = list(parts)
        self._removed.clear()
        self._parts.clear()
        self._made_folders.clear()
        return written

    def discard(self) -> None:
        """Remove everything not committed, and the folders made for it."""
        if self._journals:
            # it was as good as in place when it was stopped
            with suppress(OutputError):
                _finish(self._journals)
            return
        numbered = [path for part in self._templates.values() for path in part.parent.glob(_pattern(part))]
        for part in (*self._parts.values(), *numbered):
            part.unlink(missing_ok=True)
        self._parts.clear()
        self._templates.clear()
        for folder in reversed(self._made_folders):
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()
        self._made_folders.clear()

    def __enter__(self) -> OutputSet:
        return self

    def __exit__(self, *exc: object) -> None:
        self.discard()


def _finish(journals: list[Journal]) -> None:
    """Put sets in place, and let an interruption wait for it.

    Raises:
        OutputError: if a file cannot be put in place.

    """
    interrupted = None
    for journal in journals:
        while journal.path.exists():
            try:
                journal.finish()
            except KeyboardInterrupt as error:
                interrupted = error
            except OSError as error:
                raise OutputError(
                    f"cannot put {error.filename2 or error.filename} in place: {error.strerror}; "
                    "the next run that writes there tries again"
                ) from error
    if interrupted is not None:
        raise interrupted


def _part_of(final: Path) -> Path:
    return final.parent / f".{final.stem}.part-{os.getpid()}{final.suffix}"


def _pattern(template: Path) -> str:
    return glob.escape(template.name).replace("#", "*", 1)
