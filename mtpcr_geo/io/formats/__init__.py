"""Clouds in other formats than LAS: PLY, PCD, text, PTS, PTX, E57 and NumPy's, all as `Cloud`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mtpcr_geo.core.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.io.file_cloud import FileCloud
    from mtpcr_geo.io.las import LasCloud

LAS_ENDINGS = (".las", ".laz")
MODULES = {
    ".ply": "ply",
    ".pcd": "pcd",
    ".e57": "e57",
    ".npy": "numpy_file",
    ".xyz": "text",
    ".txt": "text",
    ".csv": "text",
    ".asc": "text",
    ".pts": "text",
    ".ptx": "ptx",
}
"""Ending of a file, and the module that reads it."""


def is_other(path: str | Path) -> bool:
    """Return whether a file is, by its ending, of one of the formats that are read here."""
    return Path(path).suffix.lower() in MODULES


def open_any(
    path: str | Path, crs: CRS | None = None, text: str | Mapping[str, Any] | None = None
) -> LasCloud | FileCloud:
    """Open a cloud in any format that is read: LAS, LAZ, COPC by content, others by their ending.

    Args:
        path: the file; or a folder, a pattern, a ``.vpc`` or ``@`` and a list, whose files become one cloud.
        crs: coordinate reference system to take instead of what the file states.
        text: how a text file is laid out, see `text_layout.TextLayout.read`; found by itself if None. With it
            a file of any unknown ending is read as text.

    Raises:
        InputError: if it is missing, damaged, or of no format that is read; or no text and `text` is given.
        MissingPartError: if its library is not installed.

    """
    from mtpcr_geo.io.las import open_cloud
    from mtpcr_geo.io.many import is_many, join

    if is_many(path):
        return join(path, [open_any(file, crs, text) for file in files_at(path)], crs)
    path = Path(path)
    ending = path.suffix.lower()
    las = ending in LAS_ENDINGS or (path.is_file() and _begins_as_las(path))
    if text is not None and path.is_file():
        if las or MODULES.get(ending, "text") != "text":
            raise InputError(f"{path} is no text with a point a line; leave its text layout out")
        from mtpcr_geo.io.formats.text import open_file
        from mtpcr_geo.io.formats.text_layout import TextLayout

        return open_file(path, crs, TextLayout.read(text))
    if not path.is_file() or las:
        return open_cloud(path, crs)
    if ending in MODULES:
        module = import_module(f"mtpcr_geo.io.formats.{MODULES[ending]}")
        cloud: FileCloud = module.open_file(path, crs)
        return cloud
    endings = ", ".join([*LAS_ENDINGS, *MODULES])
    raise InputError(
        f"{path} ends in {ending or 'nothing'}, which says no format that is read ({endings}); convert it to "
        "LAS or PLY, for example by CloudCompare, read it by a reader of PDAL in a pipeline, or say its "
        "columns (--source-text, --text 'x y z'), if it is text"
    )


def files_at(path: str | Path) -> list[Path]:
    """Return the files that a path names: itself, or those of a folder, a pattern, a ``.vpc`` or a list.

    Raises:
        InputError: if it names several, and there is none.

    """
    from mtpcr_geo.io.many import files_of, is_many

    if not is_many(path):
        return [Path(path)]
    return files_of(path, lambda file: file.suffix.lower() in (*LAS_ENDINGS, *MODULES))


def _begins_as_las(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(4) == b"LASF"
    except OSError:
        return False
