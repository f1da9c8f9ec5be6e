"""What a run writes down about itself: versions, hashes, memory."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import sys
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


def usable_cores() -> int:
    """Return how many processor cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1
