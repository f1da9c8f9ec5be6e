"""The recording: what every stage took and made, as a file for the rerun viewer.

One worker thread draws while the run goes on, or hands what is drawn to a process of its own: the values
that stages hand on never change, so nothing has to be copied and the run hardly waits.
"""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.export.recording.budget import Budget
from mtpcr_geo.export.recording.process import pays


class RerunRecorder:
    """Writes a run to an `.rrd` file, with a layout for the viewer saved in it.

    Points are float32 in the work frame of their side (metres near zero); CRS, origins, file hashes,
    versions and options are recording properties.

    Args:
        path: the file to write; renamed by the caller once the run is whole.
        budget: how large the file may become: points are thinned by a seeded choice, pictures shrunk.
        seed: of the thinning.
        apart: draw in a process of its own, which takes more processor time and less of the run's; by
            default where this process is a command with more than one core, which has not drawn yet.

    Raises:
        OutputError: from `close`, if the file could not be written.

    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        budget: Budget | None = None,
        seed: int = 0,
        apart: bool | None = None,
    ) -> None:
        self.path = Path(path)
        self.apart = _pays_apart() if apart is None else apart
        self.budget = budget or Budget()
        self._worker: ThreadPoolExecutor | None = ThreadPoolExecutor(1, thread_name_prefix="recording")
        self._jobs: list[Future[None]] = []
        self._writer: Any = None
        self._submit(self._open, self.budget, seed)

    def begin(self, properties: dict[str, Any]) -> None:
        """Note what holds for the whole run: CRS, origin, file hashes, versions, options."""
        kept = dict(properties)
        self._submit(lambda: self._writer.begin(kept))

    def after(
        self, stage_type: str, tag: str, options: dict[str, Any], value: object, seconds: float
    ) -> None:
        """Note a finished stage and what it made (a `Pair`, a `Cloud` or None)."""
        kept = dict(options)
        self._submit(lambda: self._writer.after(stage_type, tag, kept, value, seconds))

    def close(self) -> None:
        """Finish the recording; a second call does nothing.

        Raises:
            OutputError: if the file could not be written.

        """
        if self._worker is None:
            return
        worker, self._worker = self._worker, None
        last = worker.submit(self._finish)
        worker.shutdown(wait=True)
        for job in [*self._jobs, last]:
            error = job.exception()
            if isinstance(error, OSError | RuntimeError):
                raise OutputError(f"cannot write the recording {self.path}: {error}") from error
            if error is not None:
                raise error

    def _submit(self, job: Any, *arguments: Any) -> None:
        if self._worker is None:
            raise ValueError("the recording is closed")
        self._jobs.append(self._worker.submit(job, *arguments))

    def _open(self, budget: Budget, seed: int) -> None:
        if self.apart:
            from mtpcr_geo.export.recording.apart import RemoteWriter

            try:
                self._writer = RemoteWriter(self.path, budget, seed)
                return
            except OSError:  # no more processes are allowed
                pass
        from mtpcr_geo.export.recording.writer import RecordingWriter

        self._writer = RecordingWriter(self.path, budget, seed)

    def _finish(self) -> None:
        if self._writer is not None:
            self._writer.close()


def _pays_apart() -> bool:
    """Return whether another process saves time: rerun is not imported here, and will not be needed again."""
    global _opened
    first, _opened = not _opened, True
    return first and pays()


_opened = False
