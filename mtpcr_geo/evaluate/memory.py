"""Peak memory of this process, measured anew for each run where the system allows it."""

from __future__ import annotations

import sys
from pathlib import Path

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def reset_peak() -> None:
    """Start the measurement afresh; does nothing where the system has no such thing."""
    try:
        # 5 sets the high-water mark to what is held now (proc(5))
        _RESET.write_text("5")
    except OSError:
        return


def peak_mib() -> float | None:
    """Give the most resident memory since the last reset, in MiB: libraries and inputs included.

    Where it cannot be reset it is the process's peak so far; None where the system tells nothing.
    """
    try:
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024
