"""A recording written by a process of its own, so that importing rerun does not hold up the run.

rerun takes longer to import than any stage of a small run, and Python runs one thread at a time. What the
stages made goes to the other process through a pipe, each value once: one pickler writes all of it, and
names what it has written before.
"""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import ArrayCloud, Cloud
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.types import Matches
from mtpcr_geo.export.recording.budget import Budget
from mtpcr_geo.export.recording.process import started

if TYPE_CHECKING:
    from pyproj import CRS


class RemoteWriter:
    """Does what `RecordingWriter` does, by a process of its own that ends with it. For one thread.

    Args:
        path: the `.rrd` to write.
        budget: how large the file may become.
        seed: of the thinning.

    Raises:
        OSError: if no process can be started.

    """

    def __init__(self, path: Path, budget: Budget, seed: int) -> None:
        self._path = path
        drawing = started()
        self._process, self._said = drawing.process, drawing.said
        assert self._process.stdin is not None
        self._pickler = _Pickler(self._process.stdin)
        self._say("open", budget, seed)

    def begin(self, properties: Mapping[str, Any]) -> None:
        """Send what holds for the whole run."""
        self._say("begin", dict(properties))

    def after(
        self, stage_type: str, tag: str, options: dict[str, Any], value: object, seconds: float
    ) -> None:
        """Send a finished stage and what it made."""
        self._say("after", stage_type, tag, options, value, seconds)

    def close(self) -> None:
        """Let the recording be finished, and write it.

        Raises:
            OutputError: if the process ended before that.
            Exception: what the writer there raised.

        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            with self._process.stdin, self._process.stdout as reply:
                self._say("close")
                self._process.stdin.flush()
                made = pickle.load(reply)
        except (OSError, EOFError, pickle.UnpicklingError) as error:
            raise OutputError(
                f"cannot write the recording {self._path}: the process that makes it ended with "
                f"{self._process.wait()}{self._last_words()}"
            ) from error
        finally:
            self._process.wait()
            self._said.close()
        if isinstance(made, Exception):
            raise made
        self._path.write_bytes(made)

    def _last_words(self) -> str:
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").split("\n")
        return next((f" ({line.strip()[:200]})" for line in reversed(lines) if line.strip()), "")

    def _say(self, *message: Any) -> None:
        assert self._process.stdin is not None
        try:
            self._pickler.dump(message)
            self._process.stdin.flush()
        except BrokenPipeError:
            # `close` says so
            return


def serve() -> None:
    """Make a recording of what comes by standard input, and give it by standard output. Ends with them."""
    commands = sys.stdin.buffer
    reply = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints is no part of the reply
    made: bytes | Exception = b""
    reader = pickle.Unpickler(commands)
    try:
        # before anything has come: this takes longest
        from mtpcr_geo.export.recording.writer import RecordingWriter

        writer: Any = None
        while True:
            name, *arguments = reader.load()
            if name == "open":
                writer = RecordingWriter(Path(), *arguments)
            elif name == "close":
                made = writer.finished()
                break
            else:
                getattr(writer, name)(*arguments)
    except EOFError:
        return  # the run is gone
    except BaseException as error:  # noqa: BLE001 - raised where the run waits; a panic of rerun is no Exception
        made = error if isinstance(error, Exception) else RuntimeError(f"{type(error).__name__}: {error!s}")
        _skip_to_end(reader)
    with reply:
        reply.write(_reply(made))


def _skip_to_end(reader: pickle.Unpickler) -> None:
    """Take what is still sent, so that the sender is not held up."""
    try:
        while reader.load()[0] != "close":
            pass
    except Exception:  # noqa: BLE001 - after an error in the middle of a message anything may come
        return


def _reply(made: bytes | Exception) -> bytes:
    try:
        return pickle.dumps(made)
    except Exception:  # noqa: BLE001 - an error may hold anything
        return pickle.dumps(RuntimeError(f"{type(made).__name__}: {made!s}"))


class _Pickler(pickle.Pickler):
    """Leaves out what a recording does not show, and what may not be pickled: points of files, matchers."""

    def __init__(self, stream: IO[bytes]) -> None:
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)

    def reducer_override(self, obj: Any) -> Any:
        """Say how clouds and matches are made again; all else as usual."""
        if isinstance(obj, Cloud):
            return _facts_of_cloud, (obj.name, obj.crs, obj.count, obj.minimum, obj.maximum)
        if isinstance(obj, Matches):
            return _matches, ({**vars(obj), "matcher": None},)
        return NotImplemented


def _facts_of_cloud(name: str, crs: CRS | None, count: int, minimum: Floats, maximum: Floats) -> Cloud:
    """Return a cloud without points that says the same of itself."""
    cloud = ArrayCloud(np.empty((0, 3)), crs, name)
    cloud.count, cloud.minimum, cloud.maximum = count, minimum, maximum
    return cloud


def _matches(fields: dict[str, Any]) -> Matches:
    return Matches(**fields)
