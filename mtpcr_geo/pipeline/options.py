"""Every option of a registration, declared once.

Each option is an `Annotated` type below: its kind, limits, description with units, and the group of the
command's help in which it stands. The models of `register`, of the command's verbs and of the stages take
their fields from here, so that an option has one name, one description and one meaning everywhere; a
default is given by each model, and tests hold them equal.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from mtpcr_geo.core.recorder import LEAST_RECORDING_MB, RECORDING_MB
from mtpcr_geo.core.suggestions import meant
from mtpcr_geo.core.units import UNITS, Axes, Unit
from mtpcr_geo.pipeline.file_options import Also, Scale, SourceText, TargetText
from mtpcr_geo.pipeline.shown import (
    INPUTS,
    MATCHING,
    OUTPUT,
    PRIOR,
    RASTERS,
    RESULT,
    RUN,
    Shown,
    description_of,
)

SourceCrs = Annotated[
    str | None,
    Field(
        description="CRS of the source, instead of what its file states, such as EPSG:2154 or "
        "EPSG:25832+5783; local for a cloud without one"
    ),
    Shown(INPUTS),
]
TargetCrs = Annotated[
    str | None,
    Field(description="CRS of the target, instead of what its file states; likewise"),
    Shown(INPUTS),
]
SourceUnit = Annotated[
    Unit | None,
    Field(description="unit of a local source, if not metres; a CRS states its own"),
    Shown(INPUTS, metavar=f"[{'|'.join(UNITS)}]"),
]
TargetUnit = Annotated[
    Unit | None,
    Field(description="unit of a local target, likewise"),
    Shown(INPUTS, metavar=f"[{'|'.join(UNITS)}]"),
]
SourceAxes = Annotated[
    Axes,
    Field(description="which axis of a local source points up, or down, in right-handed axes"),
    Shown(INPUTS),
]
TargetAxes = Annotated[Axes, Field(description="the same of a local target"), Shown(INPUTS)]
Local = Annotated[
    bool,
    Field(description="both clouds are local, in metres, whatever their files state"),
    Shown(INPUTS),
]
Vertical = Annotated[
    Literal["refuse", "assume-same", "estimate"],
    Field(
        description="different or unknown vertical datums: refuse them, assume-same takes them as one, "
        "estimate leaves the offset of heights to the registration"
    ),
    Shown(INPUTS),
]
OutCrs = Annotated[
    str | None, Field(description="CRS of the result, where it shall not be the target's"), Shown(INPUTS)
]
LevelMethod = Annotated[
    Literal["auto", "ransac", "none"],
    Field(
        description="how to make the clouds upright: auto trusts the vertical of a georeferenced cloud and "
        "levels a local one by ground and vertical structure; ransac turns the ground plane horizontal; "
        "none keeps them"
    ),
    Shown(RASTERS),
]
Cell = Annotated[
    float | None,
    Field(
        gt=0,
        allow_inf_nan=False,
        description="edge of a cell of the height rasters, metres; from both clouds' densities if not given",
    ),
    Shown(RASTERS),
]
MatcherName = Annotated[
    str,
    Field(
        description="which matcher: correlation, which needs no model files; rootsift; orb; or a learned one "
        "by its name (mtpcr-geo models lists them)"
    ),
]
AskProposals = Annotated[
    bool,
    Field(
        description="let the network of the matcher bev propose further poses where neither heights nor "
        "terrain settle the search of the matcher correlation, judged like all others; and match by itself "
        "where what was found cannot be accepted"
    ),
    Shown(MATCHING),
]

Models = Annotated[
    Path | None,
    Field(description="folder of model files; the environment variable MTPCR_GEO_MODELS if not given"),
    Shown(MATCHING),
]
Seed = Annotated[int, Field(ge=0, description="seed of everything random"), Shown(MATCHING)]


def _plain(value: Any) -> Any:
    """Return arrays as lists and paths as text, so that Python may give either."""
    if isinstance(value, Path):
        return str(value)
    return value.tolist() if hasattr(value, "tolist") else value


def _pose(value: Any) -> Any:
    """Return a pose as given: text, or four rows of four numbers."""
    value = _plain(value)
    if isinstance(value, str):
        return value
    try:
        rows = [[float(one) for one in row] for row in value]
    except (TypeError, ValueError):
        rows = []
    finite = all(isfinite(one) for row in rows for one in row)
    if [len(row) for row in rows] != [4] * 4 or not finite:
        raise ValueError("input should be none, georef, a file, or a matrix of four rows of four numbers")
    return rows


Row = tuple[float, float, float, float]
PriorPose = Annotated[
    str | tuple[Row, Row, Row, Row],
    BeforeValidator(_pose),
    Field(
        description="pose known beforehand, near which is searched: none; georef, where both clouds' CRSs "
        "put the source; or a file with a 4x4 from coordinates of the source's file to the target's: a "
        "transform.json, JSON, or four rows of four numbers"
    ),
    Shown(PRIOR, ("--prior",), metavar="none|georef|FILE"),
]
Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Near = Annotated[
    tuple[Coordinate, Coordinate] | None,
    BeforeValidator(_plain),
    Field(
        description="place in the target's CRS near which the middle of the source lies (the mean of its "
        "points in plan): easting and northing, or longitude and latitude, in the CRS's units"
    ),
    Shown(PRIOR, metavar="X Y"),
]
NearCrs = Annotated[
    str | None,
    Field(
        description="CRS of --near, if not the target's; EPSG:4326 takes longitude and latitude in degrees, "
        "in this order"
    ),
    Shown(PRIOR),
]
Within = Annotated[
    float | None,
    Field(
        gt=0,
        allow_inf_nan=False,
        description="how far the middle of the source may lie from --near or from where --prior puts it, "
        "metres; if not given as far as the source reaches from its middle, under --prior 15",
    ),
    Shown(PRIOR),
]
Yaw = Annotated[
    float | None,
    Field(
        ge=-360,
        le=360,
        allow_inf_nan=False,
        description="angle by which the source must be turned to fit the target, degrees, counter-clockwise "
        "seen from above: the direction of its x axis in the target, counted from the target's x axis",
    ),
    Shown(PRIOR),
]
YawTolerance = Annotated[
    float | None,
    Field(
        gt=0,
        le=180,
        allow_inf_nan=False,
        description="largest difference from --yaw or from the yaw of --prior, degrees; if not given 15, "
        "under --prior 5",
    ),
    Shown(PRIOR),
]
PriorSigma = Annotated[
    float | None,
    Field(
        gt=0,
        allow_inf_nan=False,
        description="under --prior: standard deviation of the source's place, metres; --within is three "
        "times that",
    ),
    Shown(PRIOR),
]
PriorYaw = Annotated[
    float | None,
    Field(
        gt=0,
        le=180,
        allow_inf_nan=False,
        description="under --prior: the same as --yaw-tolerance, degrees",
    ),
    Shown(PRIOR),
]
PRIOR_WITHIN_M, PRIOR_YAW_TOLERANCE_DEG, YAW_TOLERANCE_DEG = 15.0, 5.0, 15.0


class PriorOptions(BaseModel):
    """What is known beforehand of where the source lies, and how well."""

    prior: PriorPose = "none"
    near: Near = None
    near_crs: NearCrs = None
    within: Within = None
    yaw: Yaw = None
    yaw_tolerance: YawTolerance = None
    prior_sigma: PriorSigma = None
    prior_yaw: PriorYaw = None

    @model_validator(mode="after")
    def _go_together(self) -> PriorOptions:
        problem = _prior_problem(self)
        if problem:
            raise ValueError(problem)
        return self

    @property
    def knows_pose(self) -> bool:
        """Return whether a whole pose is given, from the georeference or as a 4x4."""
        return self.prior != "none"

    @property
    def prior_file(self) -> Path | None:
        """Return the file of the 4x4, or None."""
        named = isinstance(self.prior, str) and self.prior not in PRIOR_WORDS
        return Path(str(self.prior)) if named else None

    @property
    def within_m(self) -> float | None:
        """Return how far the source may lie from the place known, metres; None where nothing says."""
        if self.within is not None:
            return self.within
        if not self.knows_pose:
            return None
        return PRIOR_WITHIN_M if self.prior_sigma is None else 3.0 * self.prior_sigma

    @property
    def yaw_within_deg(self) -> float:
        """Return how far it may be turned from the yaw known, degrees."""
        given = self.prior_yaw if self.yaw_tolerance is None else self.yaw_tolerance
        if given is not None:
            return given
        return PRIOR_YAW_TOLERANCE_DEG if self.knows_pose else YAW_TOLERANCE_DEG


PRIOR_WORDS = ("none", "georef")


def _prior_problem(options: PriorOptions) -> str:
    """Return what in options of a prior does not go together, and what to do; "" where all does."""
    word = options.prior
    if isinstance(word, str) and word not in PRIOR_WORDS and re.fullmatch(r"[\w-]*", word):
        return (
            f"--prior is none, georef or a file, not {word!r}{meant(word, PRIOR_WORDS)}; a file of that name "
            f"is ./{word}"
        )
    named = "georef" if word == "georef" else "file" if options.prior_file else "matrix"
    posed = options.knows_pose
    rules = (
        (posed and options.near is not None, f"--near and --prior {named} both say where the source lies; "
         "leave one of them out"),
        (posed and options.yaw is not None, f"--yaw and --prior {named} both say how the source is turned; "
         "leave --yaw out, and say by --yaw-tolerance how well the prior knows it"),
        (options.near_crs is not None and options.near is None, "--near-crs is of use with --near only; give "
         "--near X Y in that CRS"),
        (options.within is not None and options.near is None and not posed, "--within has nothing to be "
         "counted from; give --near X Y or --prior"),
        (options.yaw_tolerance is not None and options.yaw is None and not posed, "--yaw-tolerance has "
         "nothing to be counted from; give --yaw or --prior"),
        (options.prior_sigma is not None and not posed, "--prior-sigma is of use with --prior only; with "
         "--near give --within"),
        (options.prior_yaw is not None and not posed, "--prior-yaw is of use with --prior only; with --yaw "
         "give --yaw-tolerance"),
        (options.within is not None and options.prior_sigma is not None, "--within and --prior-sigma say the "
         "same; leave one of them out"),
        (options.yaw_tolerance is not None and options.prior_yaw is not None, "--yaw-tolerance and "
         "--prior-yaw say the same; leave one of them out"),
    )  # fmt: skip
    return next((text for wrong, text in rules if wrong), "")


Motion = Annotated[
    Literal["rigid", "yaw", "translation"],
    Field(description="degrees of freedom of the result: all six, yaw and shift, or the shift alone"),
    Shown(RESULT),
]
Force = Annotated[
    bool,
    Field(description="write the registered cloud and its transform though the verdict withholds them"),
    Shown(RESULT),
]
Threads = Annotated[
    int, Field(ge=0, description="processor cores to use; 0 takes all"), Shown(RUN, metavar="N")
]
Overwrite = Annotated[bool, Field(description="replace files that are there already"), Shown(OUTPUT)]


class MethodOptions(PriorOptions):
    """Options of the method, from levelling to verdict."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source_crs: SourceCrs = None
    target_crs: TargetCrs = None
    source_unit: SourceUnit = None
    target_unit: TargetUnit = None
    source_axes: SourceAxes = "z-up"
    target_axes: TargetAxes = "z-up"
    local: Local = False
    level: LevelMethod = "auto"
    cell: Cell = None
    vertical: Vertical = "refuse"
    out_crs: OutCrs = None
    motion: Motion = "rigid"
    profile: Annotated[
        Literal["default", "paper"],
        Field(description="which steps and settings to run: this package's, or MT-PCR's as published"),
        Shown(MATCHING),
    ] = "default"
    matcher: Annotated[
        str | None,
        Field(
            description=f"{description_of(MatcherName)}; if not given correlation, in the profile paper bev"
        ),
        Shown(MATCHING),
    ] = None
    models: Models = None
    res: Annotated[
        bool,
        Field(description="give each cloud a resolution of its own (Eq. 1; profile paper)"),
        Shown(MATCHING),
    ] = True
    focus: Annotated[
        bool,
        Field(description="match again at finer cells where the overlap is small (FOCUS; profile paper)"),
        Shown(MATCHING),
    ] = True
    enhance: Annotated[
        bool, Field(description="sharpen the images (Eq. 4; profile paper)"), Shown(MATCHING)
    ] = True
    proposals: AskProposals = True
    seed: Seed = 0


RecordingMb = Annotated[
    float,
    Field(
        ge=LEAST_RECORDING_MB,
        description="size that the recording may have, megabytes: points and pictures are thinned to it",
    ),
    Shown(OUTPUT, metavar="MB"),
]


class RegisterOptions(MethodOptions):
    """Options of a registration: of the method, and of what it writes."""

    source_text: SourceText = None
    target_text: TargetText = None
    scale: Scale = None
    also: Also = None
    recording: Annotated[
        bool, Field(description="write a recording of the run for the rerun viewer"), Shown(OUTPUT)
    ] = True
    recording_mb: RecordingMb = RECORDING_MB
    force: Force = False
    overwrite: Overwrite = False
    threads: Threads = 0


def first_problem(error: ValidationError, model: type[BaseModel], spelt: Callable[[str], str] = repr) -> str:
    """Put what is wrong with options in one line: the first thing, with the nearest valid name.

    Args:
        error: what pydantic found.
        model: whose fields are valid.
        spelt: how the user writes the option of that name, such as ``--cell``; quoted if not given.

    """
    # a misspelt key often causes a missing one too, and says more
    problems = sorted(
        error.errors(include_url=False), key=lambda problem: problem["type"] != "extra_forbidden"
    )
    problem = problems[0]
    # a part of an option, such as a number of two, is named by the whole
    name = str(problem["loc"][0]) if problem["loc"] else "options"
    names = [field.alias or key for key, field in model.model_fields.items()]
    if problem["type"] == "extra_forbidden":
        return f"no option {spelt(name)}{meant(name, names)}"
    if problem["type"] == "missing" and len(problem["loc"]) == 1:
        return f"the option {spelt(name)} is missing"
    message = problem["msg"].removeprefix("Value error, ")
    if not problem["loc"]:  # several options that do not go together
        return message
    message = message[:1].lower() + message[1:]
    return f"option {spelt(name)}: {message}, got {_short(problem['input'])}"


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


OUTPUT_NAMES = {
    "bev": Path("bev") / "#.tif",
    "tie_points": Path("ties.gpkg"),
    "project": Path("project.qgz"),
    "transform": Path("transform.json"),
    "matrix": Path("transform.cloudcompare.txt"),
    "pdal": Path("transform.pdal.json"),
    "recording": Path("audit.rrd"),
    "registered": Path("registered.laz"),
    "report": Path("report.html"),
    "run": Path("run.json"),
}
