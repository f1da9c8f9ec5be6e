"""A command run to its end, within limits of time and memory, and what its end says."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_SAMPLE_S = 0.05
_MIB = 2**20
PRINTED_LIMIT = 2**18
"""Most of what a command printed that is kept, bytes: half from its beginning, half from its end."""
# runs the command with a limit on its address space; a limit in the parent would bind the parent
_LIMITER = (
    "import os, resource, sys; n = int(sys.argv[1]); resource.setrlimit(resource.RLIMIT_AS, (n, n)); "
    "os.execvp(sys.argv[2], sys.argv[2:])"
)
_TELLING = re.compile(
    r"\b(?:\w*error|\w*exception|fail(?:ed|ure|s)?|fatal|abort(?:ed|ing)?|cannot|can't|could not|unable"
    r"|killed|terminate|no such|not found|out of memory|bad_alloc|too few|segmentation|invalid"
    r"|unsupported)\b",
    re.IGNORECASE,
)
# the last line of a traceback: a dotted name, and what it says
_RAISED = re.compile(r"(?:\w+\.)*[A-Z]\w*(?:Error|Exception|Interrupt|Exit|Warning)\b(?::.*)?")
_COLOUR = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_TRACEBACK = "Traceback (most recent call last):"
_LONGEST = 300


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        failure: why there is no result, with the telling lines of what it printed; empty where it ended well.
        printed: both its streams.
        memory_mib: most resident memory of it and all it started, None where the system does not tell.

    """

    failure: str
    printed: str
    memory_mib: float | None


def run_command(
    command: Sequence[str],
    folder: Path,
    *,
    environment: Mapping[str, str],
    time_limit_s: float,
    memory_limit_mib: int | None = None,
) -> Ended:
    """Run a command in a folder, and stop it, with all it has started, at a limit.

    Args:
        command: program and arguments.
        folder: its current folder; ``output.txt`` there takes what it prints.
        environment: variables set besides those of this process.
        time_limit_s: seconds.
        memory_limit_mib: MiB; bounds the address space of each of its processes and the resident memory of
            all together, on systems that can.

    """
    program = shutil.which(command[0], path=environment.get("PATH"))
    if program is None:
        return Ended(f"cannot run {command[0]}: there is no such program", "", None)
    words = [program, *command[1:]]
    if memory_limit_mib is not None and os.name == "posix":
        words = [sys.executable, "-c", _LIMITER, str(memory_limit_mib * _MIB), *words]
    reported = folder / "output.txt"
    with reported.open("wb") as output:
        try:
            process = subprocess.Popen(
                words,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ | dict(environment),
                start_new_session=True,
            )
        except OSError as error:
            return Ended(f"cannot run {command[0]}: {error.strerror}", "", None)
        try:
            code, memory, stopped = _waited(process, time_limit_s, memory_limit_mib)
        finally:
            # also where this process is told to end meanwhile
            _kill(process)
    printed = kept_of(reported)
    failure = stopped or ("" if code == 0 else ending(code))
    return Ended(with_telling(failure, printed) if failure else "", printed, memory)


def ending(code: int | None) -> str:
    """Say how a process ended, from its exit code as Python gives it: negative for a signal."""
    if code is None or code >= 0:
        return f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    wanting = ", as the system does where memory runs out" if name == "SIGKILL" else ""
    return f"ended by {name}{wanting}"


def with_telling(failure: str, printed: str) -> str:
    """Add to a failure what was printed about it."""
    said = telling_lines(printed)
    return f"{failure}: {said}" if said else f"{failure}: it printed nothing"


def telling_lines(printed: str) -> str:
    """Choose what tells why a program failed: what a traceback raised, else lines that speak of a failure.

    The last line alone often says only that it failed. Where no line speaks of a failure, the last is taken.
    """
    lines = [
        line for line in (text.strip() for text in re.split(r"[\r\n]+", _COLOUR.sub("", printed))) if line
    ]
    if not lines:
        return ""
    if _TRACEBACK in lines:
        after = lines[len(lines) - lines[::-1].index(_TRACEBACK) :]
        raised = [line for line in after if _RAISED.fullmatch(line)]
        if raised:
            return raised[-1][:_LONGEST]
    telling = list(dict.fromkeys(line for line in lines if _TELLING.search(line)))
    if len(telling) == 1:
        # what says no more than that it failed often follows on the cause
        place = lines.index(telling[0])
        telling = lines[max(0, place - 1) : place + 1]
    # the first is nearest to the cause, the last nearest to the end
    chosen = telling[:2] + ([telling[-1]] if len(telling) > 2 else [])
    return "; ".join(line[:_LONGEST] for line in chosen or lines[-1:])


def kept_of(path: Path) -> str:
    """Read what was printed; the middle of very much is left out."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        if size <= PRINTED_LIMIT:
            return file.read().decode("utf-8", "replace")
        first = file.read(PRINTED_LIMIT // 2)
        file.seek(size - PRINTED_LIMIT // 2)
        last = file.read()
    left_out = f"\n[... {size - len(first) - len(last)} bytes left out ...]\n"
    return first.decode("utf-8", "replace") + left_out + last.decode("utf-8", "replace")


def _waited(
    process: subprocess.Popen[bytes], limit: float, memory_limit_mib: int | None
) -> tuple[int | None, float | None, str]:
    """Wait for a process: its exit code, its peak memory in MiB, and why it must be stopped, if it must."""
    end = time.monotonic() + limit
    peak: float | None = None
    while True:
        try:
            return process.wait(_SAMPLE_S), peak, ""
        except subprocess.TimeoutExpired:
            # what the system adds up at the end would count this process too, as it was at the fork
            now = tree_memory_mib(process.pid)
            peak = now if peak is None else max(peak, now or 0.0)
        if memory_limit_mib is not None and peak is not None and peak > memory_limit_mib:
            return None, peak, f"stopped at the memory limit of {memory_limit_mib} MiB"
        if time.monotonic() > end:
            return None, peak, f"stopped at the time limit of {limit:g} s"


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process with all it has started; nothing where all have ended."""
    if os.name == "posix":
        # its own session: what it has started goes with it, also where it has ended itself
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    elif process.poll() is None:
        process.kill()
    process.wait()


def tree_memory_mib(pid: int) -> float | None:
    """Return the resident memory of a process and all that descend from it, now, in MiB.

    None where the system does not tell (it is read from ``/proc``).
    """
    folder = Path("/proc") / str(pid)
    try:
        status = (folder / "status").read_text()
        children = (folder / "task" / str(pid) / "children").read_text().split()
    except OSError:
        return None
    own = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS:")), 0)
    return own / 1024 + sum(tree_memory_mib(int(child)) or 0.0 for child in children)
