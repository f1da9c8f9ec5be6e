"""Stages that Python makes and pipeline JSON cannot name: a cloud in memory, a recording already there."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from mtpcr_geo.core.cloud import ArrayCloud, Cloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.memory import is_array
from mtpcr_geo.pipeline.stage import RunContext, Stage, StageOptions, Value
from mtpcr_geo.pipeline.stages.export import EvidenceWriter, FileOptions, WriteRecording

if TYPE_CHECKING:
    from mtpcr_geo.io.memory import CloudLike
    from mtpcr_geo.pipeline.options import RegisterOptions


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


def check_two(readers: Sequence[Stage]) -> None:
    """Refuse one cloud given as both: it would fit itself perfectly. Files are compared when they are read.

    Raises:
        InputError: if both are the same.

    """
    clouds = [reader.cloud for reader in readers if isinstance(reader, MemoryReader)]
    if len(clouds) < 2:
        return
    first, second = clouds
    same = first is second
    if isinstance(first, ArrayCloud) and isinstance(second, ArrayCloud):
        same = same or np.array_equal(first.xyz, second.xyz)
    if same:
        raise InputError("source and target hold the same points; give two different clouds")


def crs_of_arrays(options: RegisterOptions, source: CloudLike, target: CloudLike) -> dict[str, str]:
    """Return the CRS options of bare arrays for which no CRS is named: local."""
    named = {"source": options.source_crs, "target": options.target_crs}
    return {
        f"{role}_crs": "local"
        for role, cloud in (("source", source), ("target", target))
        if named[role] is None and not options.local and is_array(cloud)
    }
