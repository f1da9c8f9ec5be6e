"""Which stages a registration is made of: readers, the method (ours, or MT-PCR's as published), writers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.io.file_cloud import FileCloud
from mtpcr_geo.io.formats import LAS_ENDINGS, files_at
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.many import ManyFiles, is_many, output_names
from mtpcr_geo.io.memory import cloud_of
from mtpcr_geo.pipeline.options import OUTPUT_NAMES, MethodOptions, PriorOptions
from mtpcr_geo.pipeline.stage import Stage
from mtpcr_geo.pipeline.stages.export import (
    Apply,
    ApplyOptions,
    BevFileOptions,
    FileOptions,
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

MANY_TRIES = 20_000
"""Pairs of tie points tried for the robust start with keypoint matchers: few matches may be right."""
FINEST_OF_LEARNED_M = 0.5
"""Finest cell chosen for learned keypoints, which like fine detail where the points are dense enough."""


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
    by_keypoints = matcher != "correlation"
    learned = by_keypoints and matcher not in ("rootsift", "orb")
    bev = (
        BevOptions(cell=options.cell, finest=FINEST_OF_LEARNED_M)
        if learned
        else BevOptions(cell=options.cell)
    )
    solve = SolveOptions(tries=MANY_TRIES, seed=seed) if by_keypoints else SolveOptions(seed=seed)
    return [
        MakeBev(bev, f"{prefix}bev"),
        Match(_match_options(options, matcher), f"{prefix}match"),
        InverseMapping(InverseMappingOptions(seed=seed), f"{prefix}inverse_mapping"),
        Solve(solve, f"{prefix}solve"),
        Refine(RefineOptions(motion=options.motion), f"{prefix}refine"),
        Assess(AssessOptions(), f"{prefix}assess"),
    ]


def _match_options(options: MethodOptions, matcher: str) -> MatchOptions:
    models = None if matcher == "correlation" else options.models
    # what is not given stays so, as in pipelines written by hand
    known = {name: getattr(options, name) for name in PriorOptions.model_fields}
    tried = options.level == "auto"
    return MatchOptions(method=matcher, models=models, verticals=tried, seed=options.seed, **known)


def _paper_method(options: MethodOptions, prefix: str) -> list[Stage]:
    """Make the steps from raster to verdict as MT-PCR has them."""
    if options.knows_pose or options.near is not None or options.yaw is not None or options.motion != "rigid":
        raise OptionError(
            "--prior, --near, --yaw and --motion are not of the paper; leave them out, or --profile paper"
        )
    seed = options.seed
    # without RES coordinates stay metres, and Eq. 2 makes pixels of one
    bev = (
        BevOptions(cell=options.cell, resolution="eq1", pixel="ceil")
        if options.res
        else BevOptions(cell=options.cell or 1.0, pixel="ceil")
    )
    match = MatchOptions(method=options.matcher or "superpoint", models=options.models, seed=seed)
    refine = RefineOptions(
        method="point_to_point",
        ground=False,
        max_correspondence_distance=[3.0, 1.5, 0.75],
        keep_tie_points=0,
    )
    steps: list[Stage] = [
        MakeBev(bev, f"{prefix}bev"),
        Enhance(EnhanceOptions(look="paper" if options.enhance else "grey"), f"{prefix}enhance"),
        Match(match, f"{prefix}match"),
    ]
    if options.focus:
        steps.append(Focus(FocusOptions(seed=seed), f"{prefix}focus"))
    lift = InverseMappingOptions(surface="grey", pixel="ceil", seed=seed)
    return [
        *steps,
        InverseMapping(lift, f"{prefix}inverse_mapping"),
        Solve(SolveOptions(upright=False, robust_start=False, seed=seed), f"{prefix}solve"),
        Refine(refine, f"{prefix}refine"),
        Assess(AssessOptions(), f"{prefix}assess"),
    ]


def reader_of(cloud: CloudLike, tag: str) -> Stage:
    """Make the stage that reads a file, or returns a cloud in memory."""
    if not isinstance(cloud, str | os.PathLike):
        return MemoryReader(cloud_of(cloud, tag), tag)
    path = Path(cloud)
    if is_many(path):
        return FileReader(LasReaderOptions(filename=path), tag)
    if path.name.lower().endswith(".copc.laz"):
        return CopcReader(CopcReaderOptions(filename=path), tag)
    if path.suffix.lower() not in LAS_ENDINGS:
        return FileReader(LasReaderOptions(filename=path), tag)
    return LasReader(LasReaderOptions(filename=path), tag)


def recording_writer(folder: Path) -> Stage:
    """Make the stage that records the run into a folder."""
    return WriteRecording(FileOptions(filename=folder / OUTPUT_NAMES["recording"]), "recording")


def part_names(source: object) -> list[str]:
    """Return what to call the moved files of a source of many; none for a source of one."""
    if isinstance(source, ManyFiles):
        return output_names([part.path for part in source.parts if isinstance(part, LasCloud | FileCloud)])
    if isinstance(source, str | os.PathLike) and is_many(Path(source)):
        return output_names(files_at(Path(source)))
    return []


def writers_of(
    folder: Path,
    *,
    force: bool,
    recorded: bool = False,
    recording: Path | None = None,
    parts: Sequence[str] = (),
) -> list[Stage]:
    """Make the stages behind the verdict that leave files.

    Args:
        folder: where the files go.
        force: write cloud, transform and the registered raster though the verdict withholds them.
        recorded: record the run.
        recording: a recording of it that is there already.
        parts: names of the files of a source of many; the moved ones are written under them.

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
        stages.append(recording_writer(folder))
    if recording is not None:
        stages.append(SavedRecording(recording, where["recording"], "recording"))
    return [
        *stages,
        WriteReport(FileOptions(filename=where["report"]), "report"),
        WriteRun(FileOptions(filename=where["run"]), "run"),
        Apply(ApplyOptions(force=force), "moved"),
        EachWriter(EachWriterOptions(filename=folder / "registered" / "#", names=list(parts)), "registered")
        if parts
        else LasWriter(LasWriterOptions(filename=where["registered"]), "registered"),
    ]
