"""Learned graphs through onnxruntime: sessions, and keypoint extractors that work in tiles."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Grey
from mtpcr_geo.core.errors import InputError, MissingPartError
from mtpcr_geo.match.base import DescribedPlaces, Features
from mtpcr_geo.match.learned.model_cards import ExtractorFile

Device = Literal["auto", "cpu", "cuda"]

OVERLAP_PX = 64
"""By how much tiles overlap: networks see some tens of pixels around a keypoint."""
LEAST_SHOWN = 0.1
"""Share of the pixels of a place that must not be empty, for its descriptor to count."""


@dataclass(frozen=True)
class Running:
    """How graphs are run.

    Attributes:
        device: "auto" takes CUDA where onnxruntime offers it.
        threads: on the processor; 0 leaves it to onnxruntime.

    """

    device: Device = "auto"
    threads: int = 0


class Graph:
    """One ONNX file, open, with its inputs and outputs called by the names of the contract.

    Args:
        path: the file.
        inputs, outputs: names of the contract that the graph must have.
        names: the graph's own names, where they differ.
        running: device and threads.

    Raises:
        InputError: if the file is no graph, or its inputs or outputs are named otherwise.
        MissingPartError: if CUDA is wanted and not offered.

    """

    def __init__(
        self,
        path: Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        names: dict[str, str],
        running: Running,
    ) -> None:
        import onnxruntime

        self.path = path
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = running.threads or _threads_allowed()
        # tiles of one shape come one after another; an arena would keep the largest of everything
        options.enable_cpu_mem_arena = False
        providers = _providers(onnxruntime.get_available_providers(), running.device)
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=providers)
        except Exception as error:  # onnxruntime's exceptions share no base but this
            if isinstance(error, MemoryError):
                raise
            raise InputError(f"{path} is no ONNX graph that onnxruntime can run: {_short(error)}") from error
        self._names = {name: names.get(name, name) for name in (*inputs, *outputs)}
        self._outputs = list(outputs)
        for kind, wanted, there in (
            ("input", inputs, [one.name for one in self._session.get_inputs()]),
            ("output", outputs, [one.name for one in self._session.get_outputs()]),
        ):
            for name in wanted:
                if self._names[name] not in there:
                    raise InputError(
                        f"{path} has no {kind} {self._names[name]!r} (it has {', '.join(there)}); "
                        "say in the model's description what it is called, under names"
                    )
            extra = set(there) - {self._names[name] for name in wanted} if kind == "input" else set()
            if extra:
                raise InputError(f"{path} wants inputs that nobody gives: {', '.join(sorted(extra))}")

    @property
    def device(self) -> str:
        """The device it runs on, as onnxruntime names it."""
        return str(self._session.get_providers()[0])

    def run(self, **inputs: NDArray[Any]) -> list[NDArray[Any]]:
        """Run the graph; outputs in the order they were named.

        Raises:
            InputError: if the graph fails on these inputs.

        """
        given = {self._names[name]: value for name, value in inputs.items()}
        try:
            return list(self._session.run([self._names[name] for name in self._outputs], given))
        except Exception as error:  # onnxruntime's exceptions share no base but this
            if isinstance(error, MemoryError):
                raise
            shapes = ", ".join(f"{name} {value.shape}" for name, value in inputs.items())
            raise InputError(f"{self.path} failed on {shapes}: {_short(error)}") from error


class OnnxExtractor:
    """Keypoints by a graph of the contract: image and max_keypoints in; keypoints, scores, descriptors out.

    Images larger than a tile are cut into overlapping tiles of one size, so that memory is that of a tile.

    Args:
        model: its description.
        path: its file.
        running: device and threads.
        tile: edge of the tiles, pixels; the description's if None.
        max_keypoints: kept of a whole image; the description's if None.

    """

    def __init__(
        self,
        model: ExtractorFile,
        path: Path,
        running: Running,
        *,
        tile: int | None = None,
        max_keypoints: int | None = None,
    ) -> None:
        self.model = model
        self.max_keypoints = max_keypoints or model.max_keypoints
        self.tile = _multiple(max(tile or model.tile, 2 * OVERLAP_PX), model.size_multiple)
        outputs = ("keypoints", "scores", "descriptors", *(["map"] if model.map_stride else []))
        self.graph = Graph(path, ("image", "max_keypoints"), outputs, model.names, running)

    def extract(self, image: Grey, empty: int = 0) -> Features:
        """Find keypoints in a (h, w) uint8 image, padded by ``empty``; descriptors are float32."""
        parts = [
            self._of_tile(image, empty, column, row, core)
            for column, row, core in tiles(image.shape, self.tile)
        ]
        px = np.concatenate([part.px for part in parts])
        score = np.concatenate([part.score for part in parts])
        order = np.lexsort((px[:, 1], px[:, 0], -score))[: self.max_keypoints]
        descriptors = np.concatenate([part.descriptors for part in parts])
        seen = [part.places for part in parts if part.places is not None]
        places = None
        if self.model.map_stride:
            places = DescribedPlaces(
                np.concatenate([np.empty((0, 2)), *(part.px for part in seen)]),
                np.concatenate([self._none().descriptors, *(part.descriptors for part in seen)]),
                float(self.model.map_stride),
            )
        return Features(px[order], score[order], descriptors[order], places)

    def _of_tile(
        self, image: Grey, empty: int, column: int, row: int, core: tuple[int, int, int, int]
    ) -> Features:
        part = image[row : row + self.tile, column : column + self.tile]
        if np.ptp(part) == 0:
            return self._none()
        # networks take time by area, and turned images have empty corners
        top, left, bottom, right = filled(part, empty, OVERLAP_PX // 2)
        part = part[top:bottom, left:right]
        column, row = column + left, row + top
        height, width = part.shape
        padded = np.full(
            (_multiple(height, self.model.size_multiple), _multiple(width, self.model.size_multiple)),
            empty,
            np.uint8,
        )
        padded[:height, :width] = part
        wanted = min(self.max_keypoints, padded.size)
        px, score, descriptors, *maps = self.graph.run(
            image=as_input(padded, self.model.channels, self.model.mean, self.model.std),
            max_keypoints=np.array([wanted], np.int64),
        )
        px, score, descriptors = self._checked(px, score, descriptors)
        west, north, east, south = core
        x, y = px[:, 0] + column, px[:, 1] + row
        keep = score > self.model.score_threshold
        keep &= (px[:, 0] <= width - 0.5) & (px[:, 1] <= height - 0.5) & np.isfinite(descriptors).all(axis=1)
        keep &= (x >= west - 0.5) & (x < east - 0.5) & (y >= north - 0.5) & (y < south - 0.5)
        places = self._places(maps[0], padded, empty) if maps else None
        if places is not None:
            at = places.px + [column, row]
            own = (at >= [west - 0.5, north - 0.5]).all(axis=1) & (at < [east - 0.5, south - 0.5]).all(axis=1)
            places = DescribedPlaces(at[own], places.descriptors[own], places.step_px)
        return Features(np.column_stack([x, y])[keep], score[keep], descriptors[keep], places)

    def _places(self, described: NDArray[Any], image: Grey, empty: int) -> DescribedPlaces:
        """Take the places of a map under which the image shows something, in pixels of the image."""
        step = self.model.map_stride
        rows, columns = image.shape[0] // step, image.shape[1] // step
        if described.shape != (1, self.model.descriptor_dim, rows, columns):
            raise InputError(
                f"{self.graph.path} gives a map {described.shape}; wanted is "
                f"(1, {self.model.descriptor_dim}, {rows}, {columns})"
            )
        shown = (image != empty)[: rows * step, : columns * step].reshape(rows, step, columns, step)
        row, column = np.nonzero(shown.mean(axis=(1, 3)) > LEAST_SHOWN)
        px = np.stack([column, row], axis=1).astype(np.float64) * step + (step - 1) / 2
        return DescribedPlaces(px, described[0][:, row, column].T.astype(np.float32), float(step))

    def _checked(
        self, px: NDArray[Any], score: NDArray[Any], descriptors: NDArray[Any]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        n = score.shape[-1] if score.ndim else 0
        dim = self.model.descriptor_dim
        if px.shape != (1, n, 2) or score.shape != (1, n) or descriptors.shape != (1, n, dim):
            raise InputError(
                f"{self.graph.path} gives keypoints {px.shape}, scores {score.shape} and descriptors "
                f"{descriptors.shape}; wanted are (1, K, 2), (1, K) and (1, K, {dim})"
            )
        return px[0].astype(np.float64), score[0].astype(np.float32), descriptors[0].astype(np.float32)

    def _none(self) -> Features:
        dim = self.model.descriptor_dim
        return Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, dim), np.float32))


def _threads_allowed() -> int:
    """Return onnxruntime's number of threads: its own choice, or fewer where the process may use fewer cores.

    It counts the machine's cores; more threads than it may use spin in each other's way.
    """
    if not hasattr(os, "sched_getaffinity"):
        return 0
    allowed = len(os.sched_getaffinity(0))
    return allowed if allowed < (os.cpu_count() or 1) else 0


def filled(image: Grey, empty: int, margin: int) -> tuple[int, int, int, int]:
    """Return the (top, left, bottom, right) of what is not empty, with a margin; bottom and right excluded.

    Args:
        image: (h, w) uint8, not all of it empty.
        empty: grey value of empty cells.
        margin: pixels of emptiness kept around, where there are so many.

    """
    there = image != empty
    rows, columns = (np.flatnonzero(there.any(axis=axis)) for axis in (1, 0))
    return (
        max(int(rows[0]) - margin, 0),
        max(int(columns[0]) - margin, 0),
        min(int(rows[-1]) + 1 + margin, image.shape[0]),
        min(int(columns[-1]) + 1 + margin, image.shape[1]),
    )


def tiles(
    shape: tuple[int, ...], tile: int, overlap: int = OVERLAP_PX
) -> list[tuple[int, int, tuple[int, int, int, int]]]:
    """Cut an image into tiles: their first column and row, and the core that is theirs alone.

    Args:
        shape: (h, w) of the image.
        tile: edge of a tile, pixels.
        overlap: by how much neighbours overlap, pixels.

    Returns:
        A (column, row, (west, north, east, south)) each; cores cover the image once, east and south excluded.

    """
    height, width = shape
    columns, rows = _starts(width, tile, overlap), _starts(height, tile, overlap)
    return [
        (column, row, (west, north, east, south))
        for row, (north, south) in zip(rows, _cores(rows, tile, height), strict=True)
        for column, (west, east) in zip(columns, _cores(columns, tile, width), strict=True)
    ]


def _starts(size: int, tile: int, overlap: int) -> list[int]:
    if size <= tile:
        return [0]
    count = -(-(size - overlap) // (tile - overlap))
    return [round(k * (size - tile) / (count - 1)) for k in range(count)]


def _cores(starts: list[int], tile: int, size: int) -> Iterable[tuple[int, int]]:
    # neighbours meet in the middle of their overlap
    meets = [(a + tile + b) // 2 for a, b in pairwise(starts)]
    return list(zip([0, *meets], [*meets, size], strict=True))


def as_input(image: Grey, channels: int, mean: float, std: float) -> NDArray[np.float32]:
    """Return a (h, w) uint8 image as (1, channels, h, w) float32: ``(grey / 255 - mean) / std``."""
    value = (image.astype(np.float32) / 255 - np.float32(mean)) / np.float32(std)
    return np.repeat(value[None, None], channels, axis=1)


def _multiple(size: int, of: int) -> int:
    return max(-(-size // of), 1) * of


def _providers(offered: Sequence[str], device: Device) -> list[str]:
    cuda = "CUDAExecutionProvider"
    if device == "cuda" and cuda not in offered:
        raise MissingPartError(
            "this onnxruntime offers no CUDA; install onnxruntime-gpu, or leave device at auto or cpu"
        )
    return [cuda, "CPUExecutionProvider"] if cuda in offered and device != "cpu" else ["CPUExecutionProvider"]


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else text[:197] + "..."
