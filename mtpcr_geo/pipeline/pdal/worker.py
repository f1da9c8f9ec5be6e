"""The process in which PDAL runs: a crash of PDAL's ends this process, and not the one that asked it.

Requests come as lines of JSON on standard input, answers go as lines of JSON to what was standard output,
the bytes of each array behind its line. The process ends with its standard input, whatever PDAL is doing,
and when nothing is asked for a while.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

_IDLE_S = 60.0
_SETTLE_S = 0.01
# Python's forms of PDAL's own exceptions
_PDAL_SAYS = (RuntimeError, ValueError, TypeError)


def main() -> None:
    """Answer requests until standard input ends, or none comes for a minute."""
    _keep_quiet()
    answers = _own_output()
    requests: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    while True:
        try:
            request = json.loads(requests.get(timeout=_IDLE_S))
        except queue.Empty:
            return
        try:
            _answer(request, answers)
        except _PDAL_SAYS as error:
            _say(answers, problem="pdal", text=str(error) or type(error).__name__)
        except MemoryError:
            _say(answers, problem="memory", text="")
        except ImportError as error:
            _say(answers, problem="missing", text=str(error))


def _keep_quiet() -> None:
    """Leave interruptions to the process that asked, and no core file behind a crash."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def _own_output() -> BinaryIO:
    """Return standard output for answers alone: what else writes to it goes to standard error."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return answers


def _listen(requests: queue.SimpleQueue[str]) -> None:
    for line in sys.stdin:
        requests.put(line)
    # nobody is there any more
    os._exit(0)


def _answer(request: Mapping[str, Any], answers: BinaryIO) -> None:
    from pdal import Pipeline  # loads PDAL

    def made(stages: Sequence[Mapping[str, Any]]) -> Any:
        return Pipeline(json.dumps(list(stages)))

    facts: dict[str, Any] = {}
    if request["do"] == "drivers":
        facts = {"drivers": _drivers()}
    elif request["do"] == "execute":
        pipeline = made(request["stages"])
        pipeline.execute()
        facts = {"crs": pipeline.srswkt2 if request["crs"] else ""}
    else:
        pipeline = made(request["stages"])
        if pipeline.streamable:
            _say(answers, streamed=True)
            iterator = pipeline.iterator(chunk_size=request["size"], prefetch=1)
            for records in _arrays_of(iterator):
                _hand_over(answers, records)
            facts = {"metadata": iterator.metadata}
        else:
            _say(answers, streamed=False)
            pipeline = made(request["whole"])
            pipeline.execute()
            for records in pipeline.arrays:
                _hand_over(answers, records)
            facts = {"metadata": pipeline.metadata, "crs": pipeline.srswkt2 if request["crs"] else ""}
    _say(answers, done=facts)


def _drivers() -> list[dict[str, Any]]:
    """Return every stage of this PDAL with its options."""
    # the package does not keep its extension module as an attribute
    from pdal import libpdalpython

    options = libpdalpython.getOptions()
    return [
        {
            "name": driver["name"],
            "description": driver.get("description", ""),
            "options": {
                option["name"]: option.get("description", "") for option in options.get(driver["name"]) or ()
            },
            "streamable": bool(driver.get("streamable")),
        }
        for driver in libpdalpython.getDrivers()
    ]


def _arrays_of(iterator: Any) -> Iterator[NDArray[np.void]]:
    """Yield the arrays of python-pdal's streaming iterator, without being caught in its end.

    Its worker thread marks the end (``PythonPointTable::done``, up to 3.5.5 at least) without the lock
    under which its consumer looks for the mark: who looks in that very moment misses it and waits for
    ever, some once in a thousand streams whose consumer asks at once. Nothing in Python shows whether
    another array will come, and a wait inside PDAL cannot be ended; but the mark follows the last array
    by a fraction of a millisecond. So the next array is asked for no sooner than 10 ms after the last one
    came. What is done with an array takes that long where arrays are large, and then no time is lost.
    """
    for records in iterator:
        earliest = time.monotonic() + _SETTLE_S
        yield records
        time.sleep(max(0.0, earliest - time.monotonic()))


def _say(answers: BinaryIO, **fields: Any) -> None:
    answers.write(json.dumps(fields).encode() + b"\n")
    answers.flush()


def _hand_over(answers: BinaryIO, records: NDArray[np.void]) -> None:
    """Write an array: its type and length in a line, then its bytes."""
    whole = np.ascontiguousarray(records)
    answers.write(json.dumps({"array": whole.dtype.descr, "length": len(whole)}).encode() + b"\n")
    answers.write(whole.view(np.uint8).reshape(-1).data)
    answers.flush()


if __name__ == "__main__":
    main()
