"""One stage of PDAL as it is handed to PDAL: its JSON, its files, and PDAL's messages about it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError, MtpcrError, OptionError, OutputError
from mtpcr_geo.pipeline.grammar import StageSpec, file_of
from mtpcr_geo.pipeline.pdal.switches import Access

# the name under which a file is written until the run is whole
_PASSING = re.compile(r"\.([^/\\]+)\.part-\d+(\.\w+)")


@dataclass(eq=False)
class Step:
    """A PDAL stage with what it takes from: other steps, or clouds that our stages made.

    Attributes:
        spec: the stage as written.
        inputs: what it takes from.
        metadata: where PDAL's metadata of it goes, for the audit.
        written: whether it is a writer that has written its file.
        access: what it may do.

    """

    spec: StageSpec
    inputs: tuple[Step | Cloud, ...]
    metadata: dict[str, Any] = field(default_factory=dict)
    written: bool = False
    access: Access = field(default_factory=Access)

    @property
    def tag(self) -> str:
        """Its name in the pipeline."""
        return self.spec.tag


def is_reader(spec: StageSpec) -> bool:
    """Return whether a stage starts a chain."""
    return spec.type.startswith("readers.")


def is_writer(spec: StageSpec) -> bool:
    """Return whether a stage leaves a file."""
    return spec.type.startswith("writers.")


def file_written(spec: StageSpec) -> Path | None:
    """Return the one file that a writer leaves; None for others, and for one that numbers its files."""
    name = file_of(spec.options)
    return Path(name) if is_writer(spec) and name and "#" not in name else None


def numbered_files(spec: StageSpec) -> Path | None:
    """Return the filename of a writer that writes one file a view, a # standing for the number."""
    name = file_of(spec.options)
    return Path(name) if is_writer(spec) and name and "#" in name else None


def stage_json(spec: StageSpec, inputs: Sequence[str], **changed: Any) -> dict[str, Any]:
    """Return a stage as PDAL's JSON has it.

    Args:
        spec: the stage as written.
        inputs: tags that it takes from.
        changed: options that differ from those written.

    """
    fields = {**spec.options, **changed, "type": spec.type, "tag": spec.tag}
    return {**fields, "inputs": list(inputs)} if inputs else fields


def failure(spec: StageSpec, message: str, *, preparing: bool = False) -> MtpcrError:
    """Return the error for a message of PDAL, in one line that names the stage.

    Args:
        spec: the stage that PDAL blames.
        message: the one of PDAL.
        preparing: whether it came before the run.

    """
    detail = _PASSING.sub(r"\1\2", message.removeprefix(f"{spec.type}: "))
    text = f"{spec.label}: PDAL says: {detail}"
    if "argument" in detail or (preparing and not is_reader(spec)):
        return OptionError(text)
    return OutputError(text) if is_writer(spec) else InputError(text)


def crash(specs: Sequence[StageSpec], how: Exception) -> InputError:
    """Return the error for a crash of PDAL.

    Args:
        specs: the stages that it ran.
        how: how its process ended.

    """
    tags = ", ".join(spec.tag for spec in specs)
    one = specs[0].label if len(specs) == 1 else f"one of the stages {tags}"
    return InputError(
        f"{one}: PDAL crashed ({how}), and nothing of it is kept; look at what its options and its files hold"
    )
