"""Every option of a registration, declared once.

Each option is an `Annotated` type below: its kind, limits, description with units, and the group of the
command's help in which it stands. The models of `register`, of the command's verbs and of the stages take
their fields from here, so that an option has one name, one description and one meaning everywhere; a
default is given by each model, and tests hold them equal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from mtpcr_geo.core.suggestions import meant

INPUTS = "Inputs and CRS"
RASTERS = "Levelling and rasters"
MATCHING = "Matching"
PRIOR = "Prior"
RESULT = "Result"
RUN = "Run"
OUTPUT = "Output"
GROUPS = (INPUTS, RASTERS, MATCHING, PRIOR, RESULT, RUN, OUTPUT)
"""Groups of the command's help, in order."""


@dataclass(frozen=True)
class Shown:
    """How the command shows an option.

    Attributes:
        group: heading under which it stands in the help.
        names: what is written on the command line; ``--name-of-the-field`` if empty, and for a switch that
            is on by default ``--no-name-of-the-field``, so that its description follows "do not".
        argument: it is given by its place, without a name.

    """

    group: str
    names: tuple[str, ...] = ()
    argument: bool = False


SourceCrs = Annotated[
    str | None,
    Field(
        description="CRS of the source, instead of what its file states, such as EPSG:2154 or "
        "EPSG:25832+5783; local for a cloud without one, in metres"
    ),
    Shown(INPUTS),
]
TargetCrs = Annotated[
    str | None,
    Field(description="CRS of the target, instead of what its file states; likewise"),
    Shown(INPUTS),
]
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
Models = Annotated[
    Path | None,
    Field(description="folder of model files; the environment variable MTPCR_GEO_MODELS if not given"),
    Shown(MATCHING),
]
Seed = Annotated[int, Field(ge=0, description="seed of everything random"), Shown(MATCHING)]
PriorKind = Annotated[
    Literal["none", "georef"],
    Field(
        description="where to search: none everywhere, at any yaw; georef only near the place that both "
        "clouds' CRSs give"
    ),
    Shown(PRIOR, ("--prior",)),
]
PriorSigma = Annotated[
    float,
    Field(
        gt=0,
        allow_inf_nan=False,
        description="under the prior: standard deviation of the source's place, metres",
    ),
    Shown(PRIOR),
]
PriorYaw = Annotated[
    float,
    Field(
        gt=0,
        le=180,
        allow_inf_nan=False,
        description="under the prior: largest difference of yaw considered, degrees",
    ),
    Shown(PRIOR),
]
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
Overwrite = Annotated[bool, Field(description="replace files that are there already"), Shown(OUTPUT)]


def description_of(kind: Any) -> str:
    """Return the description of an option's `Annotated` type."""
    return next(str(part.description) for part in get_args(kind)[1:] if isinstance(part, FieldInfo))


def shown_of(kind: Any) -> Shown:
    """Return how the command shows an option, from its `Annotated` type."""
    return next(part for part in get_args(kind)[1:] if isinstance(part, Shown))


class MethodOptions(BaseModel):
    """Options of the method, from levelling to verdict."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source_crs: SourceCrs = None
    target_crs: TargetCrs = None
    local: Local = False
    level: LevelMethod = "auto"
    cell: Cell = None
    vertical: Vertical = "refuse"
    out_crs: OutCrs = None
    prior: PriorKind = "none"
    prior_sigma: PriorSigma = 5.0
    prior_yaw: PriorYaw = 5.0
    motion: Motion = "rigid"
    profile: Annotated[
        Literal["default", "paper"],
        Field(description="which steps and settings to run: this package's, or MT-PCR's as published"),
        Shown(MATCHING),
    ] = "default"
    matcher: Annotated[
        str | None,
        Field(
            description=f"{description_of(MatcherName)}; if not given correlation, in the profile paper "
            "superpoint"
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
    seed: Seed = 0


class RegisterOptions(MethodOptions):
    """Options of a registration: of the method, and of what it writes."""

    recording: Annotated[
        bool, Field(description="write a recording of the run for the rerun viewer"), Shown(OUTPUT)
    ] = True
    force: Force = False
    overwrite: Overwrite = False


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
    name = ".".join(str(part) for part in problem["loc"]) or "options"
    names = [field.alias or key for key, field in model.model_fields.items()]
    if problem["type"] == "extra_forbidden":
        return f"no option {spelt(name)}{meant(name, names)}"
    if problem["type"] == "missing":
        return f"the option {spelt(name)} is missing"
    message = problem["msg"].removeprefix("Value error, ")
    message = message[:1].lower() + message[1:]
    return f"option {spelt(name)}: {message}, got {_short(problem['input'])}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


OUTPUT_NAMES = {
    "bev": Path("bev") / "#.tif",
    "tie_points": Path("ties.gpkg"),
    "transform": Path("transform.json"),
    "matrix": Path("transform.cloudcompare.txt"),
    "pdal": Path("transform.pdal.json"),
    "recording": Path("audit.rrd"),
    "registered": Path("registered.laz"),
    "report": Path("report.html"),
    "run": Path("run.json"),
}
