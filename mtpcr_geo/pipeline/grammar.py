"""The grammar of a pipeline: PDAL's JSON, with its comments, bare filenames and implicit chaining.

`parse` gives the elements, `override` changes options by name, `link` resolves who takes from whom.
"""

from __future__ import annotations

import glob
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.suggestions import meant

_TAG = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
ANY_READER = "mtpcr.read"
CLOUD_WRITERS = ("mtpcr.write", "mtpcr.write_each")
_GLOB = re.compile(r"[*?\[]")
_OWN_KEYS = frozenset({"type", "tag", "inputs"})

READER_BY_SUFFIX = {
    ".copc.laz": "readers.copc",
    ".las": "readers.las",
    ".laz": "readers.las",
}
WRITER_BY_SUFFIX = {
    ".copc.laz": "writers.copc",
    ".las": "writers.las",
    ".laz": "writers.las",
    ".tif": "writers.gdal",
    ".tiff": "writers.gdal",
}
# what PDAL infers and only PDAL can serve
_PDAL_READER_SUFFIXES = {
    ".bin": "readers.terrasolid", ".bpf": "readers.bpf", ".csd": "readers.optech", ".csv": "readers.text",
    ".e57": "readers.e57", ".obj": "readers.obj", ".pcd": "readers.pcd", ".ply": "readers.ply",
    ".pts": "readers.pts", ".ptx": "readers.ptx", ".qi": "readers.qfit", ".sbet": "readers.sbet",
    ".tif": "readers.gdal", ".tiff": "readers.gdal", ".tindex": "readers.tindex", ".txt": "readers.text",
    ".xyz": "readers.text",
}  # fmt: skip
_PDAL_WRITER_SUFFIXES = {
    ".bpf": "writers.bpf", ".csv": "writers.text", ".e57": "writers.e57", ".glb": "writers.gltf",
    ".gltf": "writers.gltf", ".json": "writers.text", ".pcd": "writers.pcd", ".ply": "writers.ply",
    ".sbet": "writers.sbet", ".txt": "writers.text", ".xyz": "writers.text",
}  # fmt: skip


@dataclass
class Element:
    """One element of the JSON as written, before stages are linked.

    Attributes:
        position: place in the pipeline, from 1.
        type: such as "readers.las"; inferred from the filename where the JSON names none.
        tag: as written, or None.
        inputs: tags as written, or None for all current ones.
        options: everything else.

    """

    position: int
    type: str
    tag: str | None
    inputs: tuple[str, ...] | None
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def is_reader(self) -> bool:
        """Return whether it starts a chain."""
        return self.type.startswith("readers.") or self.type == ANY_READER

    @property
    def is_writer(self) -> bool:
        """Return whether it leaves a file."""
        return self.type.startswith("writers.")

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"stage {self.tag or self.position} ({self.type})"


@dataclass(frozen=True)
class StageSpec:
    """A stage with everything settled: what it is, what it takes from, its options.

    Attributes:
        position: place in the pipeline as written, from 1.
        type: such as "mtpcr.level".
        tag: unique; made from the type where the JSON gives none.
        inputs: tags of the stages it takes from, all before it.
        options: as written.

    """

    position: int
    type: str
    tag: str
    inputs: tuple[str, ...]
    options: Mapping[str, Any]

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"stage {self.tag} ({self.type})"


def parse(text: str | bytes, where: str = "the pipeline") -> list[Element]:
    """Read pipeline JSON: a bare array or ``{"pipeline": [...]}``, comments allowed.

    Raises:
        OptionError: if it is not JSON, or not a pipeline.

    """
    root = _load(text, where)
    if isinstance(root, dict):
        if "pipeline" not in root:
            raise OptionError(f'{where} has no key "pipeline"{meant("pipeline", list(root), turned=True)}')
        root = root["pipeline"]
    if not isinstance(root, list):
        raise OptionError(f'{where} must be an array of stages, or an object whose key "pipeline" is one')
    if not root:
        raise OptionError(f"{where} holds no stages")
    return [_element(raw, i, len(root)) for i, raw in enumerate(root)]


def override(elements: Sequence[Element], changes: Iterable[str]) -> None:
    """Change options by ``name.option=value``, in place.

    A name is a stage type (all its stages), a tag, or ``stage.<tag>`` as PDAL writes it; what names a
    tag wins over what names a type.

    Raises:
        OptionError: if no stage has that name, or there is no ``=``.

    """
    by_tag: list[tuple[Element, str, str]] = []
    for change in changes:
        name, equals, value = change.removeprefix("--").partition("=")
        stage, dot, option = name.rpartition(".")
        if not (equals and dot and option):
            raise OptionError(f"cannot read the override --{name}; write --stage.option=value")
        hit = [e for e in elements if e.type == stage]
        for element in hit:
            element.options[option] = value
        if not hit:
            hit = [e for e in elements if e.tag is not None and stage in (e.tag, f"stage.{e.tag}")]
            by_tag += [(element, option, value) for element in hit]
        if not hit:
            names = [e.type for e in elements] + [e.tag for e in elements if e.tag]
            hint = meant(stage.removeprefix("stage."), names)
            raise OptionError(f"the override --{name}={value} names no stage of the pipeline{hint}")
    for element, option, value in by_tag:
        element.options[option] = value


def link(elements: Sequence[Element]) -> list[StageSpec]:
    """Settle tags and inputs as PDAL does.

    A reader joins the current inputs; any other stage takes its ``inputs``, or else all current ones,
    and becomes the current one. A reader whose filename is a pattern becomes one reader a file.

    Raises:
        OptionError: on a tag used twice, missing or defined later, and on a stage without input.

    """
    specs: list[StageSpec] = []
    later = {e.tag: e.position for e in elements if e.tag}
    members: dict[str, tuple[str, ...]] = {}
    taken: set[str] = set(later)
    current: tuple[str, ...] = ()
    for element in elements:
        if element.tag in members:
            raise OptionError(
                f"{element.label}: the tag {element.tag!r} is used twice; give each stage its own"
            )
        if element.is_reader:
            if element.inputs is not None:
                raise OptionError(f"{element.label}: a reader takes no inputs; remove them")
            made = _readers(element, taken)
            current += tuple(spec.tag for spec in made)
        else:
            inputs = current if element.inputs is None else _inputs(element, members, later)
            if not inputs:
                raise OptionError(f"{element.label} has nothing to take: no stage stands before it")
            made = [_spec(element, element.tag or _free_tag(element.type, taken), inputs)]
            current = (made[0].tag,)
        specs += made
        members[element.tag or made[0].tag] = tuple(spec.tag for spec in made)
    return specs


def dump(stages: Sequence[Mapping[str, Any]]) -> str:
    """Write stages as the JSON that `parse` reads."""
    text = json.dumps({"pipeline": list(stages)}, indent=2, ensure_ascii=False)
    # what a terminal would obey, or could not show, in JSON's own escapes
    return "".join(
        letter if letter.isprintable() or letter == "\n" else json.dumps(letter)[1:-1] for letter in text
    )


def _load(text: str | bytes, where: str) -> Any:
    if isinstance(text, bytes):
        try:
            text = text.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise OptionError(
                f"{where} is not UTF-8 text (byte {error.start} is 0x{text[error.start]:02x}); "
                "save it as UTF-8"
            ) from error
    try:
        return json.loads(
            _without_comments(text.removeprefix("\ufeff"), where),
            object_pairs_hook=lambda pairs: _object(pairs, where),
            parse_constant=lambda word: _no_constant(word, where),
        )
    except json.JSONDecodeError as error:
        raise OptionError(
            f"{where} is not JSON: line {error.lineno}, column {error.colno}: {error.msg}"
        ) from error
    except ValueError as error:
        # Python reads no integers of more than some thousand digits
        raise OptionError(f"{where} holds a number of too many digits; write fewer") from error
    except RecursionError as error:
        raise OptionError(f"{where} is nested too deeply to be a pipeline") from error


def _without_comments(text: str, where: str) -> str:
    """Blank out // and /* */ outside strings, keeping every line and column where it was."""
    out = list(text)
    i, in_string = 0, False
    while i < len(text):
        if in_string:
            if text[i] == "\\":
                i += 1
            elif text[i] in '"\n':
                in_string = False
            i += 1
            continue
        if text[i] == '"':
            in_string = True
        end = None
        if text.startswith("//", i):
            end = text.find("\n", i)
            end = len(text) if end < 0 else end
        elif text.startswith("/*", i):
            close = text.find("*/", i + 2)
            if close < 0:
                raise OptionError(
                    f"{where}: the comment that opens in line {text.count(chr(10), 0, i) + 1} never ends"
                )
            end = close + 2
        if end is None:
            i += 1
            continue
        for j in range(i, end):
            if out[j] != "\n":
                out[j] = " "
        i = end
    return "".join(out)


def _object(pairs: list[tuple[str, Any]], where: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise OptionError(f'{where}: the key "{key}" stands twice in one stage; keep one')
        found[key] = value
    return found


def _no_constant(word: str, where: str) -> Any:
    raise OptionError(f"{where} is not JSON: {word} is no JSON number")


def _element(raw: Any, index: int, total: int) -> Element:
    place = f"stage {index + 1}"
    if isinstance(raw, str):
        raw = {"filename": raw}
    if not isinstance(raw, dict):
        raise OptionError(f"{place} is {_kind(raw)}; a stage is a filename or an object")
    kind, tag = raw.get("type", ""), raw.get("tag")
    if not isinstance(kind, str):
        raise OptionError(f'{place}: "type" must be a string such as "mtpcr.level", not {_kind(kind)}')
    kind = kind or _inferred(raw, place, last=index == total - 1, first=index == 0)
    if tag is not None and (not isinstance(tag, str) or not _TAG.match(tag)):
        raise OptionError(
            f"{place} ({kind}): the tag {tag!r} must be a letter followed by letters, digits or underscores"
        )
    options = {key: value for key, value in raw.items() if key not in _OWN_KEYS}
    return Element(index + 1, kind, tag, _input_tags(raw, f"{place} ({kind})"), options)


def _input_tags(raw: Mapping[str, Any], place: str) -> tuple[str, ...] | None:
    inputs = raw.get("inputs")
    if inputs is None:
        return None
    listed = [inputs] if isinstance(inputs, str) else inputs
    if not isinstance(listed, list) or not all(isinstance(tag, str) for tag in listed):
        raise OptionError(f'{place}: "inputs" must be a tag or a list of tags')
    # an empty list means the same as none, as in PDAL
    return tuple(listed) or None


def _inferred(raw: Mapping[str, Any], place: str, *, first: bool, last: bool) -> str:
    filename = file_of(raw)
    if not filename:
        raise OptionError(f'{place} has neither "type" nor "filename"{meant("type", list(raw), turned=True)}')
    reads = first or not last
    own, other = (
        (READER_BY_SUFFIX, _PDAL_READER_SUFFIXES) if reads else (WRITER_BY_SUFFIX, _PDAL_WRITER_SUFFIXES)
    )
    name = filename.lower()
    for suffix, kind in {**own, **other}.items():
        if name.endswith(suffix):
            return kind
    raise OptionError(
        f"{place}: cannot tell the {'reader' if reads else 'writer'} from the name {filename!r}; "
        f'say it with "type", such as "{"readers" if reads else "writers"}.las"'
    )


def file_of(options: Mapping[str, Any]) -> str | None:
    """Return the filename among options: a string, or the path of PDAL's file specification."""
    filename = options.get("filename")
    if isinstance(filename, Mapping):
        filename = filename.get("path")
    return filename if isinstance(filename, str) else None


def _readers(element: Element, taken: set[str]) -> list[StageSpec]:
    filename = file_of(element.options)
    files: list[str] = []
    # the reader of any format takes a pattern itself, as one cloud
    pattern = element.type != ANY_READER and filename and _GLOB.search(filename)
    if filename and pattern and not os.path.exists(filename):
        files = sorted(glob.glob(filename))
        if not files:
            raise OptionError(f"{element.label}: no file fits the pattern {filename!r}")
    if len(files) < 2:
        options = {**element.options, "filename": files[0]} if files else element.options
        return [_spec(element, element.tag or _free_tag(element.type, taken), (), options)]
    return [
        _spec(
            element, _free_tag(element.tag or element.type, taken), (), {**element.options, "filename": file}
        )
        for file in files
    ]


def _inputs(
    element: Element, members: Mapping[str, tuple[str, ...]], later: Mapping[str, int]
) -> tuple[str, ...]:
    found: tuple[str, ...] = ()
    for tag in element.inputs or ():
        if tag == element.tag:
            raise OptionError(f"{element.label} takes from itself; a pipeline has no cycles")
        if tag in members:
            found += members[tag]
        elif tag in later:
            raise OptionError(
                f"{element.label} takes from {tag!r}, which stands after it; move it behind (no cycles)"
            )
        else:
            raise OptionError(
                f"{element.label} takes from {tag!r}, but no stage has that tag{meant(tag, members)}"
            )
    return found


def _spec(
    element: Element, tag: str, inputs: tuple[str, ...], options: Mapping[str, Any] | None = None
) -> StageSpec:
    return StageSpec(element.position, element.type, tag, inputs, options or dict(element.options))


def _free_tag(base: str, taken: set[str]) -> str:
    """Make a tag as PDAL does: the type with underscores and a number."""
    stem, number = base.replace(".", "_"), 1
    while f"{stem}{number}" in taken:
        number += 1
    taken.add(f"{stem}{number}")
    return f"{stem}{number}"


def _kind(value: Any) -> str:
    names = {dict: "an object", list: "an array", str: "a string", bool: "true or false", type(None): "null"}
    return names.get(type(value), "a number")
