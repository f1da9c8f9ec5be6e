"""What the PDAL that is installed has, and whether it would take given stages.

Nothing about PDAL is assumed: stages and options are asked of the library that is there (2.2 to 2.10).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from mtpcr_geo.core.errors import MissingPartError
from mtpcr_geo.pipeline.pdal import process
from mtpcr_geo.pipeline.pdal.process import INSTALL as INSTALL
from mtpcr_geo.pipeline.pdal.process import PdalCrashError, PdalError
from mtpcr_geo.pipeline.pdal.switches import Access

# what no cloud has: a stage behind all others that always stops PDAL between preparing and running
_STOP_DIMENSION = "MtpcrStopHere"
_STOP = {"type": "filters.range", "limits": f"{_STOP_DIMENSION}[0:1]", "tag": "mtpcr_stop_here"}


@dataclass(frozen=True)
class Driver:
    """A stage that PDAL has.

    Attributes:
        name: such as "filters.outlier".
        description: PDAL's one line about it.
        options: PDAL's description of each option, by name.
        streamable: whether it works point by point.

    """

    name: str
    description: str
    options: Mapping[str, str]
    streamable: bool


def available() -> bool:
    """Return whether the `pdal` package can be imported."""
    return importlib.util.find_spec("pdal") is not None


@cache
def drivers() -> dict[str, Driver]:
    """Ask PDAL which stages it has, with their options.

    Raises:
        MissingPartError: if the package is there but does not load.

    """
    try:
        found = process.done(Access(), do="drivers")["drivers"]
    except PdalCrashError as error:
        raise MissingPartError(f"PDAL crashes as it is loaded ({error}); {INSTALL}") from error
    return {driver["name"]: Driver(**driver) for driver in found}


def problem_of(stages: Sequence[Mapping[str, Any]], access: Access) -> str | None:
    """Let PDAL prepare stages without running them, and return its first complaint, or None.

    Preparing reads the options and the headers of inputs; no point is read and no file is written.

    Args:
        stages: as PDAL's JSON has them.
        access: what the stages may do meanwhile.

    Raises:
        PdalCrashError: if they make PDAL crash.

    """
    try:
        process.done(access, do="execute", stages=[*stages, _STOP], crs=False)
    except PdalError as error:
        message = first_line(error)
        return None if _STOP_DIMENSION in message else message
    return None


def first_line(error: BaseException) -> str:
    """Return the first line of PDAL's message, without a full stop."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0].rstrip(". ")
