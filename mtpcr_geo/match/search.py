"""The global search: every yaw and every shift, by masked correlation in the frequency domain.

For each yaw the source channels are turned and correlated with the target's. The score of a shift is the
sum over both channels of the masked normalised correlation, times the square root of the cells that overlap:
a measure of how unlikely the agreement is by chance, comparable between small and large overlaps.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.match.pose import Pose, centre_of, warp_to
from mtpcr_geo.method.images import Channels

HEIGHT_FLOOR_M = 0.1
STEP_FLOOR = 0.02
"""Standard deviations below which an image shows nothing but noise: they bound the denominators."""
FILLED = 0.5
"""Share of a turned cell that must come from filled cells for it to count as filled."""
_SAME_YAW = 1e-9


@dataclass(frozen=True)
class Layer:
    """Channels on their grid: what is matched at one level of the pyramid."""

    grid: Grid
    channels: Channels


def correlation_score(
    overlap: Image,
    products: tuple[Image, Image],
    source_squares: tuple[Image, Image],
    target_squares: tuple[Image, Image],
    scratch: Image | None = None,
) -> Image:
    """Score from sums over the overlapping cells: sum of both normalised correlations times sqrt(overlap).

    Each correlation is at most 1 by Cauchy and Schwarz, since all three sums run over the same cells; the
    floors keep that true where rounding in the transform exceeds what little signal there is.

    Args:
        overlap: cells filled in both images.
        products: per channel, the sum of source times target.
        source_squares, target_squares: per channel, the sums of squares.
        scratch: (4, ...) float32 to work in, of which the first becomes the result; made if not given.

    """
    if scratch is None:
        scratch = np.empty((4, *overlap.shape), np.float32)
    total, cells, scale, least = scratch
    np.maximum(overlap, np.float32(1.0), out=cells)
    total.fill(0.0)
    for product, ss, tt, floor in zip(
        products, source_squares, target_squares, (HEIGHT_FLOOR_M, STEP_FLOOR), strict=True
    ):
        np.multiply(cells, np.float32(floor**2), out=least)
        np.maximum(ss, least, out=scale)
        scale *= np.maximum(tt, least, out=least)
        np.sqrt(scale, out=scale)
        np.divide(product, scale, out=scale)
        total += np.clip(scale, np.float32(-1.0), np.float32(1.0), out=scale)
    total *= np.sqrt(cells, out=cells)
    return np.asarray(total)


class _Room(threading.local):
    """Images that one thread works in: fresh memory for each yaw would take as long as what is done in it."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.spectra = np.empty((5, *shape), np.float32)
        self.product = np.empty(shape, np.float32)
        self.sums = np.empty((7, *shape), np.float32)
        self.scratch = np.empty((4, *shape), np.float32)


class GlobalSearch:
    """Correlates a source with a target under any yaw.

    Args:
        source, target: channels on grids of one cell size.
        min_overlap_cells: overlaps below this are not considered.
        workers: threads among which the yaws are shared; all cores if None. Results do not depend on it.

    """

    def __init__(
        self, source: Layer, target: Layer, min_overlap_cells: float, workers: int | None = None
    ) -> None:
        self.source = source
        self.target = target
        self.min_overlap = max(min_overlap_cells, 1.0)
        self.workers = workers or usable_cores()
        side = int(np.ceil(np.hypot(*source.grid.shape))) + 2
        self._turned_side = side
        height, width = target.grid.shape
        self._shape = (cv2.getOptimalDFTSize(height + side - 1), cv2.getOptimalDFTSize(width + side - 1))
        self._room = _Room(self._shape)
        self._target_spectra = [one.copy() for one in self._spectra(target.channels.stack)]
        self._room = _Room(self._shape)  # what this thread has used is let go of
        self._allowed: Callable[[float], NDArray[np.bool_]] | None = None

    def restrict(self, place: Callable[[float], tuple[float, float]], radius: float) -> None:
        """Consider only poses that put the source raster's centre near a place, which may depend on the yaw.

        Args:
            place: gives east and north of it for a yaw, metres.
            radius: how far from it, metres; a cell is added, by which poses lie apart.

        """
        rows, columns = (np.arange(n) for n in self._shape)
        height, width = self.target.grid.shape
        dy = np.where(rows < height, rows, rows - self._shape[0])
        dx = np.where(columns < width, columns, columns - self._shape[1])
        x, y = self._place(dx, dy)
        reach = radius + self.target.grid.cell

        def allowed(yaw: float) -> NDArray[np.bool_]:
            east, north = place(yaw)
            return np.asarray((x[None, :] - east) ** 2 + (y[:, None] - north) ** 2 <= reach**2)

        self._allowed = allowed

    def _place(self, dx: Any, dy: Any) -> tuple[Any, Any]:
        """Where a shift of the turned raster by (dx, dy) cells puts its centre, metres."""
        half, grid = self._turned_side / 2, self.target.grid
        return grid.west + (dx + half) * grid.cell, grid.north - (dy + half) * grid.cell

    def _spectra(self, stack: Image) -> list[Image]:
        """Transform height, steps, mask and the squares of the first two; packed as OpenCV packs them.

        They are lost with the next call by the same thread, as are the scores below.
        """
        images = (*stack, stack[0] ** 2, stack[1] ** 2)
        room = self._room
        return [
            spectrum(image, self._shape, out, room.product)
            for image, out in zip(images, room.spectra, strict=True)
        ]

    def _turned(self, yaw: float) -> tuple[Image, Grid]:
        """Turn the source about its centre onto a square grid large enough for any yaw."""
        grid = self.source.grid
        side, half = self._turned_side, self._turned_side * grid.cell / 2
        square = Grid(-half, half, grid.cell, side, side)
        stack = warp_to(self.source.channels.stack, grid, square, Pose(yaw, 0.0, 0.0))
        mask = (stack[2] > FILLED).astype(np.float32)
        return np.stack([stack[0] * mask, stack[1] * mask, mask]), square

    def scores(self, yaw: float) -> tuple[Image, Image]:
        """Score every shift under one yaw: scores and overlapping cells, both over cyclic shifts."""
        score, overlap = self._scores(yaw, self._spectra(self._turned(yaw)[0]))
        return score.copy(), overlap.copy()

    def _scores(self, yaw: float, spectra: list[Image], opposite: bool = False) -> tuple[Image, Image]:
        """Score every shift under one yaw.

        Args:
            yaw: the yaw, radians.
            spectra: of the source turned to it, or half a turn from it.
            opposite: whether it is half a turn from it: the image is then the same, both axes reversed, and
                its spectrum the conjugate but for a shift.

        """
        a, e, m, aa, ee = spectra
        A, E, M, AA, EE = self._target_spectra
        pairs = ((M, m), (A, a), (E, e), (M, aa), (M, ee), (AA, m), (EE, m))
        room = self._room
        for (t, s), image in zip(pairs, room.sums, strict=True):
            cv2.mulSpectrums(t, s, 0, room.product, conjB=not opposite)
            cv2.idft(room.product, image, cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
        overlap, pa, pe, sa, se, ta, te = room.sums
        score = correlation_score(overlap, (pa, pe), (sa, se), (ta, te), room.scratch)
        if opposite:
            back = (1 - self._turned_side, 1 - self._turned_side)
            score, overlap = (np.roll(image, back, axis=(0, 1)) for image in (score, overlap))
        left_out = overlap < self.min_overlap
        if self._allowed is not None:
            left_out |= ~self._allowed(yaw)
        np.putmask(score, left_out, -np.inf)
        return score, overlap

    def peaks(self, yaws: tuple[float, ...], count: int, apart_cells: int) -> list[Pose]:
        """Find the best shifts under a yaw, and under one half a turn from it, if there is a second.

        Args:
            yaws: one or two, radians.
            count: shifts of each at most.
            apart_cells: least distance of two of them, cells.

        """
        spectra = self._spectra(self._turned(yaws[0])[0])
        found: list[Pose] = []
        for number, yaw in enumerate(yaws):
            found += self._peaks(yaw, *self._scores(yaw, spectra, opposite=number == 1), count, apart_cells)
        return found

    def _peaks(self, yaw: float, score: Image, overlap: Image, count: int, apart_cells: int) -> list[Pose]:
        rows, columns = self._shape
        found = []
        for _ in range(count):
            row, column = np.unravel_index(int(np.argmax(score)), score.shape)
            if not np.isfinite(score[row, column]):
                break
            dy = row if row < self.target.grid.height else row - rows
            dx = column if column < self.target.grid.width else column - columns
            east, north = self._place(dx, dy)
            found.append(
                Pose(
                    yaw,
                    float(east),
                    float(north),
                    float(score[row, column]),
                    round(float(overlap[row, column])),
                )
            )
            near_rows = np.arange(row - apart_cells, row + apart_cells + 1) % rows
            near_columns = np.arange(column - apart_cells, column + apart_cells + 1) % columns
            score[np.ix_(near_rows, near_columns)] = -np.inf
        return found

    def run(
        self, yaws: Iterable[float], per_yaw: int, apart_cells: int, advance: Callable[[int], object]
    ) -> list[Pose]:
        """Search all yaws; best first. ``advance`` is called with the number of yaws as they are done."""
        poses: list[Pose] = []
        paired = pairs_of_opposite(yaws)
        with ThreadPoolExecutor(self.workers) as pool:
            found = pool.map(lambda yaws: self.peaks(yaws, per_yaw, apart_cells), paired)
            for these, of_these in zip(paired, found, strict=True):
                poses += of_these
                advance(len(these))
        return sorted(poses, key=lambda pose: -pose.score)


def all_yaws(step: float) -> Floats:
    """Return yaws round the circle, about ``step`` radians apart, each with its opposite."""
    count = 2 * max(1, round(np.pi / step))
    return np.asarray(np.arange(count) * (2 * np.pi / count), np.float64)


def pairs_of_opposite(yaws: Iterable[float]) -> list[tuple[float, ...]]:
    """Put yaws half a turn from each other together, each once, in their order; others stand alone."""
    left = list(yaws)
    paired: list[tuple[float, ...]] = []
    while left:
        one = left.pop(0)
        other = next((k for k, yaw in enumerate(left) if angle_between(yaw, one + np.pi) < _SAME_YAW), None)
        paired.append((one,) if other is None else (one, left.pop(other)))
    return paired


def spectrum(
    image: Image, shape: tuple[int, int], out: Image | None = None, padded: Image | None = None
) -> Image:
    """Return the transform of an image padded with zeros to a shape; packed as OpenCV packs it.

    Args:
        image: (h, w) float32.
        shape: of the transform.
        out: float32 of that shape to put it in; made if not given.
        padded: float32 of that shape to work in; made if not given.

    """
    if padded is None:
        padded = np.zeros(shape, np.float32)
    else:
        padded.fill(0.0)
    padded[: image.shape[0], : image.shape[1]] = image
    # not told of the rows of zeros, OpenCV takes a transform that is four times as fast
    return np.asarray(cv2.dft(padded, padded if out is None else out), np.float32)


def angle_between(a: float, b: float) -> float:
    """Absolute difference of two angles in radians, 0..pi."""
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def distinct(poses: Iterable[Pose], count: int, yaw_apart: float, metres_apart: float) -> list[Pose]:
    """Keep the best poses that truly differ, in the order given.

    Args:
        poses: candidates, best first.
        count: how many at most.
        yaw_apart: radians; poses closer in yaw and place are one hypothesis.
        metres_apart: distance of the source raster's centre, metres.

    """
    kept: list[Pose] = []
    for pose in poses:
        if all(
            angle_between(pose.yaw, other.yaw) > yaw_apart
            or np.hypot(pose.east - other.east, pose.north - other.north) > metres_apart
            for other in kept
        ):
            kept.append(pose)
            if len(kept) == count:
                break
    return kept


def pivot_of(layer: Layer) -> NDArray[np.float64]:
    """Pivot of poses of this source layer: the centre of its raster, (2,) metres."""
    return centre_of(layer.grid)
