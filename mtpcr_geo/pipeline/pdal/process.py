"""Asks PDAL in a process of its own, so that a crash of PDAL's is an error here and leaves nothing.

Points come through a pipe, an array at a time: what is not taken yet waits in PDAL, so memory does not grow
with the number of points. A process that has answered waits for the next question of the same run.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.errors import MissingPartError
from mtpcr_geo.core.imports import search_path
from mtpcr_geo.pipeline.pdal.switches import Access, environment

INSTALL = (
    "install PDAL and its Python package: conda install -c conda-forge python-pdal (all systems), "
    "apk add py3-pdal (Alpine), port install py-pdal (MacPorts), or use the container pdal/pdal; "
    "Debian and Ubuntu have no package"
)
_WORKER = "mtpcr_geo.pipeline.pdal.worker"
_LAST_WORDS = 4096
_PIPE_BYTES = 2**20

Answer = dict[str, Any]
Records = NDArray[np.void]


class PdalError(Exception):
    """What PDAL says is wrong."""


class PdalCrashError(Exception):
    """PDAL's process ended without an answer."""


class _Process:
    """A process with PDAL in it, and how it was started."""

    def __init__(self, access: Access) -> None:
        if not sys.executable:
            raise MissingPartError("PDAL runs in a process of its own, and this Python names no executable")
        self.started_as = _start(access)
        self.used = False
        self._errors: IO[bytes] | None = None if access.code else tempfile.TemporaryFile()  # noqa: SIM115
        try:
            self._popen = subprocess.Popen(
                # -P: nothing is imported from the current folder
                [sys.executable, "-P", "-m", _WORKER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                # what an author's code prints is for the user; what libraries print is not
                stderr=self._errors,
                env=self.started_as[0],
                # Ctrl-C is for this process, which then ends that one
                start_new_session=True,
            )
        except OSError as error:
            self._forget_errors()
            raise MissingPartError(f"cannot start a process for PDAL: {error.strerror}") from error
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        self._questions, self._answers = self._popen.stdin, self._popen.stdout
        _widen(self._answers)

    @property
    def alive(self) -> bool:
        return self._popen.poll() is None

    def ask(self, question: Mapping[str, Any]) -> Iterator[Answer | Records]:
        """Yield what comes for a question, an answer with "done" last.

        Raises:
            PdalError: with PDAL's message.
            PdalCrashError: if the process ends.

        """
        with suppress(BrokenPipeError):
            self._questions.write(json.dumps(question).encode() + b"\n")
            self._questions.flush()
        while True:
            answer = self._answer()
            if "array" in answer:
                yield self._array(answer)
                continue
            problem = answer.get("problem")
            if problem == "memory":
                # a header may ask for more than any machine has
                raise PdalError("more memory is asked for than there is")
            if problem == "missing":
                raise MissingPartError(f"the package pdal does not load ({answer['text']}); {INSTALL}")
            if problem is not None:
                raise PdalError(answer["text"])
            self.used = True
            yield answer
            if "done" in answer:
                return

    def _answer(self) -> Answer:
        line = self._answers.readline()
        if not line.endswith(b"\n"):
            raise PdalCrashError(self._last_words())
        answer: Answer = json.loads(line)
        return answer

    def _array(self, answer: Answer) -> Records:
        records = np.empty(answer["length"], np.dtype([tuple(one) for one in answer["array"]]))
        wanted = records.view(np.uint8).reshape(-1).data
        while len(wanted):
            got = self._answers.readinto(wanted)  # type: ignore[attr-defined]
            if not got:
                raise PdalCrashError(self._last_words())
            wanted = wanted[got:]
        return records

    def _last_words(self) -> str:
        """Say how the process ended."""
        code = self._popen.wait()
        with suppress(ValueError):
            if code < 0:
                number = signal.Signals(-code)
                hint = "; memory may have run out" if number == signal.SIGKILL else ""
                return f"{signal.strsignal(number) or number.name}, {number.name}{hint}{self._printed()}"
        return f"exit code {code}{self._printed()}"

    def _printed(self) -> str:
        if self._errors is None:
            return ""
        self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - _LAST_WORDS))
        lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        return f", after {lines[-1].strip()[:200]!r}" if lines else ""

    def gone(self) -> bool:
        """Return whether it had ended, for want of questions, before the last one reached it."""
        return self.used and self._popen.wait() == 0

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self._popen.kill()
        self._popen.wait()
        with suppress(OSError):
            # what could not be sent any more
            self._questions.close()
        self._answers.close()
        self._forget_errors()

    def _forget_errors(self) -> None:
        if self._errors is not None:
            self._errors.close()


class _Waiting:
    """Processes that wait for the next question."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._processes: list[_Process] = []

    def take(self, access: Access) -> _Process:
        """Return a process started as one would be now."""
        wanted = _start(access)
        with self._lock:
            waiting, self._processes = self._processes, []
            found = next((one for one in waiting if one.alive and one.started_as == wanted), None)
            self._processes = [found] if found is not None else []
            for process in waiting:
                if process is not found:
                    process.end()
            return self._processes.pop() if found is not None else _Process(access)

    def put(self, process: _Process) -> None:
        with self._lock:
            self._processes.append(process)

    def end_all(self) -> None:
        with self._lock:
            waiting, self._processes = self._processes, []
        for process in waiting:
            process.end()

    def forget(self) -> None:
        """Leave the processes to the one that this one was forked from."""
        self._lock = threading.Lock()
        self._processes = []


_WAITING = _Waiting()
atexit.register(_WAITING.end_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_WAITING.forget)


def ask(access: Access, **question: Any) -> Generator[Answer | Records, None, None]:
    """Ask PDAL, and yield what comes: arrays, and answers of which the last has "done".

    Who does not take all ends the process.

    Args:
        access: what the stages may do.
        question: what to do, as the worker knows it.

    Raises:
        PdalError: with PDAL's message.
        PdalCrashError: if PDAL crashes.
        MissingPartError: if the package is there but does not load, or no process can be started.

    """
    while True:
        process = _WAITING.take(access)
        reused, answered, healthy = process.used, False, False
        try:
            for answer in process.ask(question):
                answered = True
                yield answer
            healthy = True
            return
        except (PdalError, MissingPartError):
            healthy = True
            raise
        except PdalCrashError:
            if answered or not reused or not process.gone():
                raise
        finally:
            if healthy:
                _WAITING.put(process)
            else:
                process.end()


def done(access: Access, **question: Any) -> Answer:
    """Ask PDAL for what comes without points; raises as `ask`."""
    *_, last = ask(access, **question)
    assert isinstance(last, dict)
    facts: Answer = last["done"]
    return facts


def end_waiting() -> None:
    """End the processes that wait for a question."""
    _WAITING.end_all()


def _start(access: Access) -> tuple[dict[str, str], str]:
    """Return the environment and the folder that a process would start in."""
    # the same packages as here, of which the current folder is one only where it was named
    package = str(Path(__file__).resolve().parents[3])
    paths = dict.fromkeys([*filter(None, search_path()), package])
    return {**environment(access), "PYTHONPATH": os.pathsep.join(paths)}, os.getcwd()


def _widen(pipe: IO[bytes]) -> None:
    """Let a pipe hold more at once, where the system can."""
    try:
        import fcntl

        fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    except (ImportError, AttributeError, OSError):
        # slower, and no more
        return
