"""The whole registration: two files in, a registered cloud and its evidence out.

`build_pipeline` names the steps; the same engine runs them that runs any pipeline JSON.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mtpcr_geo.errors import OptionError
from mtpcr_geo.options import OUTPUT_NAMES, RegisterOptions
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.registry import first_problem
from mtpcr_geo.pipeline.runner import RunResult, Settings, execute
from mtpcr_geo.pipeline.stage import Progress
from mtpcr_geo.scene import Floats, Pair, Verdict

MANY_TRIES = 20_000
"""Pairs of ties tried for the robust start with keypoint matchers, of whose matches few may be right."""


@dataclass(frozen=True)
class Registration:
    """What a registration came to.

    Attributes:
        verdict: accepted, doubtful or refused, with reasons and metrics.
        T_target_source: 4x4 on the coordinates as they stand in the files, source to target; None where
            no transform was found. It stands here even when refused: look at the verdict.
        pair: the whole state, from levelled clouds to ties; None where not even a pair was made.
        outputs: the files written, by what they are.
        report: what each stage noted, with its time.

    """

    verdict: Verdict
    T_target_source: Floats | None
    pair: Pair | None
    outputs: dict[str, Path]
    report: Sequence[Any]


def register(
    source: str | Path,
    target: str | Path,
    out: str | Path,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Registration:
    """Bring the source cloud to the target cloud, and leave the result and its evidence in a folder.

    Args:
        source: LAS, LAZ or COPC file that moves.
        target: LAS, LAZ or COPC file that stays.
        out: folder for the outputs; made if it is not there.
        progress: where long work reports.
        options: fields of `RegisterOptions`.

    Raises:
        MtpcrError: for whatever a user can cause, before anything is written.

    """
    chosen = read_options(options)
    specs = grammar.link(grammar.parse(grammar.dump(build_pipeline(source, target, out, chosen))))
    result = execute(specs, Settings(overwrite=chosen.overwrite), progress)
    return registration_of(result)


def build_pipeline(
    source: str | Path, target: str | Path, out: str | Path, options: RegisterOptions
) -> list[dict[str, Any]]:
    """Name the stages of a registration, as pipeline JSON."""
    folder = Path(out)
    where = {name: str(folder / file) for name, file in OUTPUT_NAMES.items()}
    seed = {"seed": options.seed} if options.seed else {}
    stages: list[dict[str, Any]] = [
        _reader(target, "target"),
        _reader(source, "source"),
        {
            "type": "mtpcr.level",
            "tag": "level",
            "inputs": ["target", "source"],
            "method": "ransac" if options.profile == "paper" and options.level == "auto" else options.level,
            "target_crs": options.target_crs,
            "source_crs": options.source_crs,
            "local": options.local,
            "vertical": None if options.vertical == "refuse" else options.vertical,
            "out_crs": options.out_crs,
            **seed,
        },
        *(_paper_method(options, seed) if options.profile == "paper" else _method(options, seed)),
        {"type": "mtpcr.write_bev", "tag": "rasters", "filename": where["bev"]},
        {"type": "mtpcr.write_ties", "tag": "ties", "filename": where["ties"]},
        *(
            {"type": "mtpcr.write_transform", "tag": tag, "filename": where[tag], "force": options.force}
            for tag in ("transform", "matrix", "pdal")
        ),
        {"type": "mtpcr.write_report", "tag": "report", "filename": where["report"]},
        {"type": "mtpcr.write_run", "tag": "run", "filename": where["run"]},
        {"type": "mtpcr.apply", "tag": "moved", "force": options.force},
        {"type": "writers.las", "tag": "registered", "filename": where["registered"]},
    ]
    if options.recording:
        before = next(i for i, stage in enumerate(stages) if stage["type"] == "mtpcr.write_report")
        stages.insert(
            before, {"type": "mtpcr.write_recording", "tag": "recording", "filename": where["recording"]}
        )
    return [_without_defaults(stage) for stage in stages]


def _method(options: RegisterOptions, seed: dict[str, int]) -> list[dict[str, Any]]:
    """Name the steps from raster to verdict."""
    for name in ("res", "focus", "enhance"):
        if not getattr(options, name):
            raise OptionError(f"--no-{name} belongs to --profile paper")
    correlation = options.matcher in (None, "correlation")
    match = {} if correlation else {"method": options.matcher, "models": _models(options)}
    # learned keypoints like fine detail, where the points are dense enough to show it
    finest = None if correlation or options.matcher in ("rootsift", "orb") else 0.5
    return [
        {"type": "mtpcr.bev", "tag": "bev", "cell": options.cell, "finest": finest},
        {"type": "mtpcr.match", "tag": "match", **match, **_prior(options), **seed},
        {"type": "mtpcr.lift", "tag": "lift", **seed},
        {"type": "mtpcr.solve", "tag": "solve", "tries": None if correlation else MANY_TRIES, **seed},
        {
            "type": "mtpcr.refine",
            "tag": "refine",
            "motion": None if options.motion == "rigid" else options.motion,
        },
        {"type": "mtpcr.assess", "tag": "assess"},
    ]


def _paper_method(options: RegisterOptions, seed: dict[str, int]) -> list[dict[str, Any]]:
    """Name the steps from raster to verdict as MT-PCR has them."""
    if options.prior != "none" or options.motion != "rigid":
        raise OptionError("--prior and --motion are not of the paper; leave them out, or --profile paper")
    # without RES coordinates stay metres, and Eq. 2 makes pixels of one
    res = {"cell": options.cell, "resolution": "eq1"} if options.res else {"cell": options.cell or 1.0}
    matcher = options.matcher or "superpoint"
    steps: list[dict[str, Any]] = [
        {"type": "mtpcr.bev", "tag": "bev", **res, "pixel": "ceil"},
        {"type": "mtpcr.enhance", "tag": "enhance", "look": "paper" if options.enhance else "grey"},
        {"type": "mtpcr.match", "tag": "match", "method": matcher, "models": _models(options), **seed},
    ]
    if options.focus:
        steps.append({"type": "mtpcr.focus", "tag": "focus", **seed})
    return [
        *steps,
        {"type": "mtpcr.lift", "tag": "lift", "surface": "grey", "pixel": "ceil", **seed},
        {"type": "mtpcr.solve", "tag": "solve", "upright": False, "robust_start": False, **seed},
        {"type": "mtpcr.refine", "tag": "refine", "method": "point_to_point", "ground": False},
        {"type": "mtpcr.assess", "tag": "assess"},
    ]


def _models(options: RegisterOptions) -> str | None:
    return None if options.models is None else str(options.models)


def read_options(options: dict[str, Any]) -> RegisterOptions:
    """Check options of a registration.

    Raises:
        OptionError: naming the option; a misspelt one names the nearest valid one.

    """
    try:
        return RegisterOptions.model_validate(options)
    except ValidationError as error:
        raise OptionError(first_problem(error, RegisterOptions)) from None


def registration_of(result: RunResult) -> Registration:
    """Gather what a registering pipeline came to."""
    verdict = result.verdict or Verdict("refused", ("the pipeline judged nothing",), {})
    pair = result.pair
    T = pair.T_file if pair is not None and pair.T_target_source is not None else None
    names = {path.name: name for name, path in OUTPUT_NAMES.items()}
    names |= {f"{role}.tif": f"bev_{role}" for role in ("source", "target", "registered")}
    outputs = {names.get(path.name, path.stem): path for path in result.outputs}
    return Registration(verdict, T, pair, outputs, result.done)


def _prior(options: RegisterOptions) -> dict[str, Any]:
    if options.prior == "none":
        return {}
    return {"prior": options.prior, "prior_sigma": options.prior_sigma, "prior_yaw": options.prior_yaw}


def _reader(path: str | Path, tag: str) -> dict[str, Any]:
    kind = "readers.copc" if str(path).lower().endswith(".copc.laz") else "readers.las"
    return {"type": kind, "tag": tag, "filename": str(path)}


def _without_defaults(stage: dict[str, Any]) -> dict[str, Any]:
    flags = ("force", "local")
    return {
        key: value
        for key, value in stage.items()
        if value is not None and not (key in flags and value is False)
    }
