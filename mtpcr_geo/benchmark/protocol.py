"""The protocol: every method on every pair from n random starts, in parallel, resumable.

    runs = run_protocol(pair_folders(data), ["mtpcr-geo", "kiss-matcher:voxel=1"], Path("out"), starts=10)

Results are one JSON line a run in ``runs.jsonl``; what is there is not run again. ``protocol.json``
beside it says how the starts are drawn: results of two protocols never mix. What a run printed stands in
``printed/``, a file each, which the row names (``printed``); what libraries print between runs goes to
``methods.log``. A run without an answer has no time, and its reason says what happened.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from mtpcr_geo.benchmark.baselines.process import ending, kept_of, with_telling
from mtpcr_geo.benchmark.methods import make_method
from mtpcr_geo.benchmark.worker import PRINTED, StartRange, Task, work
from mtpcr_geo.core.errors import InputError, MtpcrError, OptionError, OutputError
from mtpcr_geo.core.progress import NoProgress

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from mtpcr_geo.core.progress import Progress

Row = dict[str, Any]
RUNS, PROTOCOL, LOG = "runs.jsonl", "protocol.json", "methods.log"
LOADING_LIMIT_S = 600.0
# an external command is stopped by its own process, which then still reads and reports; only if it does not
# is that process stopped
_GRACE_S = 20.0
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
FRAME = "metres; origin at the middle of the target's bounds; z up"


@dataclass
class _Running:
    """A task under way: its process, when its last message came, and what is known of its current run."""

    task: Task
    process: SpawnProcess
    last_message: float
    left: deque[int]
    begun: Row | None = None


def run_protocol(
    folders: Sequence[Path],
    methods: Sequence[str],
    out: Path,
    *,
    starts: int = 10,
    ranges: StartRange | None = None,
    jobs: int = 1,
    time_limit_s: float = 600.0,
    progress: Progress | None = None,
) -> list[Row]:
    """Run what is not in the results yet, and give all rows of these pairs and methods.

    Starts beyond those asked for, from an earlier call, are given too.

    Args:
        folders: pairs.
        methods: names with options, see `mtpcr_geo.benchmark.methods`.
        out: folder of the results; made if missing.
        starts: random starts of each pair.
        ranges: what starts are drawn from.
        jobs: processes at a time; each gets its share of the cores.
        time_limit_s: a run that takes longer is stopped, and counts as one without an answer.
        progress: where to report runs.

    Raises:
        OptionError: if a method or option is wrong, or `out` holds results of another protocol.
        MissingPartError: if a method's library is missing.
        InputError: if a pair cannot be read.

    """
    if starts < 1 or jobs < 1:
        raise OptionError("starts and jobs must be at least 1")
    if len({folder.name for folder in folders}) < len(folders):
        raise OptionError("two pairs have the same name; the results could not tell them apart")
    for method in methods:
        make_method(method)
    out, ranges = Path(out), ranges or StartRange()
    _claim(out, ranges)
    path = out / RUNS
    there = {_key(row) for row in read_rows(path)} if path.exists() else set()
    threads = max(1, (os.cpu_count() or 1) // jobs)
    waiting: deque[Task] = deque()
    for folder in folders:
        for method in methods:
            left = [k for k in range(starts) if (folder.name, method, k) not in there]
            if left:
                waiting.append(
                    Task(Path(folder), method, tuple(left), ranges, threads, out / LOG, time_limit_s)
                )
    count = sum(len(task.starts) for task in waiting)
    bars = progress or NoProgress()
    with _results(path) as file, bars.task("benchmark runs", count) as advance:
        _drive(waiting, jobs, time_limit_s, file, advance)
    if (out / PRINTED).exists() and not any((out / PRINTED).iterdir()):
        (out / PRINTED).rmdir()
    wanted = {(folder.name, method) for folder in folders for method in methods}
    return [row for row in read_rows(path) if (row["pair"], row["method"]) in wanted]


def read_rows(path: Path) -> list[Row]:
    """Read results; a last line that an interruption cut short is left out.

    Raises:
        InputError: if the file cannot be read, or another line is damaged.

    """
    try:
        lines = Path(path).read_text(encoding="utf-8").split("\n")
    except OSError as error:
        raise InputError(f"cannot read the results {path}: {error.strerror}") from error
    rows = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            rows.append(json.loads(line))
        except ValueError as error:
            if number == len(lines):
                break
            raise InputError(f"line {number} of {path} is damaged; remove it to run it again") from error
    return rows


def _key(row: Row) -> tuple[str, str, int]:
    return row["pair"], row["method"], row["start"]


def _claim(out: Path, ranges: StartRange) -> None:
    """Make the folder, and see that its results are of the same protocol."""
    import mtpcr_geo

    path = out / PROTOCOL
    mine = {"starts": asdict(ranges), "frame": FRAME}
    if path.exists():
        theirs = json.loads(path.read_text(encoding="utf-8"))
        if {key: theirs.get(key) for key in mine} != mine:
            raise OptionError(
                f"{out} holds results of other starts ({theirs['starts']}); choose another folder"
            )
        return
    about = {"version": mtpcr_geo.__version__, "machine": platform.machine(), "cores": os.cpu_count()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(mine | about, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}") from error


def _results(path: Path) -> TextIO:
    """Open the results for appending, without the half line that an interruption left."""
    try:
        if path.exists():
            data = path.read_bytes()
            if data and not data.endswith(b"\n"):
                path.write_bytes(data[: data.rfind(b"\n") + 1])
        return path.open("a", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def _drive(waiting: deque[Task], jobs: int, limit: float, file: TextIO, advance: Any) -> None:
    """Keep `jobs` processes busy until no task waits; write rows as they come."""
    context = multiprocessing.get_context("spawn")
    running: dict[Connection, _Running] = {}

    def write(row: Row) -> None:
        file.write(json.dumps(row, allow_nan=False, default=float) + "\n")
        file.flush()
        advance(1)

    def give_up(one: _Running, reason: str) -> None:
        # the start under way has no answer; those behind it get a process of their own
        assert one.begun is not None
        name, printed = _printed(one.task, one.left.popleft())
        write(
            one.begun
            | {"verdict": "unjudged", "reason": with_telling(reason, printed), "time_s": None}
            | {"memory_mib": None, "details": {}, "printed": name}
        )
        if one.left:
            waiting.appendleft(replace(one.task, starts=tuple(one.left)))

    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                task = waiting.popleft()
                mine, theirs = context.Pipe(duplex=False)
                process = context.Process(target=work, args=(task, theirs), daemon=True)
                with threads_of_children(task.threads):
                    process.start()
                theirs.close()
                running[mine] = _Running(task, process, time.monotonic(), deque(task.starts))
            now = time.monotonic()
            due = [one.last_message + _patience(one, limit) - now for one in running.values()]
            for pipe in wait(list(running), max(0.0, min(due))):
                assert isinstance(pipe, Connection)
                one = running[pipe]
                kind, what = _received(pipe)
                one.last_message = time.monotonic()
                if kind == "row":
                    one.left.popleft()
                    write(what)
                elif kind == "begun":
                    one.begun = what
                elif kind == "failed":
                    raise InputError(f"{one.task.folder.name} with {one.task.method}: {what}")
                else:
                    del running[pipe]
                    one.process.join()
                    if kind == "gone":
                        _ended(one, give_up)
            for pipe, one in list(running.items()):
                seconds = time.monotonic() - one.last_message
                if seconds > _patience(one, limit):
                    del running[pipe]
                    _stop(one.process)
                    if one.begun is None:
                        raise InputError(f"{one.task.folder} was not read within {LOADING_LIMIT_S:g} s")
                    give_up(one, f"stopped at the time limit of {limit:g} s")
    finally:
        for one in running.values():
            _stop(one.process)


def _stop(process: SpawnProcess) -> None:
    """End a process: asked first, so that it takes along an external command, then not asked."""
    process.terminate()
    process.join(5.0)
    if process.exitcode is None:
        process.kill()
        process.join()


def _printed(task: Task, start: int) -> tuple[str, str]:
    """Return the name and the content of what a run printed, empty where it printed nothing."""
    assert task.log is not None
    name = task.printed(start)
    path = task.log.parent / name
    if not path.exists():
        return "", ""
    if path.stat().st_size == 0:
        path.unlink()
        return "", ""
    return name, kept_of(path)


@contextmanager
def threads_of_children(count: int) -> Iterator[None]:
    """Let processes started meanwhile use so many threads: BLAS and OpenMP read that when they are loaded."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _patience(one: _Running, limit: float) -> float:
    if one.begun is None:
        return LOADING_LIMIT_S
    return limit + (_GRACE_S if one.task.method.startswith("external:") else 0.0)


def _received(pipe: Connection) -> tuple[str, Any]:
    try:
        kind, what = pipe.recv()
    except EOFError:
        return "gone", None
    return kind, what


def _ended(one: _Running, give_up: Any) -> None:
    """Deal with a process that ended in the middle: killed for memory, or crashed."""
    how = ending(one.process.exitcode)
    if one.begun is None:
        raise MtpcrError(
            f"the process for {one.task.folder.name} with {one.task.method} ended before its first run "
            f"({how}); see {one.task.log}"
        )
    if one.left:
        give_up(one, f"the process was lost, {how}")
