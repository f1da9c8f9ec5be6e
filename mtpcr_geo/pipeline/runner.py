"""Runs stages in order: checks first, times and records each, puts outputs in place at the end."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError, MtpcrError, OptionError, RegistrationError
from mtpcr_geo.core.imports import import_ahead
from mtpcr_geo.core.paths import real, short
from mtpcr_geo.core.progress import NoProgress, Progress
from mtpcr_geo.core.system import Meter, versions
from mtpcr_geo.core.types import Pair, Verdict
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.grammar import StageSpec
from mtpcr_geo.pipeline.plan import plan
from mtpcr_geo.pipeline.records import RunFacts, StageRecord, Written, input_files
from mtpcr_geo.pipeline.stage import Node, RunContext, Stage, Value


@dataclass(frozen=True)
class Settings:
    """How to run a pipeline, as far as its JSON does not say.

    Attributes:
        overwrite: replace files that are already there.
        allow_code, allow_network: let PDAL stages run code, or reach beyond this machine.

    """

    overwrite: bool = False
    allow_code: bool = False
    allow_network: bool = False


@dataclass(frozen=True)
class RunResult:
    """What a run made.

    Attributes:
        values: what each stage made, by tag; None where it was skipped.
        done: the finished stages, in the order they ran.
        outputs: the files now in place.
        failure: why the registration had nothing to go on with, if so.
        facts: what holds for the whole run.
        seconds: wall time of the run.

    """

    values: Mapping[str, Value | None]
    done: Sequence[StageRecord]
    outputs: Sequence[Path]
    failure: str | None = None
    facts: RunFacts = field(default_factory=RunFacts)
    seconds: float = 0.0

    @property
    def pair(self) -> Pair | None:
        """The state of the registration that got furthest, if the pipeline registers."""
        pairs = [value for value in self.values.values() if isinstance(value, Pair)]
        judged = [pair for pair in pairs if pair.verdict is not None]
        return (judged or pairs)[-1] if pairs else None

    @property
    def written(self) -> Written:
        """What the run left, what it withheld and why."""
        return Written.of(self.done, self.outputs)

    @property
    def verdict(self) -> Verdict | None:
        """The judgement, if the pipeline registers; a failed registration is refused."""
        if self.failure is not None:
            return Verdict("refused", (self.failure,), {})
        return self.pair.verdict if self.pair else None


def validate(
    specs: Sequence[StageSpec],
    settings: Settings = Settings(),
    given: Mapping[str, Cloud] | None = None,
) -> None:
    """Find everything wrong that can be known without running: options, files, kinds, CRS.

    Headers are read, points are not.

    Args:
        specs: the linked pipeline.
        settings: how it would be run.
        given: clouds in memory, by the tag of the reader that stands for each.

    Raises:
        MtpcrError: the first thing found.

    """
    nodes = _planned(specs, settings, given)
    with OutputSet(settings.overwrite) as outputs:
        context = RunContext(outputs, NoProgress())
        with closing(context):
            _check(nodes, context)
            _preview(nodes, context)


def execute(
    specs: Sequence[StageSpec],
    settings: Settings = Settings(),
    progress: Progress | None = None,
    given: Mapping[str, Cloud] | None = None,
) -> RunResult:
    """Run a pipeline whole, or leave nothing.

    Args:
        specs: the linked pipeline.
        settings: how to run it.
        progress: where long work reports.
        given: clouds in memory, by the tag of the reader that stands for each.

    Raises:
        MtpcrError: whatever stopped it; a registration that fails is no such stop where the pipeline
            keeps evidence: then the result has the reason.

    """
    nodes = _planned(specs, settings, given)
    result = run(nodes, overwrite=settings.overwrite, progress=progress)
    if result.failure is not None and not any(node.stage.evidence for node in nodes):
        raise RegistrationError(result.failure)
    return result


def run(
    nodes: Sequence[Node],
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
    before: RunResult | None = None,
    replaces: Sequence[Path] = (),
) -> RunResult:
    """Run stages in their order; their files come into place together at the end, or not at all.

    Args:
        nodes: stages, each with the tags that it takes from.
        overwrite: replace files that are already there.
        progress: where long work reports.
        before: a run that these stages carry on; they may take from its stages.
        replaces: further files of an earlier run, removed where these stages do not write them.

    Returns:
        What was made. A registration that fails is refused, and no error.

    Raises:
        MtpcrError: whatever else stopped it.

    """
    stages = [node.stage for node in nodes]
    inputs = _inputs_behind(nodes, lambda stage: stage.late)
    # what a writer of evidence gets was made before the writers in front of it
    made_by = _inputs_behind(nodes, lambda stage: stage.evidence)
    values: dict[str, Value | None] = dict(before.values) if before is not None else {}
    with OutputSet(overwrite) as outputs:
        context = RunContext(outputs, progress or NoProgress())
        context.facts = _facts(nodes, before)
        if before is not None:
            # what that run wrote or withheld is on record there
            context.done = [replace(record, not_written={}, forced=False) for record in before.done]
            context.failure = before.failure
        with closing(context):
            _check(nodes, context)
            if any(stage.evidence for stage in stages):
                context.facts = replace(
                    context.facts,
                    versions=versions(),
                    inputs=tuple(file.hashed() for file in context.facts.inputs),
                )
            outputs.keep(file.path for file in context.facts.inputs)
            import_ahead(name for stage in stages for name in stage.needs)
            for stage in stages:
                stage.open(context)
            context.recorder.begin(context.facts.audit())
            with context.progress.task(f"{len(nodes)} stages", len(nodes)) as advance:
                for number, node in enumerate(sorted(nodes, key=lambda node: node.stage.late), start=1):
                    if node.stage.late:
                        context.stop_recording()
                    with context.progress.task(f"{number} of {len(nodes)}: {node.tag}"):
                        values[node.tag] = _turn(
                            node.stage, [values[tag] for tag in inputs[node.tag]], context
                        )
                    for waiting in nodes:
                        if waiting.stage.evidence and node.tag in made_by[waiting.tag]:
                            _prepare(
                                waiting.stage, [values.get(tag) for tag in made_by[waiting.tag]], context
                            )
                    advance(1)
        # a run that fails and keeps no evidence leaves nothing
        keep = context.failure is None or any(stage.evidence for stage in stages)
        # what an earlier run left under these names never stands beside this one's verdict
        outputs.replace([*(path for stage in stages for path in stage.writes()), *replaces])
        written = outputs.commit() if keep else []
    seconds = time.perf_counter() - context.facts.started
    return RunResult(values, tuple(context.done), written, context.failure, context.facts, seconds)


def _planned(specs: Sequence[StageSpec], settings: Settings, given: Mapping[str, Cloud] | None) -> list[Node]:
    return plan(specs, allow_code=settings.allow_code, allow_network=settings.allow_network, given=given)


def _facts(nodes: Sequence[Node], before: RunResult | None) -> RunFacts:
    written = tuple(node.audit() for node in nodes)
    files = input_files(path for node in nodes for path in node.stage.reads())
    now = time.perf_counter()
    if before is None:
        return RunFacts(pipeline=written, started=now, inputs=files)
    # the time in between does not count
    known = before.facts
    return replace(
        known,
        pipeline=known.pipeline + written,
        started=now - before.seconds,
        inputs=known.inputs + files,
    )


def _inputs_behind(nodes: Sequence[Node], passes_on: Callable[[Stage], bool]) -> dict[str, tuple[str, ...]]:
    """Return each stage's inputs, where a stage that hands on what it took is replaced by its own."""
    passing = {node.tag for node in nodes if passes_on(node.stage)}
    inputs: dict[str, tuple[str, ...]] = {}
    for node in nodes:
        found: tuple[str, ...] = ()
        for tag in node.inputs:
            found += inputs[tag] if tag in passing else (tag,)
        inputs[node.tag] = found
    return inputs


def _prepare(stage: Stage, inputs: Sequence[Value | None], context: RunContext) -> None:
    known = [value for value in inputs if value is not None]
    if len(known) == len(inputs):
        stage.prepare(known, context)


def _check(nodes: Sequence[Node], context: RunContext) -> None:
    writers: dict[Path, Stage] = {}
    stages = [node.stage for node in nodes]
    for stage in stages:
        for path in stage.writes():
            other = writers.setdefault(real(path), stage)
            if other is not stage:
                raise OptionError(
                    f"{stage.label} and {other.label} both write {path}; give each its own file"
                )
    for stage in stages:
        for path in stage.reads():
            if real(path) in writers:
                writer = writers[real(path)]
                raise OptionError(f"{writer.label} would write over {path}, which {stage.label} reads")
    for file in context.facts.inputs:
        if real(file.path) in writers:
            writer = writers[real(file.path)]
            raise OptionError(f"{writer.label} would write over {file.path}, which the run has read")
    for stage in stages:
        for path in stage.reads():
            if not os.path.exists(path):
                raise InputError(f"{stage.label}: there is no file {short(path)}")
        for path in stage.writes():
            context.outputs.check(path)
        stage.check(context)


def _preview(nodes: Sequence[Node], context: RunContext) -> None:
    """Let every stage check the inputs that are known from headers."""
    values: dict[str, Value] = {}
    for node in nodes:
        inputs = [values[tag] for tag in node.inputs if tag in values]
        if len(inputs) == len(node.inputs):
            node.stage.check_inputs(inputs, context)
        if not node.inputs:
            made = node.stage.preview(context)
            if made is not None:
                values[node.tag] = made


def _turn(stage: Stage, inputs: Sequence[Value | None], context: RunContext) -> Value | None:
    """Run one stage, or skip it, and put it on record."""
    start = Meter.read()
    failed = None
    value: Value | None = None
    if not stage.evidence and (context.failure is not None or None in inputs):
        stage.skipped = _why_skipped(context)
        stage.not_written |= dict.fromkeys(stage.writes(), stage.skipped)
        value = next((given for given in inputs if isinstance(given, Pair)), None)
    else:
        try:
            with _memory_errors(stage):
                value = stage.run([given for given in inputs if given is not None], context)
        except RegistrationError as error:
            context.failure = failed = str(error)
            pair = next((given for given in inputs if isinstance(given, Pair)), None)
            value = pair and pair.with_(verdict=Verdict("refused", (failed,), {}))
    options = stage.options.model_dump(mode="json")
    end = Meter.read()
    seconds = end.seconds - start.seconds
    record = StageRecord(
        stage.type,
        stage.tag,
        options,
        seconds,
        stage.metadata,
        stage.skipped,
        failed,
        dict(stage.not_written),
        stage.forced,
        end.since(start),
    )
    context.done.append(record)
    context.recorder.after(stage.type, stage.tag, options, value, seconds)
    return value


def _why_skipped(context: RunContext) -> str:
    """Say why a stage has nothing to go on with: no transform was found, or one before made nothing."""
    if context.failure is not None:
        return "no transform was found"
    reasons = [record.skipped for record in context.done if record.skipped is not None]
    return reasons[-1] if reasons else "the stage before made nothing"


@contextmanager
def _memory_errors(stage: Stage) -> Iterator[None]:
    try:
        yield
    except MemoryError as error:
        raise MtpcrError(f"{stage.label}: not enough memory; use a larger cell or thinner clouds") from error
