"""Decoded coordinates kept in a temporary file, so that a compressed cloud is decoded once for all passes."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from threading import Lock
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Mask

_WIDTH = 13  # three 32 bit integers, and whether the point is noise
_ROOM = 2  # times what is needed must be free


class KeptPoints:
    """The coordinates of a LAS cloud as its file has them, 32 bit integers, and which points are noise.

    Plain reads and writes, not a memory map: the pages of a map would count as this process's memory.

    Args:
        file: open for reading and writing; closed by `close`.
        scales, offsets: (3,) of the cloud.

    """

    def __init__(self, file: BinaryIO, scales: Floats, offsets: Floats) -> None:
        self._file = file
        self._scales, self._offsets = scales, offsets
        self._numbers: list[int] = []
        self._size = 0
        self._lock = Lock()

    @classmethod
    def for_cloud(cls, count: int, scales: Floats, offsets: Floats) -> KeptPoints | None:
        """Return an empty one in the folder of temporary files; None where there is no room for it."""
        try:
            if shutil.disk_usage(tempfile.gettempdir()).free < _ROOM * _WIDTH * count:
                return None
            file = tempfile.TemporaryFile(prefix="mtpcr-geo-")  # noqa: SIM115 - closed by `close`
        except OSError:
            return None
        return cls(file, np.asarray(scales, np.float64), np.asarray(offsets, np.float64))

    def holds(self, size: int) -> bool:
        """Return whether the whole cloud is there, in chunks of this size."""
        return bool(self._numbers) and self._size == size

    def keeper(self, size: int) -> Keeper | None:
        """Return what keeps a pass over the cloud in chunks of this size; None where one is kept already."""
        return None if self._numbers else Keeper(self, size)

    def chunks(self) -> Iterator[tuple[Floats, Mask]]:
        """Yield the coordinates (n, 3) and which points are noise (n,), as they were decoded, bit for bit."""
        place = 0
        for number in self._numbers:
            data = self._read(place, _WIDTH * number)
            place += len(data)
            steps = np.frombuffer(data, np.int32, 3 * number).reshape(3, number)
            noise = np.frombuffer(data, bool, number, offset=12 * number)
            yield placed(dict(zip("XYZ", steps, strict=True)), self._scales, self._offsets), noise

    def close(self) -> None:
        """Remove the file."""
        with self._lock:
            self._numbers = []
            self._file.close()

    def _read(self, place: int, length: int) -> bytes:
        # passes may run side by side
        with self._lock:
            self._file.seek(place)
            return self._file.read(length)

    def _write(self, place: int, column: NDArray[Any]) -> int:
        with self._lock:
            self._file.seek(place)
            return self._file.write(column.data.cast("B"))


class Keeper:
    """Keeps the chunks of one pass; what is not finished is not kept."""

    def __init__(self, kept: KeptPoints, size: int) -> None:
        self._kept, self._size = kept, size
        self._numbers: list[int] = []
        self._place = 0
        self._failed = False

    def add(self, records: NDArray[Any], noise: Mask) -> None:
        """Keep the X, Y and Z of packed records (n,), and which points are noise (n,)."""
        if self._failed:
            return
        try:
            for column in [*(np.ascontiguousarray(records[axis], np.int32) for axis in "XYZ"), noise]:
                self._place += self._kept._write(self._place, column)
        except (OSError, ValueError):
            # no room, or closed: the cloud is decoded again
            self._failed = True
        self._numbers.append(len(records))

    def finish(self) -> None:
        """Note that the pass is whole."""
        if not self._failed and not self._kept._numbers:
            self._kept._numbers, self._kept._size = self._numbers, self._size


def placed(steps: Any, scales: Floats, offsets: Floats) -> Floats:
    """Return (n, 3) float64 coordinates of the integers X, Y and Z of a LAS file."""
    xyz = np.empty((len(steps["X"]), 3))
    # scales and offsets of a broken header give what is not finite, which whoever takes the points refuses
    with np.errstate(all="ignore"):
        for axis, name in enumerate("XYZ"):
            np.multiply(steps[name], scales[axis], out=xyz[:, axis])
            xyz[:, axis] += offsets[axis]
    return xyz
