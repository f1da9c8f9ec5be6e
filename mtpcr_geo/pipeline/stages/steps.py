"""Which stages a registration is made of: readers, the method (ours, or MT-PCR's as published), writers."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.recorder import RECORDING_MB
from mtpcr_geo.io.file_cloud import FileCloud
from mtpcr_geo.io.formats import LAS_ENDINGS, files_at
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.many import ManyFiles, is_many, output_names
from mtpcr_geo.io.memory import cloud_of
from mtpcr_geo.io.write import is_copc
from mtpcr_geo.io.write_any import ENDINGS
from mtpcr_geo.match.learned.model_cards import look_of, models_folder
from mtpcr_geo.method.scales import FINEST_OF_LEARNED_M
from mtpcr_geo.pipeline.file_options import AlsoFormat
from mtpcr_geo.pipeline.options import OUTPUT_NAMES, MethodOptions, PriorOptions, RegisterOptions
from mtpcr_geo.pipeline.stage import Stage
from mtpcr_geo.pipeline.stages.export import (
    Apply,
    ApplyOptions,
    BevFileOptions,
    FileOptions,
    RecordingOptions,
    TransformFileOptions,
    WriteBev,
    WriteRecording,
    WriteReport,
    WriteRun,
    WriteTiePoints,
    WriteTransform,
)
from mtpcr_geo.pipeline.stages.io import (
    CopcReader,
    CopcReaderOptions,
    EachWriter,
    EachWriterOptions,
    FileReader,
    FileReaderOptions,
    FileWriter,
    FileWriterOptions,
    LasReader,
    LasReaderOptions,
    LasWriter,
    LasWriterOptions,
)
from mtpcr_geo.pipeline.stages.matching import (
    Enhance,
    EnhanceOptions,
    Focus,
    FocusOptions,
    Match,
    MatchOptions,
)
from mtpcr_geo.pipeline.stages.memory import MemoryReader, SavedRecording
from mtpcr_geo.pipeline.stages.project import ProjectFileOptions, WriteProject
from mtpcr_geo.pipeline.stages.rasters import BevOptions, Level, LevelOptions, MakeBev
from mtpcr_geo.pipeline.stages.solving import (
    Assess,
    AssessOptions,
    InverseMapping,
    InverseMappingOptions,
    Refine,
    RefineOptions,
    Solve,
    SolveOptions,
)

if TYPE_CHECKING:
    from mtpcr_geo.io.memory import CloudLike


def steps_of(options: MethodOptions, prefix: str = "") -> list[Stage]:
    """Make the stages from levelling to verdict, each tagged by its step.

    Args:
        options: of the method.
        prefix: what the tags begin with.

    Raises:
        OptionError: if options do not go together.

    """
    paper = options.profile == "paper"
    level = LevelOptions(
        method="ransac" if paper and options.level == "auto" else options.level,
        target_crs=options.target_crs,
        source_crs=options.source_crs,
        target_unit=options.target_unit,
        source_unit=options.source_unit,
        target_axes=options.target_axes,
        source_axes=options.source_axes,
        local=options.local,
        vertical=options.vertical,
        out_crs=options.out_crs,
        seed=options.seed,
    )
    first = Level(level, f"{prefix}level")
    return [first, *(_paper_method(options, prefix) if paper else _method(options, prefix))]


def _method(options: MethodOptions, prefix: str) -> list[Stage]:
    """Make the steps from raster to verdict."""
    for name, wanted in (("res", options.res), ("focus", options.focus), ("enhance", options.enhance)):
        if not wanted:
            raise OptionError(f"--no-{name} belongs to --profile paper")
    seed = options.seed
    matcher = options.matcher or "correlation"
    learned = matcher not in ("correlation", "rootsift", "orb")
    bev = (
        BevOptions(cell=options.cell, finest=FINEST_OF_LEARNED_M)
        if learned
        else BevOptions(cell=options.cell)
    )
    return [
        MakeBev(bev, f"{prefix}bev"),
        Match(_match_options(options, matcher), f"{prefix}match"),
        InverseMapping(InverseMappingOptions(seed=seed), f"{prefix}inverse_mapping"),
        Solve(SolveOptions(seed=seed), f"{prefix}solve"),
        Refine(RefineOptions(motion=options.motion), f"{prefix}refine"),
        Assess(AssessOptions(), f"{prefix}assess"),
    ]


def _match_options(options: MethodOptions, matcher: str) -> MatchOptions:
    models = None if matcher == "correlation" else options.models
    # what is not given stays so, as in pipelines written by hand
    known = {name: getattr(options, name) for name in PriorOptions.model_fields}
    if not options.proposals:
        if matcher != "correlation":
            raise OptionError("--no-proposals belongs to --matcher correlation")
        known["proposals"] = False
    tried = options.level == "auto"
    return MatchOptions(method=matcher, models=models, verticals=tried, seed=options.seed, **known)


def _paper_method(options: MethodOptions, prefix: str) -> list[Stage]:
    """Make the steps from raster to verdict as MT-PCR has them."""
    if options.knows_pose or options.near is not None or options.yaw is not None or options.motion != "rigid":
        raise OptionError(
            "--prior, --near, --yaw and --motion are not of the paper; leave them out, or --profile paper"
        )
    seed = options.seed
    matcher = options.matcher or "bev"
    match = _match_options(options, matcher)
    # weights trained on height images see nothing in others, and want one cell for both clouds; any other
    # matcher gets the paper's image (Eq. 3 and 4) and cells (Eq. 1)
    trained_on = look_of(matcher, models_folder(options.models))
    look = (trained_on or "paper") if options.enhance else "grey"
    if not options.res:
        # without RES coordinates stay metres, and Eq. 2 makes pixels of one
        bev = BevOptions(cell=options.cell or 1.0, pixel="ceil")
    elif trained_on is not None:
        bev = BevOptions(cell=options.cell, finest=FINEST_OF_LEARNED_M, pixel="ceil")
    else:
        bev = BevOptions(cell=options.cell, resolution="eq1", pixel="ceil")
    # most matches of a small network are wrong, which an SVD over all of them does not survive
    solve = (
        SolveOptions(upright=False, robust_start=False, seed=seed)
        if trained_on is None
        else SolveOptions(seed=seed)
    )
    # tie points of a small network are off by a cell or two, and point-to-point ICP stops short from there
    refine = (
        RefineOptions(
            method="point_to_point",
            ground=False,
            max_correspondence_distance=[3.0, 1.5, 0.75],
            keep_tie_points=0,
        )
        if trained_on is None
        else RefineOptions(feedback=False)
    )
    steps: list[Stage] = [
        MakeBev(bev, f"{prefix}bev"),
        Enhance(EnhanceOptions(look=look), f"{prefix}enhance"),
        Match(match, f"{prefix}match"),
    ]
    if options.focus:
        steps.append(Focus(FocusOptions(seed=seed), f"{prefix}focus"))
    # Eq. 5 puts pixels at corners of their cells, which a turn takes up to 1.4 cells apart
    lift = (
        InverseMappingOptions(surface="grey", pixel="ceil", seed=seed)
        if trained_on is None
        else InverseMappingOptions(surface="top", pixel="centre", seed=seed)
    )
    return [
        *steps,
        InverseMapping(lift, f"{prefix}inverse_mapping"),
        Solve(solve, f"{prefix}solve"),
        Refine(refine, f"{prefix}refine"),
        Assess(AssessOptions(), f"{prefix}assess"),
    ]


def reader_of(cloud: CloudLike, tag: str, text: str | None = None) -> Stage:
    """Make the stage that reads a file, or returns a cloud in memory.

    Args:
        cloud: what to read.
        tag: of the stage.
        text: layout of a file that is text.

    """
    if not isinstance(cloud, str | os.PathLike):
        return MemoryReader(cloud_of(cloud, tag), tag)
    path = Path(cloud)
    if is_many(path) or text is not None:
        return FileReader(FileReaderOptions(filename=path, text=text), tag)
    if path.name.lower().endswith(".copc.laz"):
        return CopcReader(CopcReaderOptions(filename=path), tag)
    if path.suffix.lower() not in LAS_ENDINGS:
        return FileReader(FileReaderOptions(filename=path), tag)
    return LasReader(LasReaderOptions(filename=path), tag)


def readers_of(source: CloudLike, target: CloudLike, options: RegisterOptions) -> list[Stage]:
    """Make the stages that read the target and the source."""
    return [
        reader_of(target, "target", options.target_text),
        reader_of(source, "source", options.source_text),
    ]


def recording_writer(folder: Path, size_mb: float) -> Stage:
    """Make the stage that records the run into a folder, in a file of at most so many megabytes."""
    options = RecordingOptions(filename=folder / OUTPUT_NAMES["recording"], size_mb=size_mb)
    return WriteRecording(options, "recording")


def part_names(source: object) -> list[str]:
    """Return what to call the moved files of a source of many; none for a source of one."""
    if isinstance(source, ManyFiles):
        return output_names([part.path for part in source.parts if isinstance(part, LasCloud | FileCloud)])
    if isinstance(source, str | os.PathLike) and is_many(Path(source)):
        return output_names(files_at(Path(source)))
    return []


def further_files(folder: Path) -> list[Path]:
    """Return the files that an earlier run may have left in a folder, and not every run writes."""
    registered = folder / OUTPUT_NAMES["registered"]
    endings = [f".{one}" for one in get_args(AlsoFormat) if one != "input"]
    return [folder / OUTPUT_NAMES["recording"], *(registered.with_suffix(one) for one in endings)]


def writers_for(
    source: CloudLike | None, folder: Path, options: RegisterOptions, recording: Path | None = None
) -> list[Stage]:
    """Make the stages behind the verdict, as the options of a registration want them.

    Args:
        source: the cloud that moves; None where there is none.
        folder: where the files go.
        options: of the registration.
        recording: a recording of it that is there already.

    """
    return writers_of(
        folder,
        force=options.force,
        recorded=options.recording,
        recording_mb=options.recording_mb,
        recording=recording,
        parts=part_names(source),
        scale=options.scale,
        also=also_of(source, options.also),
    )


def writers_of(
    folder: Path,
    *,
    force: bool,
    recorded: bool = False,
    recording_mb: float = RECORDING_MB,
    recording: Path | None = None,
    parts: Sequence[str] = (),
    scale: float | None = None,
    also: str | None = None,
) -> list[Stage]:
    """Make the stages behind the verdict that leave files.

    Args:
        folder: where the files go.
        force: write cloud, transform and the registered raster though the verdict withholds them.
        recorded: record the run.
        recording_mb: size that the recording may have, megabytes.
        recording: a recording of it that is there already.
        parts: names of the files of a source of many; the moved ones are written under them.
        scale: storage step of the registered cloud; None chooses it.
        also: ending, without the dot, of a further format in which it is written.

    """
    where = {name: folder / file for name, file in OUTPUT_NAMES.items()}
    stages: list[Stage] = [
        WriteBev(BevFileOptions(filename=where["bev"], force=force), "rasters"),
        WriteTiePoints(FileOptions(filename=where["tie_points"]), "tie_points"),
    ]
    for tag in ("transform", "matrix", "pdal"):
        options = TransformFileOptions(filename=where[tag], force=force)
        stages.append(WriteTransform(options, tag))
    if recorded:
        stages.append(recording_writer(folder, recording_mb))
    if recording is not None:
        stages.append(SavedRecording(recording, where["recording"], "recording"))
    return [
        *stages,
        WriteProject(ProjectFileOptions(filename=where["project"]), "project"),
        WriteReport(FileOptions(filename=where["report"]), "report"),
        WriteRun(FileOptions(filename=where["run"]), "run"),
        Apply(ApplyOptions(force=force), "moved"),
        *_cloud_writers(folder, parts, scale, also),
    ]


def _cloud_writers(
    folder: Path, parts: Sequence[str], scale: float | None, also: str | None
) -> Iterator[Stage]:
    """Yield the stages that write the registered cloud: as LAZ, and in the format asked for."""
    if not parts:
        whole = folder / OUTPUT_NAMES["registered"]
        if scale is None:
            yield LasWriter(LasWriterOptions(filename=whole), "registered")
        else:
            # its one number is metres where the CRS has degrees, and those of writers.las are degrees then
            yield FileWriter(FileWriterOptions(filename=whole, scale=scale), "registered")
        if also is not None:
            options = FileWriterOptions(filename=whole.with_suffix(f".{also}"), scale=scale)
            yield FileWriter(options, "registered_also")
        return
    each = folder / "registered" / "#"
    yield EachWriter(EachWriterOptions(filename=each, names=list(parts), scale=scale), "registered")
    if also is not None:
        names = [f"{name.removesuffix('.laz').removesuffix('.copc')}.{also}" for name in parts]
        taken = [name for name in names if name in parts]
        if not taken:
            options_of_each = EachWriterOptions(filename=each, names=names, scale=scale)
            yield EachWriter(options_of_each, "registered_also")


def also_of(source: object, also: str | None) -> str | None:
    """Return the ending of the further format: of ``input`` that of the source.

    Raises:
        OptionError: if that is no format that is written.

    """
    if also != "input":
        return also
    if isinstance(source, str | os.PathLike):
        path = files_at(Path(source))[0]
    elif isinstance(source, ManyFiles):
        path = Path(source.parts[0].name)
    elif isinstance(source, Cloud):
        path = Path(source.name)
    else:
        path = Path("memory")
    ending = ".copc.laz" if is_copc(path) else path.suffix.lower()
    if ending != ".copc.laz" and ending not in ENDINGS:
        raise OptionError(
            f"--also input: {path.name} is of no format that is written; name one of "
            f"{', '.join(one[1:] for one in ENDINGS)}"
        )
    return None if ending == ".laz" else ending[1:]
