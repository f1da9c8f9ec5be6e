"""No partial files: outputs are written beside their place and renamed when the run is whole."""

from __future__ import annotations

import glob
import os
from pathlib import Path

from mtpcr_geo.core.errors import OutputError


class OutputSet:
    """The files of one run, written under temporary names, and put in place together.

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

    def check(self, final: Path) -> None:
        """Refuse early what could not be put in place later.

        Raises:
            OutputError: if the file exists and may not be replaced, or its folder cannot be written.

        """
        if final.is_dir():
            raise OutputError(f"{final} is a folder; name a file to write")
        if final.exists() and not self.overwrite:
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
        part = final.with_name(f".{final.stem}.part-{os.getpid()}{final.suffix}")
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

    def commit(self) -> list[Path]:
        """Put everything in place; return what was written, in order.

        Raises:
            OutputError: if a file cannot be put in place.

        """
        written = []
        for final, part in self._parts.items():
            if not part.exists():
                continue
            try:
                os.replace(part, final)
            except OSError as error:
                raise OutputError(f"cannot put {final} in place: {error.strerror}") from error
            written.append(final)
        self._parts.clear()
        self._made_folders.clear()
        return written

    def discard(self) -> None:
        """Remove everything not committed, and the folders made for it."""
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


def _pattern(template: Path) -> str:
    return glob.escape(template.name).replace("#", "*", 1)
