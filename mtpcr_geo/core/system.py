"""What a run writes down about itself: versions, hashes, memory."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from mtpcr_geo.core.version import __version__

_LIBRARIES = (
    "numpy", "scipy", "laspy", "lazrs", "rasterio", "pyproj", "opencv-python-headless", "small-gicp",
    "rerun-sdk", "onnxruntime", "pydantic", "pdal",
)  # fmt: skip


def versions() -> dict[str, str]:
    """Return the version of this package, of Python and of the libraries that are installed."""
    found = {"mtpcr_geo": __version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def command_line() -> str | None:
    """Return the command line that started this process, as a shell takes it; None where another program did.

    The command's folder is left out: it says where the package is installed and not what was run.
    """
    started = Path(sys.argv[0]) if sys.argv else Path()
    if started.name == "__main__.py" and started.parent.name == "mtpcr_geo":
        return shlex.join(["python", "-m", "mtpcr_geo", *sys.argv[1:]])
    if started.stem != "mtpcr-geo":
        return None
    return shlex.join(["mtpcr-geo", *sys.argv[1:]])


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file's content, as 64 hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def reset_peak_memory() -> None:
    """Let `peak_memory_mb` count from now on; do nothing where the system does not offer that."""
    try:
        # 5 sets the high-water mark to what is held now (proc(5))
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_memory_mb() -> float | None:
    """Return the largest resident memory since `reset_peak_memory`, in MiB; None where it is not known.

    Libraries and inputs are included. Where it cannot be reset it is the process's peak so far.
    """
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 2**10, 1)
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # bytes on macOS, kibibytes elsewhere
    return round(peak / 2**20 if sys.platform == "darwin" else peak / 2**10, 1)


@dataclass(frozen=True)
class Meter:
    """Readings of what the process has used so far; what the system does not report is None.

    Attributes:
        seconds: of `time.perf_counter`.
        cpu_s: processor time of all threads, seconds.
        read_mb, written_mb: handed over by the system for files and pipes, cached or not, MiB.
        memory_mb: held now, MiB.
        peak_memory_mb: see the function of that name.

    """

    seconds: float
    cpu_s: float
    read_mb: float | None
    written_mb: float | None
    memory_mb: float | None
    peak_memory_mb: float | None

    @classmethod
    def read(cls) -> Meter:
        """Read all."""
        moved = _numbers_of("/proc/self/io")
        read, written = (moved.get(name) for name in ("rchar", "wchar"))
        memory = _numbers_of("/proc/self/status")
        resident, peak = memory.get("VmRSS"), memory.get("VmHWM")
        return cls(
            time.perf_counter(),
            time.process_time(),
            None if read is None else read / 2**20,
            None if written is None else written / 2**20,
            None if resident is None else round(resident / 2**10, 1),
            peak_memory_mb() if peak is None else round(peak / 2**10, 1),
        )

    def since(self, before: Meter) -> dict[str, float | None]:
        """Return what was used from one reading to this one, for the audit; memory as it is here."""

        def grown(name: str) -> float | None:
            now, then = getattr(self, name), getattr(before, name)
            return None if now is None or then is None else round(now - then, 4)

        used = {name: grown(name) for name in ("cpu_s", "read_mb", "written_mb")}
        return {**used, "memory_mb": self.memory_mb, "peak_memory_mb": self.peak_memory_mb}


def _numbers_of(path: str) -> dict[str, int]:
    """Return the numbers that a file of the system states by name; none where there is no such file."""
    try:
        lines = Path(path).read_text().splitlines()
    except OSError:
        return {}
    named = ((name, rest.split()) for name, _, rest in (line.partition(":") for line in lines))
    return {name: int(words[0]) for name, words in named if words and words[0].isdigit()}


def usable_cores() -> int:
    """Return how many processor cores this process may use, see `cores`."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        count = os.cpu_count() or 1
    return count if _limit is None else min(count, _limit)


def core_limit() -> int:
    """Return how many cores `cores` allows; 0 where it was not asked."""
    return 0 if _limit is None else usable_cores()


_limit: int | None = None
# numpy's BLAS and lazrs read these when they are first used
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")


@contextmanager
def cores(most: int) -> Iterator[None]:
    """Let this package, and the libraries that can be told, use so many processor cores meanwhile.

    It holds for the whole process, whatever thread it is set in. Libraries that were used before keep the
    number that they began with, but for OpenCV and lazrs; results do not depend on it.

    Args:
        most: how many; 0 for all.

    """
    global _limit
    if not most:
        yield
        return
    import cv2

    before, of_opencv = _limit, cv2.getNumThreads()
    variables = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    _limit = most
    try:
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(usable_cores())))
        cv2.setNumThreads(usable_cores())
        yield
    finally:
        _limit = before
        cv2.setNumThreads(of_opencv)
        for name, value in variables.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def opencv_in_one_thread() -> Iterator[None]:
    """Keep OpenCV from sharing its work among threads meanwhile, in the whole process.

    The search and the pictures are shared among threads by this package; for images of some hundred cells
    a side OpenCV's own threads cost more than they save.
    """
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
