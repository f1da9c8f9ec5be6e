"""Single jobs of other libraries and of this package, each run in a process of its own to be measured.

``python -m mtpcr_geo.benchmark.yardsticks JOB PATHS...`` with a job of `JOBS`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mtpcr_geo.core.errors import MissingPartError, MtpcrError

CHUNK_POINTS = 1_000_000
CELL_M = 1.0
LOOK_S = 0.02
"""How often the memory of a process is looked at, seconds."""
MOVE = "0.8 -0.6 0 20 0.6 0.8 0 -10 0 0 1 3 0 0 0 1"
"""A turn of 37 degrees and a shift, as filters.transformation of PDAL has it."""


@dataclass(frozen=True)
class Measured:
    """What a process took.

    Attributes:
        wall_s: from its start to its end.
        cpu_s: processor time of all its threads.
        peak_mib: largest memory; None where the system does not report it.

    """

    wall_s: float
    cpu_s: float
    peak_mib: float | None


def measured(command: Sequence[str | Path]) -> Measured:
    """Run a command to its end, and return what it took.

    Raises:
        MissingPartError: if the system cannot tell what a process took.
        MtpcrError: if the command fails; the message ends with what it printed.

    """
    if not hasattr(os, "wait4"):
        raise MissingPartError("this system does not tell what a process took; run this on Linux or macOS")
    start = time.perf_counter()
    peak = None
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen([str(word) for word in command], stdout=subprocess.DEVNULL, stderr=said)
        pid = 0
        while pid == 0:
            # by Linux's rusage a process has had the memory of the one that started it, too
            peak = _largest_memory(process.pid) or peak
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
            if pid == 0:
                time.sleep(LOOK_S)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - start
        said.seek(0)
        printed = said.read()
    if process.returncode not in (0, 3, 4):  # a verdict is no failure of the run
        last = (printed.decode(errors="replace").strip().splitlines() or [""])[-1]
        raise MtpcrError(f"{' '.join(str(word) for word in command[:6])} ... failed: {last}")
    # bytes on macOS, kibibytes elsewhere
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return Measured(wall, used.ru_utime + used.ru_stime, peak or used.ru_maxrss / unit)


def _largest_memory(pid: int) -> float | None:
    """Return the largest memory of a running process so far, MiB; None where Linux does not tell."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 2**10
    except OSError:
        pass
    return None


def job(name: str, *paths: str | Path) -> list[str]:
    """Return the command that does a job of `JOBS`."""
    return [sys.executable, "-m", __name__, name, *map(str, paths)]


def laspy_read(*paths: str) -> None:
    """Read files by laspy, decoded in parallel, a million points at a time."""
    import laspy

    for path in paths:
        with laspy.open(path) as reader:
            for _ in reader.chunk_iterator(CHUNK_POINTS):
                pass


def laspy_copy(path: str, out: str) -> None:
    """Read a file and write it again by laspy, in parallel, a million points at a time."""
    import laspy

    with laspy.open(path) as reader, laspy.open(out, "w", header=reader.header, do_compress=True) as writer:
        for points in reader.chunk_iterator(CHUNK_POINTS):
            writer.write_points(points)


def own_bev(path: str, out: str) -> None:
    """Rasterise a file into the highest and lowest height and the count of each cell, by this package."""
    from mtpcr_geo.pipeline.api import Pipeline

    level = {"type": "mtpcr.level", "method": "none", "local": True}
    stages = [path, level, {"type": "mtpcr.bev", "cell": CELL_M}]
    Pipeline([*stages, {"type": "mtpcr.write_bev", "filename": out}], overwrite=True).execute()


def pdal_bev(path: str, out: str) -> None:
    """Do the same by PDAL's writers.gdal, in its streaming mode.

    A cell takes the points within half a cell of its middle: that of all the square is an option of newer
    releases only, and no faster.
    """
    writer = {
        "type": "writers.gdal",
        "filename": out,
        "resolution": CELL_M,
        "output_type": "max,min,count",
        "radius": CELL_M / 2,
        "gdalopts": "COMPRESS=DEFLATE,TILED=YES",
    }
    _stream([path, writer])


def pdal_move(path: str, out: str) -> None:
    """Move a file by PDAL's filters.transformation, in its streaming mode."""
    import laspy
    import numpy as np

    with laspy.open(path) as file:
        middle = (file.header.mins + file.header.maxs) / 2
    T = np.array(MOVE.split(), np.float64).reshape(4, 4)
    # offsets of the place that the cloud came from would not hold it where it goes
    there = np.floor(T[:3, :3] @ middle + T[:3, 3])
    offsets = {f"offset_{axis}": float(value) for axis, value in zip("xyz", there, strict=True)}
    writer = {"type": "writers.las", "filename": out, "minor_version": 4, "forward": "all", **offsets}
    _stream([path, {"type": "filters.transformation", "matrix": MOVE}, {**writer, "compression": "laszip"}])


def _stream(stages: list[object]) -> None:
    import pdal

    pdal.Pipeline(json.dumps(stages)).execute_streaming(chunk_size=CHUNK_POINTS)


JOBS: dict[str, Callable[..., None]] = {
    "laspy-read": laspy_read,
    "laspy-copy": laspy_copy,
    "bev": own_bev,
    "pdal-bev": pdal_bev,
    "pdal-move": pdal_move,
}


if __name__ == "__main__":
    JOBS[sys.argv[1]](*sys.argv[2:])
