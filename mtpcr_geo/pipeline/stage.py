"""What a stage is: options, inputs, one thing made."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.progress import Progress as Progress
from mtpcr_geo.core.recorder import NullRecorder, Recorder
from mtpcr_geo.core.types import Pair
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.records import RunFacts, StageRecord

Value = Cloud | Pair


class StageOptions(BaseModel):
    """Base of every stage's options: a misspelt key is an error, and nothing changes after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


OptionsModel = type[StageOptions]


@dataclass
class Spool:
    """Temporary files of clouds that were handed to PDAL, so that each is written once.

    The clouds are held as long as the spool: one that is gone could pass its identity on to another.
    """

    _files: list[tuple[Cloud, Path]] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self._files)

    def path_of(self, cloud: Cloud) -> Path | None:
        """Return the file of this very cloud, or None where it has none yet."""
        return next((path for held, path in self._files if held is cloud), None)

    def add(self, cloud: Cloud, path: Path) -> None:
        """Note that a cloud has been written to a file."""
        self._files.append((cloud, path))


@dataclass
class RunContext:
    """What every stage of one run shares.

    Attributes:
        outputs: where files are written until the run is whole.
        progress: where long work reports.
        recorder: the audit; a no-op twin when nobody wants a recording.
        done: the finished stages, in order.
        facts: what holds for the whole run.
        failure: why the registration has nothing to go on with, once a stage said so.
        spool: temporary files of clouds that were handed to PDAL.
        at_end: what else is to be closed when the run ends.

    """

    outputs: OutputSet
    progress: Progress
    recorder: Recorder = field(default_factory=NullRecorder)
    done: list[StageRecord] = field(default_factory=list)
    facts: RunFacts = field(default_factory=RunFacts)
    failure: str | None = None
    spool: Spool = field(default_factory=Spool)
    at_end: ExitStack = field(default_factory=ExitStack)
    _scratch: tempfile.TemporaryDirectory[str] | None = None

    def scratch(self) -> Path:
        """Return a folder for temporary files, gone when the run ends."""
        if self._scratch is None:
            self._scratch = tempfile.TemporaryDirectory(prefix="mtpcr-geo-")
        return Path(self._scratch.name)

    def close(self) -> None:
        """Remove temporary files, and finish the recording."""
        self.at_end.close()
        if self._scratch is not None:
            self._scratch.cleanup()
            self._scratch = None
        self.stop_recording()

    def stop_recording(self) -> None:
        """Finish the recording: nothing later is recorded."""
        recorder, self.recorder = self.recorder, NullRecorder()
        recorder.close()


class Stage(ABC):
    """One step of a pipeline.

    Class attributes:
        type: its name in the JSON, such as "mtpcr.level" or "readers.las".
        Options: the pydantic model of its options.
        evidence: whether it still runs, with what there is, when the registration failed or was refused;
            its inputs may then hold None.
        late: whether it runs after all others, since it reports on the whole run.
        needs: modules that it imports when it runs; they are imported while earlier stages work.

    """

    type: ClassVar[str]
    Options: ClassVar[OptionsModel]
    evidence: ClassVar[bool] = False
    late: ClassVar[bool] = False
    needs: ClassVar[tuple[str, ...]] = ()

    def __init__(self, options: StageOptions, tag: str) -> None:
        self.options = options
        self.tag = tag
        self.metadata: dict[str, Any] = {}
        self.skipped: str | None = None
        self.not_written: dict[Path, str] = {}
        self.forced = False

    def check(self, context: RunContext) -> None:  # noqa: B027 - most stages have nothing to check
        """Find out before the run what would stop this stage: files, folders, optional parts.

        Raises:
            MtpcrError: saying what is wrong and what to do.

        """

    def check_inputs(self, inputs: Sequence[Value], context: RunContext) -> None:  # noqa: B027
        """Find out before the run whether these inputs suit, as far as headers tell: kinds, CRS.

        Raises:
            MtpcrError: saying what is wrong and what to do.

        """

    def open(self, context: RunContext) -> None:  # noqa: B027 - most stages need nothing before their turn
        """Get ready before the first stage runs."""

    def prepare(self, inputs: Sequence[Value], context: RunContext) -> None:  # noqa: B027
        """Begin, in threads of its own, what needs its inputs alone, while the stages before it work.

        It is called once all inputs are known, of evidence writers that are behind others before their turn:
        those hand on what they took. Threads end with ``context.at_end``.
        """

    def reads(self) -> list[Path]:
        """Files this stage reads, as named by its options."""
        return []

    def writes(self) -> list[Path]:
        """Files this stage leaves, as named by its options."""
        return []

    @property
    def label(self) -> str:
        """How messages name it."""
        return f"stage {self.tag} ({self.type})"

    def preview(self, context: RunContext) -> Value | None:
        """Return what a stage without inputs will make, as far as headers tell; no point is read.

        None where only running tells.
        """
        return None

    @abstractmethod
    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Do the work, and return what the next stages take; None where nothing goes on from here.

        Writers return what they took.
        """

    def one_pair(self, inputs: Sequence[Value]) -> Pair:
        """Take the single registration state among the inputs.

        Raises:
            OptionError: if the inputs are something else.

        """
        if len(inputs) == 1 and isinstance(inputs[0], Pair):
            return inputs[0]
        raise OptionError(
            f"stage {self.tag} ({self.type}) needs a pair of clouds from mtpcr.level or a later mtpcr stage, "
            f"and got {_describe(inputs)}; set its inputs"
        )


@dataclass(frozen=True)
class Node:
    """A stage in its place in a pipeline.

    Attributes:
        stage: what runs.
        inputs: tags of the stages that it takes from, all before it.
        written: its options as written, for the audit.

    """

    stage: Stage
    inputs: tuple[str, ...] = ()
    written: Mapping[str, Any] = field(default_factory=dict)

    @property
    def tag(self) -> str:
        """The stage's name in the pipeline."""
        return self.stage.tag

    def audit(self) -> dict[str, Any]:
        """Return the stage as pipeline JSON has it, its inputs by name."""
        inputs = {"inputs": list(self.inputs)} if self.inputs else {}
        return {"type": self.stage.type, "tag": self.tag, **inputs, **self.written}


def chained(stages: Sequence[Stage], first_inputs: tuple[str, ...] = ()) -> list[Node]:
    """Put stages one behind the other: each takes from the one before.

    Args:
        stages: in the order of the run.
        first_inputs: tags that the first one takes from.

    """
    nodes: list[Node] = []
    for stage in stages:
        inputs = (nodes[-1].tag,) if nodes else first_inputs
        # options at their default are left out, as in pipelines written by hand
        nodes.append(Node(stage, inputs, stage.options.model_dump(mode="json", exclude_defaults=True)))
    return nodes


def _describe(inputs: Sequence[Value]) -> str:
    kinds = ["a pair" if isinstance(value, Pair) else "a cloud" for value in inputs]
    return " and ".join(kinds) if kinds else "nothing"
