"""A pipeline from Python, in the manner of python-pdal."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.advice import advising
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.core.paths import read_whole
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.io.memory import cloud_of
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.advice import for_python
from mtpcr_geo.pipeline.runner import RunResult, Settings, execute, validate
from mtpcr_geo.pipeline.stage import Value
from mtpcr_geo.pipeline.stages.memory import MemoryReader

if TYPE_CHECKING:
    from mtpcr_geo.core.types import Pair, Verdict
    from mtpcr_geo.io.memory import CloudLike

    # what a pipeline can be given as
    Spec: TypeAlias = str | bytes | os.PathLike[str] | Sequence[Any] | Mapping[str, Any]

_WANTED = 'a path, JSON text, a list of stages, or a mapping with the key "pipeline"'


class Pipeline:
    """A pipeline of our stages and PDAL's.

    Pipelines, stages and filenames are put one behind the other by ``|``.

    Args:
        spec: the pipeline: a path, JSON text, the list of stages, or a mapping with the key "pipeline" or,
            for a single stage, "type".
        overrides: changes of options, each ``name.option=value``.
        arrays: clouds in memory, read before the first stage as if by readers tagged array1, array2 ...:
            (n, 3) coordinates, PDAL's structured arrays, `laspy.LasData` or `Cloud`.
        overwrite: replace files that are already there.
        allow_code, allow_network: let PDAL stages run code, or reach beyond this machine.
        progress: where long work reports.

    Raises:
        OptionError: if `spec` is no pipeline; the message names what was given.
        InputError: if a path cannot be read, or an array is no cloud.

    Example:
        >>> from mtpcr_geo import Pipeline
        >>> register = Pipeline(["target.laz", "source.laz", {"type": "mtpcr.register"}])
        >>> pipeline = register | {"type": "mtpcr.apply"} | "registered.laz"
        >>> pipeline.execute()  # doctest: +SKIP
        99618
        >>> pipeline.verdict.name  # doctest: +SKIP
        'accepted'

    """

    _result: RunResult | None = None

    def __init__(
        self,
        spec: Spec,
        overrides: Iterable[str] = (),
        *,
        arrays: Iterable[CloudLike] = (),
        overwrite: bool = False,
        allow_code: bool = False,
        allow_network: bool = False,
        progress: Progress | None = None,
    ) -> None:
        elements = grammar.parse(_text_of(spec))
        grammar.override(elements, overrides)
        given = {
            f"array{number}": cloud_of(points, f"array {number}")
            for number, points in enumerate(arrays, start=1)
        }
        readers = [grammar.Element(0, MemoryReader.type, tag, None) for tag in given]
        settings = Settings(overwrite=overwrite, allow_code=allow_code, allow_network=allow_network)
        self._set([*readers, *elements], given, settings, progress)

    @classmethod
    def from_file(cls, path: str | Path, overrides: Iterable[str] = (), **settings: Any) -> Pipeline:
        """Read a pipeline from a file; relative names in it are relative to the current folder.

        Raises:
            InputError: if the file cannot be read.

        """
        return cls(read_text(path), overrides, **settings)

    def __or__(self, other: Pipeline | Spec) -> Pipeline:
        """Put stages behind this pipeline; its settings hold for the whole.

        Args:
            other: a pipeline, a list of stages, one stage, or the name of a file to write.

        """
        return self._joined([self, other if isinstance(other, Pipeline) else self._part(other, last=True)])

    def __ror__(self, other: Spec) -> Pipeline:
        """Put stages, or the name of a file to read, before this pipeline."""
        return self._joined([self._part(other, last=False), self])

    def __len__(self) -> int:
        return len(self._elements)

    def __repr__(self) -> str:
        return f"Pipeline({' | '.join(element.type for element in self._elements)})"

    def validate(self) -> None:
        """Find what is wrong without running: grammar, options, files, CRS. No point is read.

        Raises:
            MtpcrError: the first thing found.

        """
        with advising(for_python(self._elements)):
            validate(self._specs, self._settings, self._given)

    def execute(self) -> int:
        """Run the pipeline, and return the number of points that came out at its end.

        Raises:
            MtpcrError: whatever stopped it; no output is left then.

        """
        with advising(for_python(self._elements)):
            self._result = execute(self._specs, self._settings, self._progress, self._given)
        return sum(cloud.count for cloud in self._last())

    @property
    def result(self) -> RunResult:
        """Everything the run made.

        Raises:
            RuntimeError: before `execute`.

        """
        if self._result is None:
            raise RuntimeError("the pipeline has not been executed")
        return self._result

    @property
    def stages(self) -> Mapping[str, Value | None]:
        """What each stage made, by tag: a cloud, a pair, or None where it was skipped."""
        return self.result.values

    @property
    def arrays(self) -> list[NDArray[np.void]]:
        """The points at the end of the pipeline, as structured arrays with PDAL's names."""
        return [array for cloud in self._last() for array in _arrays(cloud)]

    @property
    def metadata(self) -> dict[str, Any]:
        """What the stages reported, by type as PDAL has it: a list where a type comes more than once."""
        return metadata_of(self.result)

    @property
    def outputs(self) -> Sequence[Path]:
        """The files written."""
        return self.result.outputs

    @property
    def pair(self) -> Pair | None:
        """The state of the registration that got furthest, if the pipeline registers."""
        return self.result.pair

    @property
    def verdict(self) -> Verdict | None:
        """The judgement, if the pipeline registers."""
        return self.result.verdict

    def _last(self) -> list[Cloud]:
        taken = {tag for spec in self._specs for tag in spec.inputs}
        ends = [value for tag, value in self.result.values.items() if tag not in taken]
        return [value for value in ends if isinstance(value, Cloud)]

    @cached_property
    def _specs(self) -> list[grammar.StageSpec]:
        return grammar.link(self._elements)

    def _set(
        self,
        elements: Sequence[grammar.Element],
        given: Mapping[str, Cloud],
        settings: Settings,
        progress: Progress | None,
    ) -> None:
        self._elements = [replace(element, position=i) for i, element in enumerate(elements, start=1)]
        self._given = dict(given)
        self._settings = settings
        self._progress = progress
        # what begins with a filter is to be put behind something
        if self._elements[0].is_reader:
            grammar.link(self._elements)

    def _joined(self, parts: Sequence[Pipeline]) -> Pipeline:
        """Return pipelines one behind the other, with the settings of this one."""
        given: dict[str, Cloud] = {}
        elements: list[grammar.Element] = []
        for part in parts:
            new_tags = {tag: f"array{len(given) + i}" for i, tag in enumerate(part._given, start=1)}
            given |= {new_tags[tag]: cloud for tag, cloud in part._given.items()}
            for element in part._elements:
                tag = element.tag if element.tag is None else new_tags.get(element.tag, element.tag)
                inputs = element.inputs and tuple(new_tags.get(name, name) for name in element.inputs)
                elements.append(replace(element, tag=tag, inputs=inputs))
        return self._like(elements, given)

    def _part(self, spec: Spec, *, last: bool) -> Pipeline:
        """Return stages to be joined: a bare filename is written where it comes last, read elsewhere."""
        text = os.fspath(spec) if isinstance(spec, str | os.PathLike) else None
        if text is None or text.lstrip().startswith(("[", "{")) or text.lower().endswith(".json"):
            return self._like(grammar.parse(_text_of(spec)), {})
        # what stands beside another stage is not both first and last
        beside = {"type": "filters.merge"}
        found = grammar.parse(json.dumps([beside, text] if last else [text, beside]))
        return self._like(found[1:] if last else found[:1], {})

    def _like(self, elements: Sequence[grammar.Element], given: Mapping[str, Cloud]) -> Pipeline:
        made = Pipeline.__new__(Pipeline)
        made._set(elements, given, self._settings, self._progress)
        return made


def metadata_of(result: RunResult) -> dict[str, Any]:
    """Gather stages' metadata as PDAL does: ``{"metadata": {type: ...}}``, and beside it by tag."""
    by_type: dict[str, list[Any]] = {}
    for record in result.done:
        by_type.setdefault(record.type, []).append(record.metadata)
    return {
        "metadata": {kind: found[0] if len(found) == 1 else found for kind, found in by_type.items()},
        "stages": {
            record.tag: {key: value for key, value in record.audit().items() if key != "tag"}
            for record in result.done
        },
    }


def read_text(path: str | Path) -> bytes:
    """Read a pipeline's text; "-" is standard input.

    Raises:
        InputError: if it cannot be read.

    """
    if str(path) == "-":
        import sys

        return sys.stdin.buffer.read()
    try:
        return read_whole(path)
    except OSError as error:
        raise InputError(f"cannot read the pipeline {path}: {error.strerror}") from error


def _text_of(spec: Spec) -> str | bytes:
    """Return a pipeline as JSON text.

    Raises:
        OptionError: if it is none; the message names what was given.
        InputError: if it is a path that cannot be read.

    """
    if isinstance(spec, bytes):
        return spec
    if isinstance(spec, os.PathLike):
        return read_text(Path(spec))
    if isinstance(spec, str):
        if spec.lstrip("\ufeff \t\r\n").startswith(("[", "{", "//", "/*")):
            return spec
        if spec.lower().endswith(".json"):
            return read_text(spec)
        raise OptionError(f"a pipeline is {_WANTED}; {_short(spec)} is neither JSON nor a .json file")
    if isinstance(spec, Mapping) and "pipeline" not in spec and "type" in spec:
        spec = [spec]
    if not isinstance(spec, Mapping | Sequence):
        raise OptionError(f"a pipeline is {_WANTED}, and not {_what(spec)}")
    return json.dumps(spec, default=_json_value)


def _json_value(value: Any) -> Any:
    """Return what JSON can hold of a stage's option.

    Raises:
        OptionError: if it can hold none of it.

    """
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise OptionError(f"a pipeline cannot hold {_what(value)}; clouds in memory are given by arrays=")


def _what(value: Any) -> str:
    return f"{type(value).__name__} {_short(value)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _arrays(cloud: Cloud) -> list[NDArray[np.void]]:
    from mtpcr_geo.pipeline.pdal.cloud import PdalCloud

    if isinstance(cloud, PdalCloud):
        return cloud.records()
    tables = list(cloud.table_chunks())
    if not tables:
        return []
    made = np.empty(
        sum(len(table["X"]) for table in tables), [(name, values.dtype) for name, values in tables[0].items()]
    )
    start = 0
    for table in tables:
        stop = start + len(table["X"])
        for name, values in table.items():
            made[name][start:stop] = values
        start = stop
    return [made]
