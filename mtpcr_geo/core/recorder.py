"""The audit: every stage logs what it took and made, through one recorder with a no-op twin."""

from __future__ import annotations

from typing import Any, Protocol

RECORDING_MB, LEAST_RECORDING_MB = 5.0, 1.0
"""Size of a recording at most, in millions of bytes: where nothing is said, and the least to ask for."""


class Recorder(Protocol):
    """What keeps the record of a run. All geometry is given in work-frame metres."""

    def begin(self, properties: dict[str, Any]) -> None:
        """Note what holds for the whole run: CRS, origin, file hashes, versions, options."""

    def after(
        self, stage_type: str, tag: str, options: dict[str, Any], value: object, seconds: float
    ) -> None:
        """Note a finished stage and what it made (a `Pair`, a `Cloud` or None)."""

    def close(self) -> None:
        """Finish the recording."""


class NullRecorder:
    """Keeps nothing and costs nothing."""

    def begin(self, properties: dict[str, Any]) -> None:
        """Keep nothing."""

    def after(
        self, stage_type: str, tag: str, options: dict[str, Any], value: object, seconds: float
    ) -> None:
        """Keep nothing."""

    def close(self) -> None:
        """Keep nothing."""
