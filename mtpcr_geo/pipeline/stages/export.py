"""Stages that bring the result out: the moved cloud, and writers for evidence and transforms."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from mtpcr_geo.core.errors import OptionError, RegistrationError
from mtpcr_geo.core.recorder import LEAST_RECORDING_MB, RECORDING_MB, NullRecorder
from mtpcr_geo.core.system import command_line, peak_memory_mb, usable_cores
from mtpcr_geo.core.types import Pair, Side, Verdict
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export.recording.budget import Budget
from mtpcr_geo.pipeline.options import Force
from mtpcr_geo.pipeline.records import Written
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

TransformFormat = Literal["json", "cloudcompare", "pdal"]
DERIVED_ROLES = ("registered", "difference", "target_upright")
"""Rasters that are made once the pair is solved, by what replaces the # in their names."""


class ApplyOptions(StageOptions):
    """Options of mtpcr.apply."""

    force: Force = False


class Apply(Stage):
    """Move the source to the target; nothing comes out when the verdict withholds that."""

    type = "mtpcr.apply"
    Options = ApplyOptions
    options: ApplyOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Return the source's points in the target's CRS and units, streamed on demand."""
        from mtpcr_geo.io.views import moved_source

        pair = self.one_pair(inputs)
        if pair.T_target_source is None:
            raise OptionError(f"{self.label} needs a solved pair; put mtpcr.solve before it")
        withheld = pair.verdict.withholds_cloud if pair.verdict is not None else None
        if withheld is not None and not self.options.force:
            self.skipped = withheld
            return None
        self.forced = withheld is not None
        return moved_source(pair)


class FileOptions(StageOptions):
    """Options of a writer of one file."""

    filename: Path = Field(description="file to write")


class EvidenceWriter(Stage):
    """Writes what there is of a pair, and hands it on; has nothing to do where there is no pair."""

    evidence = True
    Options: ClassVar[OptionsModel] = FileOptions
    options: FileOptions

    def writes(self) -> list[Path]:
        """Name the file."""
        return [self.options.filename]

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Write the file if the pair holds what it needs."""
        if not inputs and context.failure is not None:
            self._skip("no pair was made")
            return None
        pair = self.one_pair(inputs)
        missing = self.missing(pair, context)
        if missing:
            self._skip(missing)
        else:
            self.write(pair, context)
        return pair

    def _skip(self, why: str) -> None:
        self.skipped = why
        self.not_written |= dict.fromkeys(self.writes(), why)

    def missing(self, pair: Pair, context: RunContext) -> str | None:
        """Say what keeps this writer from writing, if anything does."""
        return None

    def write(self, pair: Pair, context: RunContext) -> None:
        """Write the file under its temporary name."""
        raise NotImplementedError


class BevFileOptions(FileOptions):
    """Options of mtpcr.write_bev."""

    filename: Path = Field(
        description="file to write; a # in it stands for 'source', 'target' and, once the pair is solved, "
        "'registered' (the source's raster laid over the target's), 'difference' (of both) and, where the "
        "target was levelled, 'target_upright'; beside each raster a .qml, by which QGIS draws it"
    )
    force: Force = False


class WriteBev(EvidenceWriter):
    """Write the height rasters as GeoTIFF, with styles for QGIS."""

    type: ClassVar[str] = "mtpcr.write_bev"
    needs: ClassVar[tuple[str, ...]] = ("rasterio", "mtpcr_geo.export.geotiff")

    Options: ClassVar[OptionsModel] = BevFileOptions
    options: BevFileOptions

    def writes(self) -> list[Path]:
        """Name the rasters, or the one, their styles, and the points for the Georeferencer."""
        if not self._for_roles:
            return [self.options.filename, self.options.filename.with_suffix(".qml")]
        rasters = [self._file(role) for role in ("source", "target", *DERIVED_ROLES)]
        return [*rasters, *(path.with_suffix(".qml") for path in rasters), self._points]

    def missing(self, pair: Pair, context: RunContext) -> str | None:
        """Need a raster."""
        return None if any(side.bev is not None for side in self._sides(pair)) else "no raster was made"

    def write(self, pair: Pair, context: RunContext) -> None:
        """Write a GeoTIFF for each side that has a raster."""
        from mtpcr_geo.export.geotiff import write_side_bev
        from mtpcr_geo.export.raster_styles import height_limits, relief_style

        sides = [side for side in self._sides(pair) if side.bev is not None]
        if len(sides) > 1 and not self._for_roles:
            raise OptionError(
                f"{self.label}: two rasters are two files; write a # in the filename for the roles"
            )
        for side in sides:
            assert side.bev is not None
            file = self._file(side.role)
            write_side_bev(context.outputs.path(file), side, pair.frame)
            low, high = height_limits([side.bev.top])
            self._style(context, file, relief_style(low + side.link.origin[2], high + side.link.origin[2]))
        if not self._for_roles:
            return
        files = [self._file(role) for role in DERIVED_ROLES[:2]]
        files = [*files, *(file.with_suffix(".qml") for file in files), self._points]
        withheld = pair.verdict.withholds_transform if pair.verdict is not None else None
        if len(sides) < 2 or pair.T_target_source is None:
            self.not_written |= dict.fromkeys(files, "no transform was found")
        elif withheld is not None and not self.options.force:
            self.not_written |= dict.fromkeys(files, withheld)
        else:
            self.forced = withheld is not None
            self._write_solved(pair, context)

    def _write_solved(self, pair: Pair, context: RunContext) -> None:
        """Write what there is once a transform is found: heights of both with the same colours."""
        from mtpcr_geo.export.difference import height_difference, upright_target, write_difference
        from mtpcr_geo.export.georeferencer import write_points
        from mtpcr_geo.export.geotiff import write_bev, write_registered_bev
        from mtpcr_geo.export.raster_styles import (
            difference_limit,
            difference_style,
            height_limits,
            relief_style,
        )
        from mtpcr_geo.export.resample import registered_bev

        registered, difference_file, upright_file = (self._file(role) for role in DERIVED_ROLES)
        try:
            upright, moved = upright_target(pair), registered_bev(pair)
        except RegistrationError as error:
            # a strip that is turned may span more cells than fit: that is no fault of the transform
            files = (registered, difference_file)
            self.not_written |= dict.fromkeys(
                [*files, *(one.with_suffix(".qml") for one in files)], str(error)
            )
            return
        z = float(pair.frame.origin[2])
        low, high = height_limits([upright.top, moved.top])
        write_registered_bev(context.outputs.path(registered), pair, moved)
        self._style(context, registered, relief_style(low + z, high + z))
        if upright is not pair.target.bev:
            tags = {"ROLE": "target, upright", "CLOUD": Path(pair.target.cloud.name).name}
            write_bev(context.outputs.path(upright_file), upright, pair.frame, tags=tags)
            self._style(context, upright_file, relief_style(low + z, high + z))
        difference = height_difference(pair, moved)
        if difference is None:
            why = "the clouds share no cell"
            styled = difference_file.with_suffix(".qml")
            self.not_written |= {difference_file: why, styled: why}
        else:
            write_difference(context.outputs.path(difference_file), difference, pair)
            self._style(context, difference_file, difference_style(difference_limit(difference.low)))
        if pair.tie_points is None:
            self.not_written[self._points] = "no tie points were found"
        else:
            write_points(context.outputs.path(self._points), pair)

    @staticmethod
    def _style(context: RunContext, file: Path, style: list[Element]) -> None:
        from mtpcr_geo.export.raster_styles import write_qml

        write_qml(context.outputs.path(file.with_suffix(".qml")), style)

    @property
    def _for_roles(self) -> bool:
        return "#" in self.options.filename.name

    @property
    def _points(self) -> Path:
        """The file that QGIS's Georeferencer reads when it opens the source's raster."""
        file = self._file("source")
        return file.with_name(f"{file.name}.points")

    def _file(self, role: str) -> Path:
        return self.options.filename.with_name(self.options.filename.name.replace("#", role))

    @staticmethod
    def _sides(pair: Pair) -> list[Side]:
        return [pair.target] if pair.source is pair.target else [pair.source, pair.target]


class WriteTiePoints(EvidenceWriter):
    """Write tie points, their links, footprints and hypotheses as a GeoPackage."""

    type = "mtpcr.write_tie_points"
    needs: ClassVar[tuple[str, ...]] = ("mtpcr_geo.export.tie_points",)

    def missing(self, pair: Pair, context: RunContext) -> str | None:
        """Need tie points."""
        return None if pair.tie_points is not None else "no tie points were found"

    def write(self, pair: Pair, context: RunContext) -> None:
        """Write the GeoPackage."""
        from mtpcr_geo.export.tie_points import write_tie_points

        write_tie_points(context.outputs.path(self.options.filename), pair)


class TransformFileOptions(FileOptions):
    """Options of mtpcr.write_transform."""

    format: TransformFormat | None = Field(
        None,
        description="json for mtpcr-geo apply, a cloudcompare matrix, or a pdal pipeline; "
        "where not given, .pdal.json means pdal, .txt means cloudcompare, all else json",
    )
    force: Force = False


class WriteTransform(EvidenceWriter):
    """Write the transform; not written when the verdict is refused."""

    type: ClassVar[str] = "mtpcr.write_transform"

    Options: ClassVar[OptionsModel] = TransformFileOptions
    options: TransformFileOptions

    def missing(self, pair: Pair, context: RunContext) -> str | None:
        """Need a transform that was not refused."""
        if pair.T_target_source is None:
            return "no transform was found"
        if pair.verdict is not None and not self.options.force:
            return pair.verdict.withholds_transform
        return None

    def write(self, pair: Pair, context: RunContext) -> None:
        """Write the file in its format."""
        # what a file says of itself holds for the set that it is part of
        self.forced = (
            pair.verdict is not None and pair.verdict.withholds_cloud is not None and self.options.force
        )
        from mtpcr_geo.export.pdal_file import write_pdal_pipeline
        from mtpcr_geo.export.transform import write_cloudcompare_matrix, write_transform_json

        path = context.outputs.path(self.options.filename)
        if self.format == "json":
            write_transform_json(path, pair, forced=self.forced)
        elif self.format == "pdal":
            write_pdal_pipeline(path, pair, self.options.filename.parent)
        else:
            write_cloudcompare_matrix(path, pair)

    @property
    def format(self) -> TransformFormat:
        """The format, by option or by the file's name."""
        name = self.options.filename.name.lower()
        by_name: TransformFormat = (
            "pdal" if name.endswith(".pdal.json") else "cloudcompare" if name.endswith(".txt") else "json"
        )
        return self.options.format or by_name


class RecordingOptions(FileOptions):
    """Options of mtpcr.write_recording."""

    size_mb: float = Field(
        RECORDING_MB,
        ge=LEAST_RECORDING_MB,
        description="size that the file may have, megabytes: points and pictures are thinned to it",
    )


class WriteRecording(EvidenceWriter):
    """Record the whole run for the rerun viewer, whatever this stage's place."""

    type: ClassVar[str] = "mtpcr.write_recording"

    Options: ClassVar[OptionsModel] = RecordingOptions
    options: RecordingOptions

    def writes(self) -> list[Path]:
        """Name the recording."""
        return [self.options.filename]

    def open(self, context: RunContext) -> None:
        """Put a recorder in place before the first stage runs."""
        if not isinstance(context.recorder, NullRecorder):
            raise OptionError(f"{self.label}: a run keeps one recording; remove the second")
        from mtpcr_geo.export.recording.recorder import RerunRecorder

        budget = Budget(self.options.size_mb)
        context.recorder = RerunRecorder(context.outputs.path(self.options.filename), budget)

    def write(self, pair: Pair, context: RunContext) -> None:
        """Report what the recording leaves out; the recorder itself is told of every stage as it ends."""
        points = len(pair.source.sample), len(pair.target.sample)
        self.metadata |= Budget(self.options.size_mb).facts(*points)


class WriteReport(EvidenceWriter):
    """Write the report about the whole run, as HTML that needs no other file."""

    type = "mtpcr.write_report"
    needs: ClassVar[tuple[str, ...]] = ("mtpcr_geo.export.report.page",)
    late = True
    _drawn: tuple[Pair, Future[dict[str, Any]]] | None = None

    def prepare(self, inputs: Sequence[Value], context: RunContext) -> None:
        """Begin to draw the pictures."""
        if usable_cores() > 1 and len(inputs) == 1 and isinstance(inputs[0], Pair):
            worker = ThreadPoolExecutor(1, thread_name_prefix="report")
            context.at_end.callback(worker.shutdown, cancel_futures=True)
            self._drawn = inputs[0], worker.submit(_pictures_of, inputs[0])

    def write(self, pair: Pair, context: RunContext) -> None:
        """Write the HTML."""
        from mtpcr_geo.export.report.page import write_report

        done = [record.audit() for record in context.done]
        path = context.outputs.path(self.options.filename)
        written = Written.of(context.done, context.outputs.written())
        facts = {**context.facts.audit(), "written": written.audit(), "command": command_line()}
        begun = self._drawn
        pictures = begun[1].result() if begun is not None and begun[0] is pair else None
        write_report(path, pair, done, facts, pictures)


def _pictures_of(pair: Pair) -> dict[str, Any]:
    from mtpcr_geo.export.report.page import pictures_of

    return pictures_of(pair)


class WriteRun(EvidenceWriter):
    """Write what happened as JSON: verdict, times, options, versions, hashes, outputs."""

    type = "mtpcr.write_run"
    late = True

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Write the file, pair or not."""
        from mtpcr_geo.export.run_json import write_run_json

        pair = next((given for given in inputs if isinstance(given, Pair)), None)
        path = context.outputs.path(self.options.filename)
        write_run_json(path, run_facts(pair, context))
        return pair


def run_facts(pair: Pair | None, context: RunContext) -> dict[str, Any]:
    """Gather what is known about a run near its end."""
    verdict = pair.verdict if pair else None
    if verdict is None and context.failure is not None:
        verdict = Verdict("refused", (context.failure,), {})
    from mtpcr_geo.export.transform import frames_of
    from mtpcr_geo.export.uncertainty_facts import check_facts, uncertainty_facts

    facts = context.facts.audit()
    written = Written.of(context.done, context.outputs.written()).audit()
    seconds = {record.tag: round(record.seconds, 4) for record in context.done}
    return {
        "sentence": verdict.headline if verdict else "The run ended before a verdict.",
        "verdict": verdict.name if verdict else None,
        "probability": verdict.metrics.get("probability") if verdict else None,
        "reasons": list(verdict.reasons) if verdict else [],
        "rivals": [asdict(rival) for rival in verdict.rivals] if verdict else [],
        "checks": check_facts(verdict),
        "uncertainty": uncertainty_facts(pair) if pair is not None else None,
        "metrics": verdict.metrics if verdict else {},
        # whether to use it is the verdict's to say
        "T_target_source": TransformChain.of(pair).T_file
        if pair is not None and pair.T_target_source is not None
        else None,
        "frames": frames_of(pair) if pair is not None else None,
        "time_s": {**seconds, "total": round(time.perf_counter() - context.facts.started, 4)},
        "peak_memory_mb": peak_memory_mb(),
        "options": {record.tag: record.options for record in context.done},
        "stages": [record.audit() for record in context.done],
        "pipeline": facts["pipeline"],
        "versions": facts["versions"],
        "inputs": facts["inputs"],
        "outputs": written["files"],
        "not_written": written["withheld"],
        "forced": written["forced"],
    }
