"""Runs linked stages in order: checks first, times and records each, puts outputs in place at the end."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import InputError, MtpcrError, OptionError, RegistrationError
from mtpcr_geo.core.progress import NoProgress, Progress
from mtpcr_geo.core.system import versions
from mtpcr_geo.core.types import Pair, Verdict
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.grammar import StageSpec
from mtpcr_geo.pipeline.plan import plan
from mtpcr_geo.pipeline.stage import RunContext, Stage, Value


@dataclass(frozen=True)
class Settings:
    """How to run a pipeline, as far as its JSON does not say.

    Attributes:
        overwrite: replace files that are already there.
        seed: of everything random.
        force: write the registered cloud though the verdict refuses it.
        recording: whether recording stages record.
        allow_code, allow_network: let PDAL stages run code, or reach beyond this machine.

    """

    overwrite: bool = False
    seed: int = 0
    force: bool = False
    recording: bool = True
    allow_code: bool = False
    allow_network: bool = False


@dataclass(frozen=True)
class RunResult:
    """What a run made.

    Attributes:
        values: what each stage made, by tag; None where it was skipped.
        done: one entry a stage (type, tag, options, seconds, metadata), in the order they ran.
        outputs: the files now in place.
        failure: why the registration had nothing to go on with, if so.

    """

    values: Mapping[str, Value | None]
    done: Sequence[Mapping[str, Any]]
    outputs: Sequence[Path]
    failure: str | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def pair(self) -> Pair | None:
        """The state of the registration that got furthest, if the pipeline registers."""
        pairs = [value for value in self.values.values() if isinstance(value, Pair)]
        judged = [pair for pair in pairs if pair.verdict is not None]
        return (judged or pairs)[-1] if pairs else None

    @property
    def verdict(self) -> Verdict | None:
        """The judgement, if the pipeline registers; a failed registration is refused."""
        if self.failure is not None:
            return Verdict("refused", (self.failure,), {})
        return self.pair.verdict if self.pair else None


def validate(specs: Sequence[StageSpec], settings: Settings = Settings()) -> None:
    """Find everything wrong that can be known without running: options, files, kinds, CRS.

    Raises:
        MtpcrError: the first thing found.

    """
    stages = plan(specs, settings)
    with OutputSet(settings.overwrite) as outputs:
        context = _context(specs, outputs, NoProgress(), settings)
        _check(stages, context)
        _dry_run(specs, stages, context)


def execute(
    specs: Sequence[StageSpec], settings: Settings = Settings(), progress: Progress | None = None
) -> RunResult:
    """Run a pipeline whole, or leave nothing.

    Raises:
        MtpcrError: whatever stopped it; a registration that fails is no such stop where the pipeline
            keeps evidence: then the result says so.

    """
    stages = plan(specs, settings)
    inputs = _inputs_behind_late(specs, stages)
    with OutputSet(settings.overwrite) as outputs:
        context = _context(specs, outputs, progress or NoProgress(), settings)
        with closing(context):
            _check(stages, context)
            if any(stage.evidence for stage in stages.values()):
                context.facts |= {"versions": versions(), "inputs": _input_facts(stages)}
            for stage in stages.values():
                stage.open(context)
            context.recorder.begin(context.facts)
            values: dict[str, Value | None] = {}
            for spec in sorted(specs, key=lambda spec: stages[spec.tag].late):
                stage = stages[spec.tag]
                if stage.late:
                    context.stop_recording()
                values[spec.tag] = _turn(stage, [values[tag] for tag in inputs[spec.tag]], context)
        if context.failure is not None and not any(stage.evidence for stage in stages.values()):
            raise RegistrationError(context.failure)
        written = outputs.commit()
    return RunResult(values, context.done, written, context.failure, context.facts)


def _inputs_behind_late(
    specs: Sequence[StageSpec], stages: Mapping[str, Stage]
) -> dict[str, tuple[str, ...]]:
    """Let what takes from a late stage take from before it: a late stage hands on what it was given."""
    inputs: dict[str, tuple[str, ...]] = {}
    for spec in specs:
        found: tuple[str, ...] = ()
        for tag in spec.inputs:
            found += inputs[tag] if stages[tag].late else (tag,)
        inputs[spec.tag] = found
    return inputs


def _context(
    specs: Sequence[StageSpec], outputs: OutputSet, progress: Progress, settings: Settings
) -> RunContext:
    context = RunContext(outputs, progress, seed=settings.seed, force=settings.force)
    context.facts = {
        "pipeline": [
            {"type": spec.type, "tag": spec.tag, **({"inputs": list(spec.inputs)} if spec.inputs else {})}
            | dict(spec.options)
            for spec in specs
        ],
        "started": time.perf_counter(),
        "recording": settings.recording,
    }
    return context


def _check(stages: Mapping[str, Stage], context: RunContext) -> None:
    writers: dict[Path, Stage] = {}
    for stage in stages.values():
        for path in stage.writes():
            other = writers.setdefault(path.resolve(), stage)
            if other is not stage:
                raise OptionError(
                    f"{stage.label} and {other.label} both write {path}; give each its own file"
                )
    for stage in stages.values():
        for path in stage.reads():
            if path.resolve() in writers:
                writer = writers[path.resolve()]
                raise OptionError(f"{writer.label} would write over {path}, which {stage.label} reads")
    for stage in stages.values():
        for path in stage.reads():
            if not path.exists():
                raise InputError(f"{stage.label}: there is no file {path}")
        for path in stage.writes():
            context.outputs.check(path)
        stage.check(context)


def _dry_run(specs: Sequence[StageSpec], stages: Mapping[str, Stage], context: RunContext) -> None:
    """Open what readers name, and let every stage look at the inputs that are known by then."""
    values: dict[str, Value] = {}
    for spec in specs:
        stage = stages[spec.tag]
        inputs = [values[tag] for tag in spec.inputs if tag in values]
        if len(inputs) == len(spec.inputs):
            stage.check_inputs(inputs, context)
            if not spec.inputs and not stage.writes():
                made = stage.run([], context)
                if made is not None:
                    values[spec.tag] = made


def _turn(stage: Stage, inputs: Sequence[Value | None], context: RunContext) -> Value | None:
    """Run one stage, or say why it is skipped, and note it."""
    start = time.perf_counter()
    entry: dict[str, Any] = {"type": stage.type, "tag": stage.tag}
    entry["options"] = stage.options.model_dump(mode="json")
    value: Value | None = None
    if not stage.evidence and (context.failure is not None or None in inputs):
        entry["skipped"] = "the registration was refused before"
        value = next((given for given in inputs if isinstance(given, Pair)), None)
    else:
        try:
            value = stage.run([given for given in inputs if given is not None], context)
        except RegistrationError as error:
            context.failure = str(error)
            entry["failed"] = str(error)
            pair = next((given for given in inputs if isinstance(given, Pair)), None)
            value = pair and pair.with_(verdict=Verdict("refused", (str(error),), {}))
        except MemoryError as error:
            raise MtpcrError(
                f"{stage.label}: not enough memory; use a larger cell or thinner clouds"
            ) from error
    seconds = time.perf_counter() - start
    entry |= {"seconds": seconds, "metadata": stage.metadata}
    context.done.append(entry)
    context.recorder.after(stage.type, stage.tag, entry["options"], value, seconds)
    return value


def _input_facts(stages: Mapping[str, Stage]) -> list[dict[str, Any]]:
    from mtpcr_geo.core.system import sha256

    paths = dict.fromkeys(path for stage in stages.values() for path in stage.reads() if path.is_file())
    return [{"path": str(path), "bytes": path.stat().st_size, "sha256": sha256(path)} for path in paths]
