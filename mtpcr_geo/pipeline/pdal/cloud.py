"""A chain of PDAL stages as one cloud: streamed where PDAL can, held in memory where it cannot."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud, PointTable
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.dimensions import separate_legacy_flags
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.layout import wkt_of
from mtpcr_geo.io.views import Moved, xyz_of
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.pipeline.pdal import bindings, process
from mtpcr_geo.pipeline.pdal.process import PdalCrashError, PdalError
from mtpcr_geo.pipeline.pdal.step import (
    Step,
    crash,
    failure,
    file_written,
    is_reader,
    is_writer,
    numbered_files,
    stage_json,
)
from mtpcr_geo.pipeline.pdal.switches import Access

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.pipeline.stage import RunContext

Records = NDArray[np.void]

# chunks of a streamed chain are kept up to this size, so that small clouds run through PDAL once
_KEEP_BYTES = 256 * 2**20
_MERGED = {"type": "filters.merge", "tag": "mtpcr_merged"}


class PdalCloud(Cloud):
    """The points that a chain of PDAL stages gives; its attributes hold once it is evaluated."""

    def __init__(self, step: Step) -> None:
        self.step = step
        self.name = f"the output of {step.spec.label}"
        self.crs = None
        self.count = 0
        self.minimum = np.full(3, np.inf)
        self.maximum = np.full(3, -np.inf)
        self._held: list[Records] | None = None
        self._again: list[dict[str, Any]] = []
        self._steps: list[Step] = []

    def evaluate(self, context: RunContext, *, need_crs: bool) -> None:
        """Run the chain in PDAL: streamed once for count and bounds where it can be, else whole.

        Raises:
            MtpcrError: with the name of the stage that PDAL blames.

        """
        self._steps = _steps_before(self.step)
        chain = self._chain(context)
        writers = [step for step in self._steps if is_writer(step.spec) and not step.written]
        with context.progress.task(f"PDAL: {self.step.tag}"):
            metadata = self._run(chain, need_crs)
        for step in writers:
            step.written = True
            template = numbered_files(step.spec)
            if template is not None:
                context.outputs.adopt(template)
        self._again = self._chain(context)
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
        readers = [step for step in self._steps if is_reader(step.spec)]
        return bool(readers) and all(step.spec.type == "readers.las" for step in readers)

    def _chain(self, context: RunContext) -> list[dict[str, Any]]:
        """Return the chain in PDAL's JSON, without the writers that have written already."""
        chain: dict[str, dict[str, Any]] = {}
        self._add(self.step, chain, [], context)
        return list(chain.values()) or [{"type": "readers.faux", "count": 0}]

    def _add(
        self, step: Step | Cloud, chain: dict[str, dict[str, Any]], handed: list[Cloud], context: RunContext
    ) -> list[str]:
        """Add a step and what it takes from; return the tags that stand for it."""
        if isinstance(step, Cloud):
            number = next((i for i, cloud in enumerate(handed) if cloud is step), len(handed))
            tag = f"mtpcr_given{number}"
            if tag not in chain:
                handed.append(step)
                chain[tag] = _spooled(step, tag, context)
            return [tag]
        inputs = [tag for given in step.inputs for tag in self._add(given, chain, handed, context)]
        if is_writer(step.spec) and step.written:
            return inputs
        if step.tag not in chain:
            chain[step.tag] = stage_json(step.spec, inputs, **_temporary_filename(step, context))
        return [step.tag]

    def _run(self, chain: Sequence[Mapping[str, Any]], need_crs: bool) -> Any:
        """Run the chain, keep its points as far as they are to be kept, and return PDAL's metadata."""
        from pyproj import CRS

        # PDAL tells the CRS of what went into the last stage; and our stages take one cloud
        last = [_MERGED] if need_crs else []
        question = {"do": "run", "stages": chain, "whole": [*chain, *last], "size": CHUNK_POINTS}
        kept: list[Records] | None = []
        size, streamed, facts = 0, False, {}
        with _blamed(self._steps):
            for answer in process.ask(self._access, **question, crs=need_crs):
                if isinstance(answer, dict):
                    streamed, facts = answer.get("streamed", streamed), answer.get("done", {})
                    continue
                self._note(answer)
                size += answer.nbytes
                if kept is not None and (size <= _KEEP_BYTES or not streamed):
                    kept.append(answer)
                else:
                    kept = None
        self._held = kept
        self.crs = CRS.from_wkt(facts["crs"]) if facts.get("crs") else None
        return facts["metadata"]

    def _note(self, records: Records) -> None:
        self.count += len(records)
        if len(records):
            for axis, name in enumerate("XYZ"):
                self.minimum[axis] = min(self.minimum[axis], records[name].min())
                self.maximum[axis] = max(self.maximum[axis], records[name].max())

    def _stream(self, chain: Sequence[Mapping[str, Any]], size: int) -> Iterator[Records]:
        with (
            _blamed(self._steps),
            closing(
                process.ask(self._access, do="run", stages=chain, whole=chain, size=size, crs=False)
            ) as answers,
        ):
            for answer in answers:
                if not isinstance(answer, dict):
                    yield answer

    def _probed_crs(self) -> CRS | None:
        """Ask for the CRS by a run over one point of each reader."""
        from pyproj import CRS

        chain = [{**stage, "count": 1} if "inputs" not in stage else stage for stage in self._again]
        with _blamed(self._steps):
            wkt = process.done(self._access, do="execute", stages=[*chain, _MERGED], crs=True)["crs"]
        return CRS.from_wkt(wkt) if wkt else None

    @property
    def _access(self) -> Access:
        return self._steps[-1].access if self._steps else Access()


@contextmanager
def _blamed(steps: Sequence[Step]) -> Iterator[None]:
    """Turn what PDAL says, or that it crashes, into errors that name the stage."""
    try:
        yield
    except PdalError as error:
        message = bindings.first_line(error)
        named = [step for step in steps if message.startswith(f"{step.spec.type}:")]
        if len(named) == 1 or len(steps) == 1:
            raise failure((named or list(steps))[0].spec, message) from error
        labels = ", ".join(step.tag for step in named or steps)
        raise InputError(f"one of the stages {labels}: PDAL says: {message}") from error
    except PdalCrashError as error:
        raise crash([step.spec for step in steps], error) from error


def _steps_before(last: Step) -> list[Step]:
    """Return every step of a chain once, inputs first."""
    seen: dict[str, Step] = {}

    def visit(step: Step) -> None:
        for given in step.inputs:
            if isinstance(given, Step):
                visit(given)
        seen.setdefault(step.tag, step)

    visit(last)
    return list(seen.values())


def _temporary_filename(step: Step, context: RunContext) -> dict[str, Any]:
    """Return the temporary filename of a writer, under which nothing looks finished."""
    template, file = numbered_files(step.spec), file_written(step.spec)
    if template is not None:
        return {"filename": str(context.outputs.template(template))}
    return {"filename": str(context.outputs.path(file))} if file is not None else {}


def _spooled(cloud: Cloud, tag: str, context: RunContext) -> dict[str, Any]:
    """Hand a cloud of ours to PDAL: its own file, or a temporary one."""
    path = cloud.path if isinstance(cloud, LasCloud) else context.spool.path_of(cloud)
    if path is None:
        path = context.scratch() / f"{len(context.spool)}.las"
        base, move = (cloud.base, cloud.move) if isinstance(cloud, Moved) else (cloud, None)
        with context.progress.task("handing points to PDAL", cloud.count) as advance:
            write_cloud(path, base, move, cloud.crs, advance=advance)
        context.spool.add(cloud, path)
    reader: dict[str, Any] = {"type": "readers.las", "tag": tag, "filename": str(path)}
    if cloud.crs is not None:
        reader["override_srs"] = wkt_of(cloud.crs)
    return reader


def _share_metadata(steps: Sequence[Step], metadata: Any) -> None:
    """Give each step its part of PDAL's metadata, which is by type, a list where a type comes twice."""
    found = json.loads(metadata) if isinstance(metadata, str) else metadata
    by_type = found.get("metadata", {}) if isinstance(found, dict) else {}
    for kind in {step.spec.type for step in steps}:
        alike = [step for step in steps if step.spec.type == kind]
        part = by_type.get(kind, {})
        parts = part if isinstance(part, list) else [part]
        for step, one in zip(alike, parts if len(parts) == len(alike) else [part] * len(alike), strict=True):
            step.metadata.update(one if isinstance(one, dict) else {"of_all_stages_of_this_type": one})
