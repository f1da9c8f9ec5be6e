"""One process of the benchmark: reads a pair once, and runs one method from several starts."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.baselines.external import External
from mtpcr_geo.benchmark.estimate import Estimate, Method
from mtpcr_geo.benchmark.methods import load_libraries, make_method
from mtpcr_geo.benchmark.metrics import overlap_ratios, pose_errors
from mtpcr_geo.benchmark.pairs import BenchmarkPair, load_pair
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import MtpcrError, RegistrationError
from mtpcr_geo.core.system import peak_memory_mb, reset_peak_memory

SAMPLE = 20_000
PRINTED = "printed"
"""Folder, in that of the log, of what the runs printed: a text file for each run that printed something."""


@dataclass(frozen=True)
class StartRange:
    """The random transforms that displace a source before its runs.

    Attributes:
        yaw_deg: turned about the vertical by 0 to this, degrees, about the source's centroid.
        tilt_deg: tilted about a random level axis by 0 to this, degrees.
        shift_m: moved in a random direction (of space) by 0 to this, metres.
        seed: of all starts; start k of a pair is the same for every method.

    """

    yaw_deg: float = 360.0
    tilt_deg: float = 0.0
    shift_m: float = 100.0
    seed: int = 0

    def draw(self, pair: str, start: int, centroid: Floats) -> tuple[Floats, dict[str, float]]:
        """Draw one start: the 4x4 that displaces the source, and its parts."""
        rng = np.random.default_rng([self.seed, start, *pair.encode()])
        yaw, tilt, shift = (rng.uniform(0.0, 1.0, 3) * (self.yaw_deg, self.tilt_deg, self.shift_m)).tolist()
        azimuth = rng.uniform(0.0, 2 * np.pi)
        direction = rng.normal(size=3)
        R = transforms.tilt_matrix(azimuth, np.deg2rad(tilt)) @ transforms.yaw_matrix(np.deg2rad(yaw))
        step = direction / np.linalg.norm(direction) * shift
        T = transforms.translation(step) @ transforms.about(centroid, R)
        return T, {"yaw_deg": yaw, "tilt_deg": tilt, "shift_m": shift}


@dataclass(frozen=True)
class Task:
    """Some starts of one pair with one method.

    Attributes:
        folder: of the pair.
        method: name and options.
        starts: which of the pair's starts.
        ranges: what they are drawn from.
        threads: how many the method's libraries may use; held to where the process is started.
        log: file to which goes whatever libraries print between runs, and beside which stands the folder of
            what they print during runs; nothing is caught if None.
        time_limit_s: longest run.

    """

    folder: Path
    method: str
    starts: tuple[int, ...]
    ranges: StartRange
    threads: int
    log: Path | None = None
    time_limit_s: float = 600.0

    def printed(self, start: int) -> str:
        """Name the file of what a run printed, relative to the log's folder; the same in every process."""
        words = re.sub(r"[^A-Za-z0-9.=-]+", "_", self.method)[-60:].strip("_")
        label = hashlib.sha256(self.method.encode()).hexdigest()[:8]
        return f"{PRINTED}/{self.folder.name}_{words}_{label}_{start}.txt"


def work(task: Task, parent: Connection) -> None:
    """Do a task in a process of its own; every row goes to the parent at once.

    Messages are pairs: for each run ``("begun", {...})`` with what is known before it and ``("row", {...})``
    with the whole result; ``("failed", text)`` where nothing can be run; ``("done", None)`` at the end.
    """
    # told to end, an external command's process is to take that along
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    if task.log is not None:
        _print_to(task.log)
    try:
        pair = load_pair(task.folder)
        method = make_method(task.method)
        load_libraries(task.method)
    except (MtpcrError, ImportError) as error:
        parent.send(("failed", str(error)))
        return
    if isinstance(method, External):
        method.time_limit_s = min(method.time_limit_s, task.time_limit_s)
    shares = overlap_ratios(pair.source, pair.target, pair.overlap_cell_m)
    for start in task.starts:
        T_start, drawn = task.ranges.draw(pair.name, start, pair.source.mean(axis=0))
        known: dict[str, Any] = {
            "pair": pair.name,
            "group": pair.group,
            "method": task.method,
            "start": start,
            **drawn,
            "overlap_source": shares[0],
            "overlap_target": shares[1],
            "overlap_cell_m": pair.overlap_cell_m,
            "points_source": len(pair.source),
            "points_target": len(pair.target),
        }
        parent.send(("begun", known))
        with _kept(task, start) as printed:
            row = known | run_once(pair, method, T_start, task.ranges.seed + start)
        parent.send(("row", row | {"printed": printed()}))
    parent.send(("done", None))


def _print_to(path: Path) -> None:
    # libraries in C++ print past Python's own streams
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (1, 2):
        os.dup2(file, stream)
    os.close(file)


@contextmanager
def _kept(task: Task, start: int) -> Iterator[Callable[[], str]]:
    """Keep what is printed meanwhile in a file; what is given says which, "" where nothing was printed."""
    if task.log is None:
        yield lambda: ""
        return
    name = task.printed(start)
    path = task.log.parent / name
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    _print_to(path)
    try:
        yield lambda: name if path.exists() else ""
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        _print_to(task.log)
        if path.stat().st_size == 0:
            path.unlink()


def run_once(pair: BenchmarkPair, method: Method, T_start: Floats, seed: int) -> dict[str, Any]:
    """Run a method on the source as ``T_start`` leaves it, and judge its answer.

    Lengths are in metres, in the frame of the pair (origin at the middle of the target's bounds).
    """
    source = transforms.apply(T_start, pair.source)
    T_true = transforms.inverse(T_start)
    reset_peak_memory()
    began = time.perf_counter()
    try:
        answer = method.estimate(source, pair.target.copy(), seed=seed)
    except RegistrationError as error:
        answer = Estimate(None, "refused", str(error))
    except Exception as error:  # noqa: BLE001 - a baseline is the code of others, and may raise anything
        traceback.print_exc()
        answer = Estimate(None, "unjudged", f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - began
    if answer.printed:
        sys.stdout.write(answer.printed)
    T = answer.T_target_source
    if T is not None and not np.isfinite(T).all():
        answer = replace(answer, T_target_source=None, reason="its transform is not finite")
        T = None
    row: dict[str, Any] = {
        "verdict": answer.verdict,
        "reason": answer.reason,
        # a run that broke off says nothing about how long an answer takes; a refusal is one
        "time_s": seconds if T is not None or answer.verdict == "refused" else None,
        "memory_mib": peak_memory_mb() if answer.memory_mib is None else answer.memory_mib,
        "details": answer.details,
    }
    if T is not None:
        sample = source[:: max(1, len(source) // SAMPLE)]
        row |= asdict(pose_errors(np.asarray(T, np.float64), T_true, sample, np.zeros(3)))
        row["T_target_source"] = np.asarray(T, np.float64).tolist()
    return row
