"""What is on record of a run: its inputs, its stages, and what holds for all of it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import InputError


@dataclass(frozen=True)
class StageRecord:
    """One finished stage.

    Attributes:
        type: such as "mtpcr.level".
        tag: its name in the pipeline.
        options: all its options, for the audit.
        seconds: wall time.
        metadata: what it reported, for the audit.
        skipped: why it did not run, or made nothing, or None.
        failed: why it could not go on, or None.
        not_written: files that it would have written, and why it did not.
        forced: whether it wrote, or let through, what the verdict withholds.
        used: processor time, memory and bytes, see `mtpcr_geo.core.system.Meter.since`; for the audit.

    """

    type: str
    tag: str
    options: Mapping[str, Any]
    seconds: float
    metadata: Mapping[str, Any]
    skipped: str | None = None
    failed: str | None = None
    not_written: Mapping[Path, str] = field(default_factory=dict)
    forced: bool = False
    used: Mapping[str, float | None] = field(default_factory=dict)

    def audit(self) -> dict[str, Any]:
        """Return the record as a dict, for JSON and reports."""
        reasons = {"skipped": self.skipped, "failed": self.failed}
        return {
            "type": self.type,
            "tag": self.tag,
            "options": dict(self.options),
            **{key: reason for key, reason in reasons.items() if reason is not None},
            "seconds": self.seconds,
            **self.used,
            "metadata": dict(self.metadata),
        }


@dataclass(frozen=True)
class InputFile:
    """A file as it stood when the run read it.

    Attributes:
        path: the file.
        size: bytes.
        modified_ns: time of its last change, nanoseconds.
        sha256: hash of its content, 64 hexadecimal digits; None where nobody asked for it.

    """

    path: Path
    size: int
    modified_ns: int
    sha256: str | None = None

    @classmethod
    def of(cls, path: Path) -> InputFile:
        """Look at a file, without reading it."""
        state = path.stat()
        return cls(path, state.st_size, state.st_mtime_ns)

    def hashed(self) -> InputFile:
        """Return the same with the hash of the content.

        Raises:
            InputError: if the file has changed or gone since.

        """
        from mtpcr_geo.core.system import sha256

        if not os.path.isfile(self.path) or InputFile.of(self.path) != replace(self, sha256=None):
            raise InputError(f"{self.path} has changed since it was read; run again")
        return self if self.sha256 is not None else replace(self, sha256=sha256(self.path))


@dataclass(frozen=True)
class RunFacts:
    """What holds for a whole run.

    Attributes:
        pipeline: the stages as written (type, tag, inputs, options), for the audit.
        started: reading of `time.perf_counter` at the start, seconds.
        versions: of this package and of what it is built on, by name.
        inputs: the files read.

    """

    pipeline: tuple[Mapping[str, Any], ...] = ()
    started: float = 0.0
    versions: Mapping[str, str] = field(default_factory=dict)
    inputs: tuple[InputFile, ...] = ()

    def audit(self) -> dict[str, Any]:
        """Return the facts as a dict, for JSON, reports and recordings."""
        return {
            "pipeline": [dict(stage) for stage in self.pipeline],
            "versions": dict(self.versions),
            "inputs": [
                {"path": str(file.path), "bytes": file.size, "sha256": file.sha256} for file in self.inputs
            ],
        }


@dataclass(frozen=True)
class Written:
    """What a run left, and what it did not: the same for terminal, report and run.json.

    Attributes:
        files: in place, or about to be.
        withheld: files that are not written, and why not.
        forced: whether files were written that the verdict withholds.

    """

    files: tuple[Path, ...]
    withheld: Mapping[Path, str]
    forced: bool

    @classmethod
    def of(cls, done: Iterable[StageRecord], files: Iterable[Path]) -> Written:
        """Gather it from the finished stages and the files written."""
        done, files = list(done), tuple(files)
        withheld = {path: why for record in done for path, why in record.not_written.items()}
        return cls(
            files,
            {path: why for path, why in withheld.items() if path not in files},
            any(record.forced for record in done),
        )

    def audit(self) -> dict[str, Any]:
        """Return it as a dict, for JSON and reports; withheld files as a list with their reasons."""
        return {
            "files": [str(path) for path in self.files],
            "withheld": [{"path": str(path), "why": why} for path, why in self.withheld.items()],
            "forced": self.forced,
        }


def input_files(paths: Iterable[Path]) -> tuple[InputFile, ...]:
    """Look at each file once; what is no regular file is left out."""
    return tuple(InputFile.of(path) for path in dict.fromkeys(paths) if os.path.isfile(path))
