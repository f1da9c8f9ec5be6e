"""The `pdal` package where it is installed: what this PDAL has, and whether it would take given stages.

Nothing about PDAL is assumed: stages and options are asked of the library that is there (2.2 to 2.10).
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.errors import MissingPartError
from mtpcr_geo.pipeline.pdal.switches import Access, held_to, keep_plugins_home

INSTALL = (
    "install PDAL and its Python package: conda install -c conda-forge python-pdal (all systems), "
    "apk add py3-pdal (Alpine), port install py-pdal (MacPorts), or use the container pdal/pdal; "
    "Debian and Ubuntu have no package"
)
# what no cloud has: a stage behind all others that always stops PDAL between preparing and running
_STOP_DIMENSION = "MtpcrStopHere"
_STOP = {"type": "filters.range", "limits": f"{_STOP_DIMENSION}[0:1]", "tag": "mtpcr_stop_here"}
_ERRORS = (RuntimeError, ValueError, TypeError)
_SETTLE_S = 0.01


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
    load()
    # the package does not keep its extension module as an attribute
    library = importlib.import_module("pdal.libpdalpython")
    options = library.getOptions()
    return {
        driver["name"]: Driver(
            driver["name"],
            driver.get("description", ""),
            {option["name"]: option.get("description", "") for option in options.get(driver["name"]) or ()},
            bool(driver.get("streamable")),
        )
        for driver in library.getDrivers()
    }


def load() -> Any:
    """Import the `pdal` package; it loads PDAL's plugins, but none from the current folder.

    Raises:
        MissingPartError: saying how to install it.

    """
    keep_plugins_home()
    try:
        import pdal
    except ImportError as error:
        raise MissingPartError(f"the package pdal does not load ({error}); {INSTALL}") from error
    return pdal


def pipeline(stages: Sequence[Mapping[str, Any]]) -> Any:
    """Make a `pdal.Pipeline` of stages, without running it."""
    return load().Pipeline(json.dumps(list(stages)))


def arrays_of(iterator: Any) -> Iterator[NDArray[np.void]]:
    """Yield the arrays of python-pdal's streaming iterator, without being caught in its end.

    Its worker thread marks the end (``PythonPointTable::done``, up to 3.5.5 at least) without the lock
    under which its consumer looks for the mark: who looks in that very moment misses it and waits for
    ever, some once in a thousand streams whose consumer asks at once. Nothing in Python shows whether
    another array will come, and a wait inside PDAL cannot be ended; but the mark follows the last array
    by a fraction of a millisecond. So the next array is asked for no sooner than 10 ms after the last one
    came. What the caller does with an array takes that long where arrays are large, and then no time is
    lost.
    """
    for records in iterator:
        earliest = time.monotonic() + _SETTLE_S
        yield records
        time.sleep(max(0.0, earliest - time.monotonic()))


def problem_of(stages: Sequence[Mapping[str, Any]], access: Access) -> str | None:
    """Let PDAL prepare stages without running them, and return its first complaint, or None.

    Preparing reads the options and the headers of inputs; no point is read and no file is written.

    Args:
        stages: as PDAL's JSON has them.
        access: what the stages may do meanwhile.

    """
    try:
        with held_to(access):
            pipeline([*stages, _STOP]).execute()
    except _ERRORS as error:
        message = first_line(error)
        return None if _STOP_DIMENSION in message else message
    return None


def first_line(error: BaseException) -> str:
    """Return the first line of PDAL's message, without a full stop."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0].rstrip(". ")
