"""Stages that Python makes and pipeline JSON cannot name: a cloud in memory, a recording already there."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.pipeline.stage import RunContext, Stage, StageOptions, Value
from mtpcr_geo.pipeline.stages.export import EvidenceWriter, FileOptions, WriteRecording


class MemoryReader(Stage):
    """Return a cloud given from Python."""

    type: ClassVar[str] = "readers.memory"
    Options = StageOptions

    def __init__(self, cloud: Cloud, tag: str) -> None:
        super().__init__(StageOptions(), tag)
        self.cloud = cloud

    def preview(self, context: RunContext) -> Value | None:
        """Return the cloud."""
        return self.cloud

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Return the cloud."""
        self.metadata |= {
            "name": self.cloud.name,
            "count": self.cloud.count,
            "srs": self.cloud.crs.to_wkt() if self.cloud.crs is not None else "",
        }
        return self.cloud


class SavedRecording(EvidenceWriter):
    """Put a recording that was kept aside in its place."""

    type: ClassVar[str] = WriteRecording.type

    def __init__(self, recording: Path, filename: Path, tag: str) -> None:
        super().__init__(FileOptions(filename=filename), tag)
        self.recording = recording

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Copy the file."""
        shutil.copyfile(self.recording, context.outputs.path(self.options.filename))
        return inputs[0] if inputs else None
