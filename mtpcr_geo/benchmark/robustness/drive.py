"""Running cases in processes of their own, several at a time, each row kept at once.

    rows = run_cases(cases(["pairs"], options), Path("out/robustness.csv"), jobs=2)

A process runs one batch of cases after another (those of the same clouds together). One that crashes, or
takes too long, costs its case alone: the row says so, and another process takes the rest.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mtpcr_geo.benchmark.protocol import threads_of_children
from mtpcr_geo.benchmark.robustness.cases import Case
from mtpcr_geo.benchmark.robustness.results import RowFile, read_rows
from mtpcr_geo.benchmark.robustness.runner import Row, failure, labels_of, run_clouds, scene_of
from mtpcr_geo.core.errors import MtpcrError, OptionError
from mtpcr_geo.core.progress import NoProgress

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from mtpcr_geo.core.progress import Progress

MAKING_LIMIT_S = 1800.0
"""Longest that making the clouds of a case may take."""


@dataclass
class _Worker:
    """A process, its batch, when it last sent something, and what is known of the case under way."""

    process: SpawnProcess
    pipe: Connection
    left: deque[Case]
    last_message: float
    known: Row | None = None


def run_cases(
    chosen: Iterable[Case],
    path: Path,
    *,
    jobs: int = 1,
    time_limit_s: float = 600.0,
    progress: Progress | None = None,
) -> list[Row]:
    """Run the cases that have no row yet, and return the rows of all of them.

    Args:
        chosen: what to run.
        path: CSV to which rows are appended; made if missing.
        jobs: processes at a time; each gets its share of the cores.
        time_limit_s: a run that takes longer is stopped, and its verdict is "failed".
        progress: where to report runs.

    Raises:
        OptionError: if two cases have one name, or the file has other columns, or runs by other options.
        InputError, OutputError: if the file cannot be read or written.

    """
    if jobs < 1:
        raise OptionError("jobs must be at least 1")
    todo = list(chosen)
    names = [case.name for case in todo]
    if len(set(names)) < len(names):
        raise OptionError("two cases have the same name; their rows could not be told apart")
    there = {row["case"] for row in read_rows(path)} if Path(path).exists() else set()
    # the sums of a folder do not ask by which options its runs were made
    made_with = {_options_in(name) for name in [*there, *names]}
    if len(made_with) > 1:
        raise OptionError(f"{path} holds runs with other options of register; choose another folder")
    batches = _batches([case for case in todo if case.name not in there])
    count = sum(map(len, batches))
    with RowFile(path) as file, (progress or NoProgress()).task("robustness runs", count) as advance:

        def keep(row: Row) -> None:
            file.append(row)
            advance(1)

        _drive(batches, jobs, time_limit_s, keep)
    wanted = set(names)
    return [row for row in read_rows(path) if row["case"] in wanted]


def _options_in(name: str) -> tuple[str, ...]:
    """Return the options of register that stand in a case's name, behind its start."""
    parts = name.split("/")
    starts = [k for k, part in enumerate(parts) if part.startswith("start") and part[5:].isdigit()]
    return tuple(parts[starts[0] + 1 :]) if starts else ()


def _batches(todo: Sequence[Case]) -> deque[deque[Case]]:
    """Group cases by their clouds, in order of appearance."""
    groups: dict[tuple[str, str], deque[Case]] = {}
    for case in todo:
        groups.setdefault(case.batch, deque()).append(case)
    return deque(groups.values())


def serve(pipe: Connection) -> None:
    """Run the cases that come through a pipe until None comes.

    Each is answered by ``("begun", labels and scene)`` once its clouds are made, and ``("row", row)``.
    """
    while (case := pipe.recv()) is not None:
        known = labels_of(case)
        try:
            clouds = case.clouds()
        except (MtpcrError, ValueError, ArithmeticError, MemoryError) as error:
            pipe.send(("row", known | failure(f"no clouds: {type(error).__name__}: {error}")))
            continue
        known |= scene_of(clouds)
        pipe.send(("begun", known))
        pipe.send(("row", known | run_clouds(clouds, both_ways=case.both_ways)))


def _drive(batches: deque[deque[Case]], jobs: int, limit: float, keep: Any) -> None:
    threads = max(1, (os.cpu_count() or 1) // jobs)
    workers: list[_Worker] = []
    try:
        while batches or workers:
            while batches and len(workers) < jobs:
                workers.append(_started(batches.popleft(), threads))
            now = time.monotonic()
            due = [one.last_message + _patience(one, limit) - now for one in workers]
            ready = wait([one.pipe for one in workers], max(0.0, min(due)))
            for one in list(workers):
                reason = None
                if one.pipe in ready:
                    reason = _heard(one, batches, keep)
                elif time.monotonic() - one.last_message > _patience(one, limit):
                    one.process.kill()
                    reason = f"stopped after {_patience(one, limit):g} s"
                if reason is not None:
                    seconds = time.monotonic() - one.last_message
                    keep((one.known or labels_of(one.left[0])) | failure(reason, seconds))
                    one.left.popleft()
                    _end(one, workers)
                    if one.left:
                        batches.appendleft(one.left)
                elif not one.left:
                    _end(one, workers)
    finally:
        for one in workers:
            one.process.terminate()


def _started(left: deque[Case], threads: int) -> _Worker:
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs,), daemon=True)
    with threads_of_children(threads):
        process.start()
    theirs.close()
    mine.send(left[0])
    return _Worker(process, mine, left, time.monotonic())


def _heard(one: _Worker, batches: deque[deque[Case]], keep: Any) -> str | None:
    """Take a worker's message, and send its next case; return why, if it is gone."""
    try:
        kind, what = one.pipe.recv()
    except (EOFError, OSError):
        one.process.join()
        return f"the process ended with exit code {one.process.exitcode}"
    one.last_message = time.monotonic()
    if kind == "begun":
        one.known = what
        return None
    keep(what)
    one.known = None
    one.left.popleft()
    if not one.left and batches:
        one.left = batches.popleft()
    if one.left:
        one.pipe.send(one.left[0])
    return None


def _end(one: _Worker, workers: list[_Worker]) -> None:
    workers.remove(one)
    # it may be gone already
    with contextlib.suppress(OSError):
        one.pipe.send(None)
    one.process.join()
    one.pipe.close()


def _patience(one: _Worker, limit: float) -> float:
    return MAKING_LIMIT_S if one.known is None else limit
