"""A chain of PDAL stages as one cloud: streamed where PDAL can, held in memory where it cannot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.dimensions import separate_legacy_flags
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.views import Moved, xyz_of
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.pipeline.grammar import file_of
from mtpcr_geo.pipeline.pdal import library

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.pipeline.pdal.stages import PdalStage
    from mtpcr_geo.pipeline.stage import RunContext

Records = NDArray[np.void]

# chunks of a streamed chain are kept up to this size, so that small clouds run through PDAL once
_KEEP_BYTES = 256 * 2**20


@dataclass(frozen=True)
class Step:
    """A PDAL stage with what it takes from: other steps, or clouds that our stages made."""

    stage: PdalStage
    inputs: tuple[Step | Cloud, ...]


class PdalCloud(Cloud):
    """The points that a chain of PDAL stages gives; its attributes hold once it is evaluated."""

    def __init__(self, step: Step) -> None:
        self.step = step
        self.name = f"the output of {step.stage.label}"
        self.crs = None
        self.count = 0
        self.minimum = np.full(3, np.inf)
        self.maximum = np.full(3, -np.inf)
        self._held: list[Records] | None = None
        self._again: list[dict[str, Any]] = []
        self._steps: list[PdalStage] = []

    def evaluate(self, context: RunContext, *, need_crs: bool) -> None:
        """Run the chain in PDAL: streamed once for count and bounds where it can be, else whole.

        Raises:
            MtpcrError: with the name of the stage that PDAL blames.

        """
        self._steps = list(_stages_of(self.step))
        words = self._words(context)
        writers = [stage for stage in self._steps if stage.is_writer and not stage.written]
        pipeline = library.pipeline(words)
        with context.progress.task(f"PDAL: {self.step.stage.tag}"):
            streamed = pipeline.streamable
            metadata = self._stream_first(pipeline) if streamed else self._execute(words, need_crs)
        for stage in writers:
            stage.written = True
            template = numbered(stage)
            if template is not None:
                context.outputs.adopt(template)
        self._again = self._words(context)
        if need_crs and self.crs is None:
            self.crs = self._probed_crs()
        _share_metadata(self._steps, metadata)

    def records(self) -> list[Records]:
        """Return all points as structured arrays, in the manner of python-pdal."""
        return self._held if self._held is not None else list(self._stream(self._again, CHUNK_POINTS))

    def xyz_chunks(self, size: int = CHUNK_POINTS) -> Iterator[NDArray[np.float64]]:
        """Yield (n, 3) float64 coordinates, n <= size."""
        for table in self.table_chunks(size):
            yield xyz_of(table)

    def table_chunks(self, size: int = CHUNK_POINTS) -> Iterator[PointTable]:
        """Yield tables of all dimensions by PDAL name, n <= size rows each."""
        for records in self._held if self._held is not None else self._stream(self._again, size):
            for start in range(0, len(records), size):
                part = records[start : start + size]
                table = {name: part[name] for name in part.dtype.names or ()}
                yield separate_legacy_flags(table) if self._reads_las_alone else table

    @property
    def _reads_las_alone(self) -> bool:
        """Return whether all points are from LAS files: PDAL before 2.6 leaves flags in their class byte."""
        readers = [stage for stage in self._steps if stage.is_reader]
        return bool(readers) and all(stage.spec.type == "readers.las" for stage in readers)

    def _words(self, context: RunContext) -> list[dict[str, Any]]:
        """Put the chain in PDAL's JSON, without the writers that have written already."""
        words: dict[int, dict[str, Any]] = {}
        self._add(self.step, words, context)
        return list(words.values()) or [{"type": "readers.faux", "count": 0}]

    def _add(self, step: Step | Cloud, words: dict[int, dict[str, Any]], context: RunContext) -> list[str]:
        """Add a step and what it takes from; give the tags that stand for it."""
        from mtpcr_geo.pipeline.pdal.stages import pdal_words

        if isinstance(step, Cloud):
            if id(step) not in words:
                words[id(step)] = _spooled(step, f"mtpcr_given{len(words)}", context)
            return [str(words[id(step)]["tag"])]
        stage = step.stage
        inputs = [tag for given in step.inputs for tag in self._add(given, words, context)]
        if stage.is_writer and stage.written:
            return inputs
        if id(stage) not in words:
            words[id(stage)] = pdal_words(stage.spec, inputs, **_passing_names(stage, context))
        return [stage.tag]

    def _stream_first(self, pipeline: Any) -> Any:
        kept: list[Records] | None = []
        size = 0
        with _blamed(self._steps):
            iterator = pipeline.iterator(chunk_size=CHUNK_POINTS, prefetch=1)
            for records in library.arrays_of(iterator):
                self._note(records)
                size += records.nbytes
                if kept is not None and size <= _KEEP_BYTES:
                    kept.append(records)
                else:
                    kept = None
            metadata = iterator.metadata
        self._held = kept
        return metadata

    def _execute(self, words: Sequence[Mapping[str, Any]], need_crs: bool) -> Any:
        from pyproj import CRS

        # PDAL tells the CRS of what went into the last stage; and our stages take one cloud
        last = [{"type": "filters.merge", "tag": "mtpcr_merged"}] if need_crs else []
        pipeline = library.pipeline([*words, *last])
        with _blamed(self._steps):
            pipeline.execute()
            self._held = list(pipeline.arrays)
            wkt = pipeline.srswkt2 if need_crs else ""
            metadata = pipeline.metadata
        for records in self._held:
            self._note(records)
        self.crs = CRS.from_wkt(wkt) if wkt else None
        return metadata

    def _note(self, records: Records) -> None:
        self.count += len(records)
        if len(records):
            for axis, name in enumerate("XYZ"):
                self.minimum[axis] = min(self.minimum[axis], records[name].min())
                self.maximum[axis] = max(self.maximum[axis], records[name].max())

    def _stream(self, words: Sequence[Mapping[str, Any]], size: int) -> Iterator[Records]:
        with _blamed(self._steps):
            iterator = library.pipeline(words).iterator(chunk_size=size, prefetch=1)
            yield from library.arrays_of(iterator)

    def _probed_crs(self) -> CRS | None:
        """Ask for the CRS by a run over one point of each reader."""
        from pyproj import CRS

        words = [{**stage, "count": 1} if "inputs" not in stage else stage for stage in self._again]
        pipeline = library.pipeline([*words, {"type": "filters.merge", "tag": "mtpcr_merged"}])
        with _blamed(self._steps):
            pipeline.execute()
            wkt = pipeline.srswkt2
        return CRS.from_wkt(wkt) if wkt else None


@contextmanager
def _blamed(stages: Sequence[PdalStage]) -> Iterator[None]:
    """Turn PDAL's exceptions into errors that name the stage."""
    try:
        yield
    except (RuntimeError, ValueError, TypeError) as error:
        message = library.first_line(error)
        named = [stage for stage in stages if message.startswith(f"{stage.spec.type}:")]
        if len(named) == 1 or len(stages) == 1:
            raise (named or list(stages))[0].failed(message) from error
        labels = ", ".join(stage.tag for stage in named or stages)
        raise InputError(f"one of the stages {labels}: PDAL says: {message}") from error


def _stages_of(step: Step) -> Iterator[PdalStage]:
    """Return every stage of a chain once, inputs first."""
    seen: dict[int, PdalStage] = {}

    def visit(at: Step) -> None:
        for given in at.inputs:
            if isinstance(given, Step):
                visit(given)
        seen.setdefault(id(at.stage), at.stage)

    visit(step)
    yield from seen.values()


def _passing_names(stage: PdalStage, context: RunContext) -> dict[str, Any]:
    """Replace what a writer writes by a passing name, under which nothing looks finished."""
    if not stage.is_writer:
        return {}
    template = numbered(stage)
    if template is not None:
        return {"filename": str(context.outputs.template(template))}
    paths = stage.writes()
    return {"filename": str(context.outputs.path(paths[0]))} if paths else {}


def numbered(stage: PdalStage) -> Path | None:
    """Return the filename of a writer that writes one file a view, a # standing for the number."""
    name = file_of(stage.spec.options)
    return Path(name) if stage.is_writer and name and "#" in name else None


def _spooled(cloud: Cloud, tag: str, context: RunContext) -> dict[str, Any]:
    """Hand a cloud of ours to PDAL: its own file, or a passing one."""
    path = cloud.path if isinstance(cloud, LasCloud) else context.spooled.get(id(cloud))
    if path is None:
        path = context.scratch() / f"{len(context.spooled)}.las"
        base, move = (cloud.base, cloud.move) if isinstance(cloud, Moved) else (cloud, None)
        with context.progress.task("handing points to PDAL", cloud.count) as advance:
            write_cloud(path, base, move, cloud.crs, advance=advance)
        context.spooled[id(cloud)] = path
    words: dict[str, Any] = {"type": "readers.las", "tag": tag, "filename": str(path)}
    if cloud.crs is not None:
        words["override_srs"] = cloud.crs.to_wkt("WKT1_GDAL")
    return words


def _share_metadata(stages: Sequence[PdalStage], metadata: Any) -> None:
    """Return each stage its part of PDAL's metadata, which is by type, a list where a type comes twice."""
    found = json.loads(metadata) if isinstance(metadata, str) else metadata
    by_type = found.get("metadata", {}) if isinstance(found, dict) else {}
    for kind in {stage.spec.type for stage in stages}:
        alike = [stage for stage in stages if stage.spec.type == kind]
        part = by_type.get(kind, {})
        parts = part if isinstance(part, list) else [part]
        for stage, one in zip(alike, parts if len(parts) == len(alike) else [part] * len(alike), strict=True):
            stage.metadata.update(one if isinstance(one, dict) else {"of_all_stages_of_this_type": one})
