"""The global search: every yaw and every shift, by masked correlation in the frequency domain.

For each yaw the source channels are turned and correlated with the target's. The score of a shift is the
sum over both channels of the masked normalised correlation, times the square root of the cells that overlap:
a measure of how unlikely the agreement is by chance, comparable between small and large overlaps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.match.pose import Pose, centre_of, source_from_target_pixels, warp, warp_to
from mtpcr_geo.method.images import Channels

HEIGHT_FLOOR_M = 0.1
STEP_FLOOR = 0.02
"""Standard deviations below which an image shows nothing but noise: they bound the denominators."""
FILLED = 0.5
"""Share of a turned cell that must come from filled cells for it to count as filled."""
_SAME_YAW = 1e-9
FEW_CELLS = 4096
"""Cells of the source up to which the sums of all shifts are taken at once."""
SPECTRAL_WINDOW = 5
"""Shifts to either side from which a window is scored in the frequency domain."""


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
) -> Image:
    """Score from sums over the overlapping cells: sum of both normalised correlations times sqrt(overlap).

    Each correlation is at most 1 by Cauchy and Schwarz, since all three sums run over the same cells; the
    floors keep that true where rounding in the transform exceeds what little signal there is.

    Args:
        overlap: cells filled in both images.
        products: per channel, the sum of source times target.
        source_squares, target_squares: per channel, the sums of squares.

    """
    cells = np.maximum(overlap, np.float32(1.0))
    total = np.zeros_like(cells)
    for product, ss, tt, floor in zip(
        products, source_squares, target_squares, (HEIGHT_FLOOR_M, STEP_FLOOR), strict=True
    ):
        least = cells * np.float32(floor**2)
        scale = np.maximum(ss, least)
        scale *= np.maximum(tt, least, out=least)
        np.sqrt(scale, out=scale)
        np.divide(product, scale, out=scale)
        total += np.clip(scale, -1.0, 1.0, out=scale)
    total *= np.sqrt(cells, out=cells)
    return np.asarray(total, np.float32)


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
        self._target_spectra = self._spectra(target.channels.stack)
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
        """Transform height, steps, mask and the squares of the first two; packed as OpenCV packs them."""
        return [spectrum(image, self._shape) for image in (*stack, stack[0] ** 2, stack[1] ** 2)]

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
        return self._scores(yaw, self._spectra(self._turned(yaw)[0]))

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
        overlap, pa, pe, sa, se, ta, te = (
            cv2.idft(cv2.mulSpectrums(t, s, 0, conjB=not opposite), flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
            for t, s in pairs
        )
        score = correlation_score(overlap, (pa, pe), (sa, se), (ta, te))
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


def spectrum(image: Image, shape: tuple[int, int]) -> Image:
    """Return the transform of an image padded with zeros to a shape; packed as OpenCV packs it."""
    padded = np.zeros(shape, np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    # not told of the rows of zeros, OpenCV takes a transform that is four times as fast
    return np.asarray(cv2.dft(padded, dst=padded), np.float32)


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


def score_nearby(
    source: Layer, target: Layer, pose: Pose, window: int, max_cells: float = np.inf
) -> tuple[Pose, Image]:
    """Score a pose and all shifts within ``window`` cells of it; give the best and the score window.

    Only the part of the target under the source is compared, so it costs little at fine cells.

    Args:
        source, target: layers of one cell size.
        pose: the pose.
        window: shifts up to so many cells are tried.
        max_cells: of larger parts only every n-th row is compared, for an estimate.

    """
    part, offset = target_under(source.grid, target.grid, pose, window)
    side = 2 * window + 1
    nothing = np.full((side, side), -np.inf, np.float32)
    if part.width <= 2 * window or part.height <= 2 * window:
        return Pose(pose.yaw, pose.east, pose.north, -np.inf, 0), nothing
    by_spectra = window >= SPECTRAL_WINDOW
    cells = (part.height - side + 1) * (part.width - side + 1)
    step = 1 if by_spectra else max(1, int(cells / max_cells))
    warped = _warp_rows(source, part, pose, window, step)
    mask = (warped[2] > FILLED).astype(np.float32)
    row0, column0 = offset
    stack = target.channels.stack[:, row0 : row0 + part.height, column0 : column0 + part.width]
    a, e = warped[0] * mask, warped[1] * mask
    if by_spectra:
        sums = _sums_by_spectra(a, e, mask, stack, window)
    elif mask.size <= FEW_CELLS:
        sums = _sums_of_few(a, e, mask, stack, window, step)
    else:
        sums = _sums_by_shifts(a, e, mask, stack, window, step)
    overlap = sums[0]
    score = correlation_score(overlap, (sums[1], sums[2]), (sums[3], sums[4]), (sums[5], sums[6]))
    best_dy, best_dx = divmod(int(np.argmax(score)), side)
    cell = target.grid.cell
    best = Pose(
        pose.yaw,
        pose.east + (best_dx - window) * cell,
        pose.north - (best_dy - window) * cell,
        float(score[best_dy, best_dx]),
        round(float(overlap[best_dy, best_dx])),
    )
    return best, score


def _sums_of_few(a: Image, e: Image, m: Image, stack: Image, window: int, step: int) -> Image:
    """Return the same as `_sums_by_shifts`, by a copy of the target's images for each shift.

    Of small images this takes a quarter of the time, of large ones more.
    """
    side = 2 * window + 1
    shape = (stack.shape[1] - side + 1, m.shape[1])
    shifted = sliding_window_view(stack, shape, axis=(1, 2))[:, :, :, ::step]
    A, E, M = np.ascontiguousarray(shifted).reshape(3, side**2, m.size)
    m, a, e = m.ravel(), a.ravel(), e.ravel()
    sums = np.empty((7, side**2), np.float32)
    sums[[0, 3, 4]] = np.stack([m, a * a, e * e]) @ M.T
    sums[1], sums[2] = A @ a, E @ e
    sums[5], sums[6] = (A * A) @ m, (E * E) @ m
    return np.asarray(sums.reshape(7, side, side) * np.float32(step))


def _sums_by_shifts(a: Image, e: Image, m: Image, stack: Image, window: int, step: int) -> Image:
    """Return the (7, n, n) sums that a score is made of, for each shift.

    The source's images hold every ``step``-th row of those under the target's. They are filled up with
    zeros to the length of the target's: a shift is then a place in the target's cells laid end to end, and
    none is copied for it.
    """
    columns = m.shape[1]
    side, width = 2 * window + 1, stack.shape[2]
    rows = stack.shape[1] - side + 1
    length = (len(m) - 1) * width + columns
    source = np.zeros((5, len(m), width), np.float32)
    for row, image in zip(source, (m, a, e, a * a, e * e), strict=True):
        row[:, :columns] = image
    m, a, e, aa, ee = source.reshape(5, -1)[:, :length]
    sums = np.empty((7, side, side), np.float32)
    for dy in range(side):
        A, E, M = np.ascontiguousarray(stack[:, dy : dy + rows : step]).reshape(3, -1)
        AA, EE = A * A, E * E
        for dx in range(side):
            at = slice(dx, dx + length)
            sums[:, dy, dx] = (
                m @ M[at],
                a @ A[at],
                e @ E[at],
                aa @ M[at],
                ee @ M[at],
                m @ AA[at],
                m @ EE[at],
            )
    return np.asarray(sums * np.float32(step))


def _warp_rows(source: Layer, part: Grid, pose: Pose, margin: int, step: int) -> Image:
    """Bring the source's channels onto every ``step``-th row of a part of a grid, without its rim."""
    M = source_from_target_pixels(source.grid, part, pose)
    M = np.column_stack([M[:, 0], step * M[:, 1], M[:, 2] + margin * (M[:, 0] + M[:, 1])])
    size = (part.width - 2 * margin, -(-(part.height - 2 * margin) // step))
    return warp(source.channels.stack, M, size)


def _sums_by_spectra(a: Image, e: Image, m: Image, stack: Image, window: int) -> Image:
    """Return the same sums from all rows, by the correlation theorem: cheaper where there are many shifts."""
    side = 2 * window + 1
    shape = (cv2.getOptimalDFTSize(stack.shape[1]), cv2.getOptimalDFTSize(stack.shape[2]))

    A, E, M = stack
    pairs = ((m, M), (a, A), (e, E), (a * a, M), (e * e, M), (m, A * A), (m, E * E))
    known: dict[int, Image] = {}
    sums = np.empty((7, side, side), np.float32)
    for number, (one, other) in enumerate(pairs):
        for image in (one, other):
            if id(image) not in known:
                known[id(image)] = spectrum(image, shape)
        product = cv2.mulSpectrums(known[id(other)], known[id(one)], 0, conjB=True)
        sums[number] = cv2.idft(product, flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)[:side, :side]
    # rounding leaves a trace where nothing overlaps
    sums[0] = np.round(sums[0])
    return sums


def target_under(source: Grid, target: Grid, pose: Pose, margin: int) -> tuple[Grid, tuple[int, int]]:
    """Cut from the target's grid what the posed source can reach, plus a margin of cells."""
    half_w, half_h = source.width * source.cell / 2, source.height * source.cell / 2
    corners = np.array([[-half_w, -half_h], [half_w, -half_h], [half_w, half_h], [-half_w, half_h]])
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    placed = corners @ np.array([[c, s], [-s, c]]) + [pose.east, pose.north]
    px = target.to_pixel(placed)
    column0 = int(np.clip(np.floor(px[:, 0].min()) - margin, 0, target.width))
    row0 = int(np.clip(np.floor(px[:, 1].min()) - margin, 0, target.height))
    column1 = int(np.clip(np.ceil(px[:, 0].max()) + margin + 1, column0, target.width))
    row1 = int(np.clip(np.ceil(px[:, 1].max()) + margin + 1, row0, target.height))
    part = target.part(slice(row0, row1), slice(column0, column1))
    return part, (row0, column0)


def pivot_of(layer: Layer) -> NDArray[np.float64]:
    """Pivot of poses of this source layer: the centre of its raster, (2,) metres."""
    return centre_of(layer.grid)
