"""The process that draws a recording: it may be started before it is known what there is to draw."""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mtpcr_geo.core.imports import search_path
from mtpcr_geo.core.system import THREAD_VARIABLES, command_line, usable_cores

_START = "import sys; sys.path[:] = {path!r}; from mtpcr_geo.export.recording.apart import serve; serve()"


@dataclass(frozen=True)
class Drawing:
    """A process that draws, and where it says what went wrong.

    Attributes:
        process: takes what `mtpcr_geo.export.recording.apart.RemoteWriter` sends by its standard input; ends
            when that is closed.
        said: its standard error.

    """

    process: subprocess.Popen[bytes]
    said: IO[bytes]

    def discard(self) -> None:
        """End the process, whatever it does."""
        self.process.kill()
        self.process.communicate()
        self.said.close()


def started() -> Drawing:
    """Return the process that `start_ahead` has started, once; another one otherwise.

    Raises:
        OSError: if no process can be started.

    """
    global _waiting
    if _waiting is None:
        return _start()
    drawing, _waiting = _waiting, None
    atexit.unregister(drawing.discard)
    if drawing.process.poll() is None:
        return drawing
    drawing.discard()
    return _start()


def start_ahead(threads: int = 0) -> None:
    """Start the process now, where a recording will be drawn by one, so that it imports rerun meanwhile.

    It ends with this process at the latest.

    Args:
        threads: cores that the run, and so the process, may use; all if 0.

    """
    global _waiting
    if _waiting is None and threads != 1 and pays():
        try:
            _waiting = _start(threads)
        except OSError:  # no more processes are allowed; asked again when it is needed
            return
        atexit.register(_waiting.discard)


def pays() -> bool:
    """Return whether another process saves time: this one is a command, and has not imported rerun."""
    # a program that only holds Python would start itself again
    python = "python" in Path(sys.executable or "").name.lower() and not hasattr(sys, "frozen")
    return python and command_line() is not None and usable_cores() > 1 and "rerun" not in sys.modules


def _start(threads: int = 0) -> Drawing:
    # where the run is limited already, its environment says so
    limits = dict.fromkeys(THREAD_VARIABLES, str(min(threads, usable_cores()))) if threads else {}
    said = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", _START.format(path=search_path())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=said,
            env={**os.environ, **limits},
            # what a terminal interrupts is the run; this one ends when the pipe does
            process_group=0 if os.name == "posix" else None,
        )
    except OSError:
        said.close()
        raise
    return Drawing(process, said)


_waiting: Drawing | None = None
