"""A pipeline from Python, in the manner of python-pdal."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.runner import RunResult, Settings, execute, validate
from mtpcr_geo.pipeline.stage import Value

if TYPE_CHECKING:
    from mtpcr_geo.core.types import Pair, Verdict


class Pipeline:
    """A pipeline of our stages and PDAL's.

    Args:
        spec: the pipeline: JSON text, the array of stages, or an object with the key "pipeline".
        overrides: changes of options, each ``name.option=value``.
        overwrite: replace files that are already there.
        allow_code, allow_network: let PDAL stages run code, or reach beyond this machine.
        progress: where long work reports.

    Example:
        >>> from mtpcr_geo import Pipeline
        >>> stages = ["target.laz", "source.laz", {"type": "mtpcr.register"}, {"type": "mtpcr.apply"}]
        >>> pipeline = Pipeline([*stages, "registered.laz"])
        >>> pipeline.execute()  # doctest: +SKIP
        99618
        >>> pipeline.verdict.name  # doctest: +SKIP
        'accepted'

    """

    def __init__(
        self,
        spec: str | bytes | Sequence[Any] | Mapping[str, Any],
        overrides: Iterable[str] = (),
        *,
        overwrite: bool = False,
        allow_code: bool = False,
        allow_network: bool = False,
        progress: Progress | None = None,
    ) -> None:
        text = spec if isinstance(spec, str | bytes) else json.dumps(spec)
        elements = grammar.parse(text)
        grammar.override(elements, overrides)
        self._specs = grammar.link(elements)
        self._settings = Settings(overwrite=overwrite, allow_code=allow_code, allow_network=allow_network)
        self._progress = progress
        self._result: RunResult | None = None

    @classmethod
    def from_file(cls, path: str | Path, overrides: Iterable[str] = (), **settings: Any) -> Pipeline:
        """Read a pipeline from a file; relative names in it are relative to the current folder.

        Raises:
            InputError: if the file cannot be read.

        """
        return cls(read_text(path), overrides, **settings)

    def validate(self) -> None:
        """Find what is wrong without running: grammar, options, files, CRS.

        Raises:
            MtpcrError: the first thing found.

        """
        validate(self._specs, self._settings)

    def execute(self) -> int:
        """Run the pipeline, and give the number of points that came out at its end.

        Raises:
            MtpcrError: whatever stopped it; no output is left then.

        """
        self._result = execute(self._specs, self._settings, self._progress)
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
        """What the stages noted, by type as PDAL has it: a list where a type comes more than once."""
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


def metadata_of(result: RunResult) -> dict[str, Any]:
    """Gather stages' metadata as PDAL does: ``{"metadata": {type: ...}}``, and beside it by tag."""
    by_type: dict[str, list[Any]] = {}
    for entry in result.done:
        by_type.setdefault(entry["type"], []).append(entry["metadata"])
    return {
        "metadata": {kind: found[0] if len(found) == 1 else found for kind, found in by_type.items()},
        "stages": {
            entry["tag"]: {key: value for key, value in entry.items() if key != "tag"}
            for entry in result.done
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
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read the pipeline {path}: {error.strerror}") from error


def _arrays(cloud: Cloud) -> list[NDArray[np.void]]:
    records = getattr(cloud, "records", None)
    if records is not None:
        return list(records())
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
