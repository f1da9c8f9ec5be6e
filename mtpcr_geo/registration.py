"""The whole registration: two files in, a registered cloud and its evidence out.

`build_pipeline` names the steps; the same engine runs them that runs any pipeline JSON.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.core.types import Floats, Pair, Verdict
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.pipeline import grammar
from mtpcr_geo.pipeline.options import OUTPUT_NAMES, RegisterOptions
from mtpcr_geo.pipeline.registry import first_problem
from mtpcr_geo.pipeline.runner import RunResult, Settings, execute
from mtpcr_geo.pipeline.steps import steps_of, without_defaults


@dataclass(frozen=True)
class Registration:
    """What a registration came to.

    Attributes:
        verdict: accepted, doubtful or refused, with reasons and metrics.
        T_target_source: 4x4 on the coordinates as they stand in the files, source to target; None where
            no transform was found. It stands here even when refused: look at the verdict.
        pair: the whole state, from levelled clouds to tie points; None where not even a pair was made.
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
    stages: list[dict[str, Any]] = [
        _reader(target, "target"),
        _reader(source, "source"),
        *steps_of(options, inputs=["target", "source"]),
        {"type": "mtpcr.write_bev", "tag": "rasters", "filename": where["bev"]},
        {"type": "mtpcr.write_tie_points", "tag": "tie_points", "filename": where["tie_points"]},
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
    return [without_defaults(stage) for stage in stages]


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
    T = TransformChain.of(pair).T_file if pair is not None and pair.T_target_source is not None else None
    names = {path.name: name for name, path in OUTPUT_NAMES.items()}
    names |= {f"{role}.tif": f"bev_{role}" for role in ("source", "target", "registered")}
    outputs = {names.get(path.name, path.stem): path for path in result.outputs}
    return Registration(verdict, T, pair, outputs, result.done)


def _reader(path: str | Path, tag: str) -> dict[str, Any]:
    kind = "readers.copc" if str(path).lower().endswith(".copc.laz") else "readers.las"
    return {"type": kind, "tag": tag, "filename": str(path)}
