"""Memory of this process and of those it starts, measured anew for each run where the system allows."""

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
    """Return the most resident memory since the last reset, in MiB: libraries and inputs included.

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


def tree_mib(pid: int) -> float | None:
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
    return own / 1024 + sum(tree_mib(int(child)) or 0.0 for child in children)
