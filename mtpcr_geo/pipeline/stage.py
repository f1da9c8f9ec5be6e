"""What a stage is: options, inputs, one thing made."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Sequence
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

Value = Cloud | Pair


class StageOptions(BaseModel):
    """Base of every stage's options: a misspelt key is an error, and nothing changes after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


OptionsModel = type[StageOptions]


@dataclass
class RunContext:
    """What every stage of one run shares.

    Attributes:
        outputs: where files are written until the run is whole.
        progress: where long work reports.
        recorder: the audit; a no-op twin when nobody wants a recording.
        seed: of everything random.
        force: write the registered cloud though the verdict refuses it.
        done: one entry a finished stage (type, tag, options, seconds, metadata), in order.
        facts: what holds for the whole run: the pipeline, versions, input files and their hashes.
        failure: why the registration has nothing to go on with, once a stage said so.
        spooled: passing files of clouds that were handed to PDAL, by the cloud's id.

    """

    outputs: OutputSet
    progress: Progress
    recorder: Recorder = field(default_factory=NullRecorder)
    seed: int = 0
    force: bool = False
    done: list[dict[str, Any]] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    failure: str | None = None
    spooled: dict[int, Path] = field(default_factory=dict)
    _scratch: tempfile.TemporaryDirectory[str] | None = None

    def scratch(self) -> Path:
        """Return a folder for passing files, gone when the run ends."""
        if self._scratch is None:
            self._scratch = tempfile.TemporaryDirectory(prefix="mtpcr-geo-")
        return Path(self._scratch.name)

    def close(self) -> None:
        """Remove passing files, and finish the recording."""
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
        late: whether it runs after all others, since it tells about the whole run.

    """

    type: ClassVar[str]
    Options: ClassVar[OptionsModel]
    evidence: ClassVar[bool] = False
    late: ClassVar[bool] = False

    def __init__(self, options: StageOptions, tag: str) -> None:
        self.options = options
        self.tag = tag
        self.metadata: dict[str, Any] = {}

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

    @abstractmethod
    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Do the work. Writers hand on what they were given; None means nothing goes on from here."""

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


def _describe(inputs: Sequence[Value]) -> str:
    kinds = ["a pair" if isinstance(value, Pair) else "a cloud" for value in inputs]
    return " and ".join(kinds) if kinds else "nothing"
