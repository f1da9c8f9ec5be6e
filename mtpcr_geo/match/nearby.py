"""Scores near a pose: of the pose itself and of all shifts within a window of it.

Only the part of the target under the source is compared, so that fine cells cost little.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mtpcr_geo.core.arrays import Image
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.pose import Pose, source_from_target_pixels, warp
from mtpcr_geo.match.search import FILLED, Layer, correlation_score, spectrum

FEW_CELLS = 4096
"""Cells of the source up to which the sums of all shifts are taken at once."""
SPECTRAL_WINDOW = 5
"""Shifts to either side from which a window is scored in the frequency domain."""


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
    # half of what the turned raster spans, in cells of the target, and where its centre lies
    c, s, ratio = abs(math.cos(pose.yaw)), abs(math.sin(pose.yaw)), source.cell / target.cell / 2
    across = ratio * (source.width * c + source.height * s)
    down = ratio * (source.width * s + source.height * c)
    column = (pose.east - target.west) / target.cell - 0.5
    row = (target.north - pose.north) / target.cell - 0.5
    column0 = min(max(math.floor(column - across) - margin, 0), target.width)
    row0 = min(max(math.floor(row - down) - margin, 0), target.height)
    column1 = min(max(math.ceil(column + across) + margin + 1, column0), target.width)
    row1 = min(max(math.ceil(row + down) + margin + 1, row0), target.height)
    part = target.part(slice(row0, row1), slice(column0, column1))
    return part, (row0, column0)
