"""What the options of a stage, and the files they name, would have PDAL open beyond this machine.

Strings are looked through wherever they stand, JSON inside strings too. Of files, those that name others:
GDAL knows them by what they hold and not by their ending, so every file that it is to open is looked into.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.paths import real
from mtpcr_geo.pipeline.grammar import StageSpec

_REMOTE = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)
_VIRTUAL = re.compile(r"(^|[\s\"'{(\[,=])/vsi", re.IGNORECASE)
# GDAL opens "PG:host=...", "WMS:..." and inline XML where a file is expected; one letter is a drive
_CONNECTION = re.compile(r"\s*(<|[A-Za-z][A-Za-z0-9_]+:(?!//))")
_IN_QUERY = re.compile(r"[\"'`\[]\s*[A-Za-z][A-Za-z0-9_]+:")
_BY_GDAL = frozenset({"raster", "datasource", "ramp", "ogr"})
_FILES = _BY_GDAL | {"filename", "path", "addons"}
_GDAL_STAGES = frozenset({"readers.gdal", "writers.gdal", "writers.raster", "writers.ogr"})
_QUERIES = frozenset({"query", "sql", "layer"})

_NAMESPACE = re.compile(r"\sxmlns(:[\w.-]+)?\s*=\s*(\"[^\"]*\"|'[^']*')")
_SERVICES = re.compile(
    r"<\s*(GDAL_WMS|GDAL_WMTS|WMS_Capabilities|WMT_MS_Capabilities|WCS_GDAL|Service|OGRWFS)\b"
)
_NAMED = re.compile(
    r"<(SourceFilename|SourceDataset|SrcDataSource|SourceDataSource|KernelFilename|DEMFilename)\b[^>]*>\s*([^<]+?)\s*<"
)
# a CRS as JSON names its schema, which PROJ does not fetch
_SCHEMA, _SCHEMA_OF_CRS = "$schema", "https://proj.org/schemas/"
_LOOK_BYTES = 4 * 2**20
_DEEPEST = 8


def check(spec: StageSpec) -> None:
    """Refuse what a stage would open beyond this machine.

    Raises:
        OptionError: naming the stage, the option and what it names.

    """
    for name, text in _texts(spec.options):
        if _reaches_out(name, text, by_gdal=name in _BY_GDAL or spec.type in _GDAL_STAGES):
            raise OptionError(
                f"{spec.label}: option {name!r} names something remote or virtual, {text[:60]!r}; "
                "say --allow-network to let it"
            )
        if name in _BY_GDAL or (name in _FILES and spec.type in ("readers.gdal", "readers.ept")):
            found = _named_by(Path(text), set())
            if found is not None:
                file, what = found
                raise OptionError(
                    f"{spec.label}: option {name!r} names {file}, which names something remote or virtual, "
                    f"{what[:60]!r}; say --allow-network to let it"
                )


def _reaches_out(name: str, text: str, *, by_gdal: bool) -> bool:
    """Return whether a text names what is not here; to PDAL itself a colon in a file's name is none."""
    if _REMOTE.search(text) or _VIRTUAL.search(text):
        return True
    if name in _QUERIES and _IN_QUERY.search(text):
        return True
    return by_gdal and name in _FILES and _CONNECTION.match(text) is not None


def _texts(options: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, str]]:
    """Yield every text among options with the nearest name above it; keys are texts too."""
    for name, value in options.items():
        if depth == 0 and name == "user_data":
            continue
        if depth:
            yield "key", name
        yield from _texts_of(name, value, depth)


def _texts_of(name: str, value: Any, depth: int) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        yield from _texts(value, depth + 1)
    elif isinstance(value, list):
        for one in value:
            yield from _texts_of(name, one, depth + 1)
    elif name == _SCHEMA and str(value).startswith(_SCHEMA_OF_CRS):
        return
    elif isinstance(value, str):
        inner = _json_in(value)
        if inner is None:
            yield name, value
        elif depth > _DEEPEST:
            raise OptionError(f"option {name!r} holds JSON within JSON too deeply; write it as plain JSON")
        else:
            yield from _texts_of(name, inner, depth + 1)


def _json_in(text: str) -> Any:
    """Return the object or array that a text holds as JSON, or None."""
    if not text.lstrip().startswith(("{", "[", '"')):
        return None
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        # it is looked through as it stands
        return None


def _named_by(path: Path, seen: set[Path]) -> tuple[Path, str] | None:
    """Return the file that names something remote, this one or one that it names, and what; or None."""
    try:
        target = real(path)
        if target in seen or not target.is_file() or len(seen) > 1000:
            return None
        seen.add(target)
        with target.open("rb") as file:
            head = file.read(_LOOK_BYTES)
    except (OSError, ValueError):
        return None
    text = head.decode("latin-1").lstrip("\u00ef\u00bb\u00bf \t\r\n")
    if text.startswith("<"):
        return _named_by_xml(path, text, seen)
    if text.startswith(("{", "[")):
        remote = re.search(r"\"(href|url|uri|ogr|path|filename)\"\s*:\s*\"([^\"]*)\"", text)
        what = remote.group(2).replace("\\/", "/") if remote else ""
        return (path, what) if what and _reaches_out("filename", what, by_gdal=True) else None
    return None


def _named_by_xml(path: Path, text: str, seen: set[Path]) -> tuple[Path, str] | None:
    service = _SERVICES.search(text)
    if service is not None:
        return path, service.group(0)
    # names of namespaces are no addresses
    rest = _NAMESPACE.sub("", text)
    remote = _REMOTE.search(rest) or _VIRTUAL.search(rest) or re.search(r">\s*/vsi", rest, re.IGNORECASE)
    if remote is not None:
        return path, rest[remote.start() : remote.start() + 60]
    for match in _NAMED.finditer(rest):
        named = match.group(2)
        if _reaches_out("filename", named, by_gdal=True):
            return path, named
        for place in (path.parent / named, Path(named)):
            found = _named_by(place, seen)
            if found is not None:
                return found
    return None
