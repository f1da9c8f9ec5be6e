"""Many files as one cloud: a folder, a pattern, a list, or a virtual point cloud (``.vpc``)."""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import numpy as np

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.core.paths import fault_of, read_whole, short
from mtpcr_geo.crs.facts import same_place
from mtpcr_geo.io.file_cloud import FileCloud

if TYPE_CHECKING:
    from pyproj import CRS

LIST_MARK = "@"
_MAYBE_NOTES = (".txt", ".csv", ".asc")


class ManyFiles(FileCloud):
    """Several files as one cloud: their points in the order of the files, in chunks as of one file.

    Attributes:
        parts: the clouds of the files.

    """

    def __init__(self, path: Path, crs: CRS | None, parts: Sequence[Cloud]) -> None:
        super().__init__(path, crs, f"{len(parts)} files", sum(part.count for part in parts))
        self.parts = tuple(parts)
        # a tile without points has bounds that say nothing
        some = [part for part in parts if part.count] or list(parts)
        self.minimum = np.min([part.minimum for part in some], axis=0)
        self.maximum = np.max([part.maximum for part in some], axis=0)

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[Floats]:
        """Yield (n, 3) float64 coordinates; but for the last chunk n = size, wherever a file ends."""
        rows = ((xyz,) for part in self.parts for xyz in part.xyz_chunks(size))
        for (xyz,) in _refilled(rows, size):
            yield xyz

    def noise_chunks(self, size: int = CHUNK_POINTS) -> Iterator[tuple[Floats, Mask]]:
        """Yield coordinates (n, 3) and which of them are noise or withheld (n,), likewise."""
        rows = _refilled((row for part in self.parts for row in part.noise_chunks(size)), size)
        yield from ((xyz, noise) for xyz, noise in rows)

    def keep(self, until: ExitStack) -> None:
        """Let the first pass over all coordinates keep those of each file in a temporary one."""
        for part in self.parts:
            part.keep(until)

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of the dimensions that all files with points have, n <= size rows each."""
        for part in self.parts:
            for table in part.table_chunks(size):
                if len(table["X"]):
                    yield {name: table[name] for name in self._names[0]}

    @property
    def uncommon(self) -> tuple[str, ...]:
        """The dimensions by PDAL name that some of the files have and others have not, left out of tables."""
        return self._names[1]

    @cached_property
    def _names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The dimensions that all files with points have, in the order of the first, and the others."""
        firsts = (next(iter(part.table_chunks(1)), None) for part in self.parts)
        rows = [list(first) for first in firsts if first is not None and len(first["X"])]
        every = dict.fromkeys(name for names in rows for name in names)
        common = tuple(name for name in every if all(name in names for names in rows))
        return common, tuple(name for name in every if name not in common)


def uncommon_of(cloud: Cloud) -> tuple[str, ...]:
    """Return the dimensions by PDAL name that a cloud lacks since not all files that it comes from have them.

    Args:
        cloud: any; what is seen through a view, or moved, is looked for below it.

    """
    while not isinstance(cloud, ManyFiles):
        base = getattr(cloud, "base", None)
        if not isinstance(base, Cloud):
            return ()
        cloud = base
    return cloud.uncommon


def _refilled(rows: Iterator[tuple[np.ndarray, ...]], size: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Cut columns anew, so that all chunks but the last have `size` rows."""
    kept: list[tuple[np.ndarray, ...]] = []
    held = 0
    for row in rows:
        kept.append(row)
        held += len(row[0])
        while held >= size:
            whole = (
                kept[0]
                if len(kept) == 1
                else tuple(np.concatenate(column) for column in zip(*kept, strict=True))
            )
            yield tuple(column[:size] for column in whole)
            held -= size
            kept = [tuple(column[size:] for column in whole)] if held else []
    if held:
        yield tuple(np.concatenate(column) for column in zip(*kept, strict=True))


def is_many(path: str | Path) -> bool:
    """Return whether a path names several files: a folder, a pattern, a ``.vpc``, or ``@`` and a list.

    Raises:
        InputError: if no file can have that name.

    """
    text = str(path)
    fault = fault_of(text.removeprefix(LIST_MARK))
    if fault:
        raise InputError(f"the name {short(text)} {fault}")
    found = Path(path)
    if found.is_dir() or text.startswith(LIST_MARK):
        return True
    if found.is_file():
        return found.suffix.lower() == ".vpc"
    return glob.has_magic(text)


def placed(name: str | os.PathLike[str], folder: str | os.PathLike[str] = "") -> Path:
    """Return a name of clouds that reads the same in any folder: absolute, links not followed.

    Args:
        name: of a file, a folder, a pattern, or ``@`` and a list.
        folder: what it is relative to; the present one if not given.

    """
    text = os.fspath(name)
    mark = LIST_MARK if text.startswith(LIST_MARK) else ""
    name = text.removeprefix(mark)
    if not mark and glob.has_magic(name) and not os.path.lexists(Path(folder, name)):
        # what the folder is called is no part of the pattern
        return Path(glob.escape(os.path.abspath(folder or os.curdir)), name)
    return Path(f"{mark}{Path(folder, name).absolute()}")


def files_of(path: str | Path, is_cloud: Callable[[Path], bool]) -> list[Path]:
    """Return the files that a path names, in the order of their names, or of the list.

    Args:
        path: a folder (the clouds right in it); a pattern such as ``tiles/*.laz``; a ``.vpc``; or ``@`` and a
            text file with a path a line, relative to it.
        is_cloud: whether a file in a folder is one.

    Raises:
        InputError: if there is none, or a list cannot be read.

    """
    text, found = str(path), Path(path)
    if text.startswith(LIST_MARK):
        files = _listed(Path(text[len(LIST_MARK) :]))
    elif found.is_dir():
        files = _clouds_of(sorted(one for one in found.iterdir() if one.is_file() and is_cloud(one)))
    elif found.is_file():
        files = _of_vpc(found)
    else:
        files = sorted(Path(one) for one in glob.glob(text, recursive=True) if Path(one).is_file())
        # "*" takes whatever lies there
        files = _clouds_of([one for one in files if is_cloud(one)] or files)
    if not files:
        raise InputError(f"{path} names no cloud; check the path, or the endings of the files")
    # whatever the name: os.path.isfile raises nothing
    missing = next((one for one in files if not os.path.isfile(one)), None)
    if missing is not None:
        raise InputError(f"{path} names {short(missing)}, which is not there; check the list")
    return files


def _clouds_of(files: list[Path]) -> list[Path]:
    """Leave out what may be a note or a table, where other files are clouds for certain."""
    certain = [one for one in files if one.suffix.lower() not in _MAYBE_NOTES]
    return certain or files


def join(path: str | Path, parts: Sequence[Cloud], crs: CRS | None) -> ManyFiles:
    """Join clouds of files to one.

    Args:
        path: what names them all.
        parts: the clouds.
        crs: coordinate reference system to take instead of what the files state.

    Raises:
        CrsError: if they state different ones. Where some state none, the whole states none either.

    """
    if crs is not None:
        return ManyFiles(Path(path), crs, parts)
    stated = [part for part in parts if part.crs is not None]
    for part in stated[1:]:
        first = stated[0]
        if first.crs is not None and part.crs is not None and not same_place(part.crs, first.crs):
            raise CrsError(
                f"{first.name} is in {first.crs.name} and {part.name} in {part.crs.name}; bring them to one "
                "system first"
            )
    whole = ManyFiles(Path(path), stated[0].crs if len(stated) == len(parts) else None, parts)
    if 0 < len(stated) < len(parts):
        silent = next(part for part in parts if part.crs is None)
        whole.crs_problem = f"{stated[0].name} states one, and {silent.name} states none"
    return whole


def output_names(files: Sequence[Path]) -> list[str]:
    """Return names for the moved files: those of the inputs, of other formats with .laz; each once."""
    names: list[str] = []
    for file in files:
        stem = file.name if file.suffix.lower() in (".las", ".laz") else f"{file.stem}.laz"
        name, number = stem, 2
        while name.lower() in {one.lower() for one in names}:
            base, dot, rest = stem.partition(".")
            name, number = f"{base}_{number}{dot}{rest}", number + 1
        names.append(name)
    return names


def _listed(path: Path) -> list[Path]:
    try:
        lines = read_whole(path).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot read the list {path} ({error}); give a text file with a path a line"
        ) from error
    names = [line.strip().strip("\"'") for line in lines]
    return [path.parent / name for name in names if name and not name.startswith("#")]


def _of_vpc(path: Path) -> list[Path]:
    try:
        features = json.loads(read_whole(path))["features"]
        places = [_local(_data_of(one["assets"])["href"]) for one in features]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration, RecursionError) as error:
        raise InputError(
            f"{path} is no virtual point cloud ({type(error).__name__}: {error}); make it anew"
        ) from error
    remote = next((place for place in places if "://" in place), None)
    if remote is not None:
        raise InputError(f"{path} names {remote}; only files on this machine are read")
    return [path.parent / place for place in places]


def _data_of(assets: dict[str, Any]) -> dict[str, Any]:
    """Return the asset of a STAC item that is its data: by its name or role, else the first."""
    if "data" in assets:
        return dict(assets["data"])
    by_role = (one for one in assets.values() if "data" in one.get("roles", ()))
    return dict(next(by_role, next(iter(assets.values()))))


def _local(place: Any) -> str:
    """Return a path of this machine for a ``file://`` address of it; all else as it is."""
    if not isinstance(place, str):
        raise TypeError(f"{place!r:.40} is no address of a file")
    parts = urlsplit(place)
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return url2pathname(parts.path)
    return place
