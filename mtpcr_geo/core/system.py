"""What a run writes down about itself: versions, hashes, memory."""

from __future__ import annotations

import hashlib
import platform
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


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file's content, as 64 hexadecimal digits."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def peak_memory_mb() -> float | None:
    """Return the largest memory this process has held so far, in MiB; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # bytes on macOS, kibibytes elsewhere
    return round(peak / 2**20 if sys.platform == "darwin" else peak / 2**10, 1)
