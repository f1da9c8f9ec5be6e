"""The options of each verb: those of the registration, and what only the command takes.

A field is a parameter of the verb (`mtpcr_geo.cli.parameters`): its type, default, limits and description
are declared in `mtpcr_geo.pipeline.options`, or here where nothing but the command has it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from mtpcr_geo.pipeline.file_options import CloudText, Scale, SourceText, TargetText
from mtpcr_geo.pipeline.options import (
    Local,
    Models,
    Near,
    NearCrs,
    Overwrite,
    RegisterOptions,
    SourceAxes,
    SourceCrs,
    SourceUnit,
    TargetAxes,
    TargetCrs,
    TargetUnit,
    Threads,
    Vertical,
    Within,
)
from mtpcr_geo.pipeline.shown import INPUTS, OUTPUT, PRIOR, RUN, Shown

FORMATS = (
    "LAS, LAZ, COPC, PLY, PCD, XYZ, CSV, TXT, PTS, PTX, E57 or NPY; several files as a folder, a pattern in "
    "quotes, a .vpc or @LIST"
)

AsJson = Annotated[
    bool, Field(description="print the result as JSON on standard output"), Shown(OUTPUT, ("--json",))
]
Verbose = Annotated[
    bool,
    Field(description="all numbers of the verdict; on standard error, what each stage took"),
    Shown(OUTPUT, ("--verbose", "-v")),
]
Quiet = Annotated[bool, Field(description="print nothing but errors"), Shown(OUTPUT, ("--quiet", "-q"))]
QuietVerdict = Annotated[
    bool,
    Field(description="print nothing but errors, and one line where the verdict is not accepted"),
    Shown(OUTPUT, ("--quiet", "-q")),
]
AllowCode = Annotated[bool, Field(description="let stages such as filters.python run code"), Shown(RUN)]
AllowNetwork = Annotated[
    bool, Field(description="let stages read remote or virtual (/vsi) files"), Shown(RUN)
]


class VerbOptions(BaseModel):
    """Base of the options of a verb."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RegisterVerb(RegisterOptions):
    """Options of ``register``."""

    source: Annotated[Path, Field(description=f"cloud that moves: {FORMATS}"), Shown(INPUTS, argument=True)]
    target: Annotated[Path, Field(description=f"cloud that stays: {FORMATS}"), Shown(INPUTS, argument=True)]
    out: Annotated[
        Path,
        Field(description="folder for the result and its evidence; made if it is not there"),
        Shown(OUTPUT, ("--out", "-o")),
    ]
    no_prior: Annotated[
        bool,
        Field(description="search everywhere, whatever --prior, --near and --yaw say (the default)"),
        Shown(PRIOR),
    ] = False
    dump_pipeline: Annotated[
        bool, Field(description="print the run as pipeline JSON, and do not run it"), Shown(OUTPUT)
    ] = False
    as_json: AsJson = False
    verbose: Verbose = False
    quiet: QuietVerdict = False


class PipelineVerb(VerbOptions):
    """Options of ``pipeline``."""

    file: Annotated[
        Path | None,
        Field(description="pipeline JSON; - reads standard input"),
        Shown(INPUTS, argument=True),
    ] = None
    more: tuple[str, ...] = ()
    input: Annotated[
        Path | None,
        Field(description="the pipeline JSON, named as pdal pipeline does"),
        Shown(INPUTS, ("--input", "-i")),
    ] = None
    only_validate: Annotated[
        bool,
        Field(description="check grammar, options, files and CRS; run nothing"),
        Shown(RUN, ("--validate",)),
    ] = False
    allow_code: AllowCode = False
    allow_network: AllowNetwork = False
    metadata: Annotated[
        Path | None, Field(description="JSON file to write what the stages report to"), Shown(OUTPUT)
    ] = None
    progress: Annotated[
        bool,
        Field(description="show progress bars even where standard error is no terminal"),
        Shown(OUTPUT),
    ] = False
    print_schema: Annotated[
        bool,
        Field(description="print the JSON Schema of pipelines, for editors, and run nothing"),
        Shown(OUTPUT, ("--schema",)),
    ] = False
    overwrite: Overwrite = False
    as_json: AsJson = False
    verbose: Verbose = False
    quiet: QuietVerdict = False


class ApplyVerb(VerbOptions):
    """Options of ``apply``."""

    transform: Annotated[
        Path, Field(description="the transform.json of a registration"), Shown(INPUTS, argument=True)
    ]
    cloud: Annotated[
        Path,
        Field(description=f"cloud to move, in the frame of the source: {FORMATS}"),
        Shown(INPUTS, argument=True),
    ]
    out: Annotated[
        Path,
        Field(
            description="file to write, its ending the format: .laz, .las, .copc.laz, .ply, .pcd, .xyz, "
            ".csv, .npy or .e57; for several files a folder"
        ),
        Shown(OUTPUT, argument=True),
    ]
    cloud_crs: Annotated[
        str | None,
        Field(
            description="CRS of the cloud, instead of what its file states, such as EPSG:25832+5783; local "
            "for a cloud without one"
        ),
        Shown(INPUTS),
    ] = None
    text: CloudText = None
    scale: Scale = None
    inverse: Annotated[
        bool, Field(description="move from the target's frame to the source's instead"), Shown(RUN)
    ] = False
    threads: Threads = 0
    overwrite: Overwrite = False
    quiet: Quiet = False


class CheckVerb(VerbOptions):
    """Options of ``check``."""

    source: Annotated[
        Path, Field(description="cloud that would move, or the only one"), Shown(INPUTS, argument=True)
    ]
    target: Annotated[
        Path | None, Field(description="cloud that would stay"), Shown(INPUTS, argument=True)
    ] = None
    source_crs: SourceCrs = None
    target_crs: TargetCrs = None
    source_unit: SourceUnit = None
    target_unit: TargetUnit = None
    source_axes: SourceAxes = "z-up"
    target_axes: TargetAxes = "z-up"
    source_text: SourceText = None
    target_text: TargetText = None
    scale: Scale = None
    local: Local = False
    vertical: Vertical = "refuse"
    near: Near = None
    near_crs: NearCrs = None
    within: Within = None
    as_json: AsJson = False
    quiet: Quiet = False


class ReviewVerb(VerbOptions):
    """Options of ``review``."""

    recording: Annotated[
        Path, Field(description="folder that a run left, or its .rrd file"), Shown(INPUTS, argument=True)
    ]
    viewer: Annotated[
        Literal["auto", "window", "browser", "none"],
        Field(
            description="where to open the recording: auto is a window where standard output is a terminal "
            "and there is a display; browser serves it to this machine until Ctrl-C"
        ),
        Shown(OUTPUT, ("--open",)),
    ] = "auto"
    as_json: AsJson = False
    verbose: Annotated[
        bool,
        Field(description="all options of every stage, and what each check means"),
        Shown(OUTPUT, ("--verbose", "-v")),
    ] = False


class VerifyVerb(VerbOptions):
    """Options of ``verify``."""

    folder: Annotated[
        Path, Field(description="folder that a registration left"), Shown(INPUTS, argument=True)
    ]
    allow_code: AllowCode = False
    allow_network: AllowNetwork = False
    as_json: AsJson = False
    quiet: Annotated[
        bool,
        Field(description="print nothing but errors, and one line where the run is not reproduced"),
        Shown(OUTPUT, ("--quiet", "-q")),
    ] = False


class ModelsVerb(VerbOptions):
    """Options of ``models``."""

    models: Models = None
    as_json: AsJson = False


class DemoVerb(VerbOptions):
    """Options of ``demo``."""

    out: Annotated[
        Path, Field(description="folder for the demonstration's files"), Shown(OUTPUT, ("--out", "-o"))
    ] = Path("mtpcr-demo")
    overwrite: Overwrite = False
    quiet: QuietVerdict = False


class QgisPluginVerb(VerbOptions):
    """Options of ``qgis-plugin``."""

    out: Annotated[Path, Field(description="zip to write"), Shown(OUTPUT, ("--out", "-o"))] = Path(
        "mtpcr_geo_qgis.zip"
    )
    overwrite: Overwrite = False
    quiet: Quiet = False
