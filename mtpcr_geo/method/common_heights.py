"""At how many heights both clouds have points in the same columns, and at how many were one of them raised.

The height of a fit rests on the ground, which is one point in each cell: where points below the ground
(multipath, mirror images in wet streets) hide it from one cloud, its lowest points lie metres too deep, and
tie points and ground agree on that. All points together do not: walls, crowns and roofs of the same place
fill the same heights of the same columns at one height only.

Not so inside buildings: raised by a storey a floor meets a ceiling, or a ceiling the roof. So all points are
asked only where the lowest ones of a cloud are no ground: where they lie up and down from column to column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.types import Pair
from mtpcr_geo.method.bev import fitting_cell
from mtpcr_geo.method.scales import tolerance_for
from mtpcr_geo.method.upright import points_near, seen_upright

MOST_POINTS = 500_000
"""Points of each cloud that are looked at, evenly chosen."""
MOST_AREA_COLUMNS = 250_000
"""Columns over the area that both clouds may share; instead of more of them they are made wider."""
MOST_COLUMNS = 4_000
MOST_BINS = 4_000_000
"""Columns, and columns times heights, that are looked at: shared columns are evenly chosen."""
FEWEST_COLUMNS = 30
COLUMN_CELLS = 2.0
"""Edge of a column in cells of the rasters, which hold a few points each."""
ROUGH = 0.3
"""Share of columns whose lowest point lies more than a bin above or below those around it, from which on the
lowest points of a cloud are no ground. Of eight real pairs it is 0.18 at most, of a pine plot 0.33; with a
twentieth of the points mirrored below the ground, 0.36 to 0.82 in clouds of 5 points/m² and more."""
FEWEST_AROUND = 5
BESIDE_BINS = 3
"""Bins from which on another height is another one, and not the same a little off."""


@dataclass(frozen=True)
class CommonHeights:
    """How many heights both clouds fill in the same columns, over how far one of them is raised.

    Attributes:
        rise_m: (k,) metres by which the source is raised, ascending; one of them is 0.
        filled: (k,) bins of height that both fill, of a column, in the mean.
        columns: columns in which both have points.
        rough: share of these in which the lowest point of the cloud where it is more lies more than a bin
            above or below those around it.

    """

    rise_m: Floats
    filled: Floats
    columns: int
    rough: float

    @property
    def asked(self) -> bool:
        """Whether the lowest points of a cloud are so uneven that all points are asked for the height."""
        return self.rough >= ROUGH

    @property
    def here(self) -> float:
        """Heights that both fill as the clouds lie, or a bin above or below."""
        return float(self.filled[np.abs(self.rise_m) < 1.5 * self._bin_m].max())

    @property
    def elsewhere(self) -> tuple[float, float]:
        """The most heights that both would fill, were the source raised, over `here`; and raised by how much.

        Above 1 the clouds fit better at that height. Of nine real pairs it is 0.15 to 0.66.
        """
        beside = np.abs(self.rise_m) > (BESIDE_BINS + 0.5) * self._bin_m
        if not beside.any():
            return 0.0, 0.0
        best = int(np.argmax(np.where(beside, self.filled, -1.0)))
        return float(self.filled[best] / max(self.here, 1e-9)), float(self.rise_m[best])

    @property
    def _bin_m(self) -> float:
        return float(self.rise_m[1] - self.rise_m[0]) if len(self.rise_m) > 1 else 1.0


def common_heights_of(pair: Pair, T_target_source: Floats) -> CommonHeights | None:
    """Count the heights that both clouds of a pair fill in the same columns under a transform.

    Args:
        pair: levelled, with rasters.
        T_target_source: 4x4 between work coordinates.

    """
    seen = seen_upright(pair.with_(T_target_source=T_target_source, refinement=None))
    assert seen.T_target_source is not None
    moved = transforms.apply(seen.T_target_source, points_near(seen.source))
    cell = pair.cell
    return common_heights(moved, points_near(seen.target), COLUMN_CELLS * cell, tolerance_for(cell))


def common_heights(source: Floats, target: Floats, column_m: float, bin_m: float) -> CommonHeights | None:
    """Count the heights that both clouds fill in the same columns, for each rise of the source.

    Args:
        source, target: (n, 3) and (m, 3) metres in one frame, z up.
        column_m: edge of a column, metres: a few points of the sparser cloud should lie in each. Doubled over
            large areas.
        bin_m: bin of height, metres.

    Returns:
        None where both fill too few columns to tell.

    """
    (low_s, high_s), (low_t, high_t) = transforms.bounds(source), transforms.bounds(target)
    low, high = np.maximum(low_s, low_t)[:2], np.minimum(high_s, high_t)[:2]
    if (high <= low).any():
        return None
    column_m = fitting_cell(low, high, column_m, MOST_AREA_COLUMNS)
    shape = (np.floor((high - low) / column_m).astype(np.int64) + 1).tolist()
    floor = float(min(low_s[2], low_t[2]))
    cells = [_cells(xyz, low, shape, column_m) for xyz in (source, target)]
    bins = [np.floor((one[:, 2] - floor) / bin_m).astype(np.int64) for one, _ in cells]
    if min(len(one) for one in bins) == 0:
        return None
    shared = np.logical_and(*(_filled(column, shape) for _, column in cells))
    numbers = np.flatnonzero(shared)
    if len(numbers) < FEWEST_COLUMNS:
        return None
    lowest = min(int(one.min()) for one in bins)
    height = max(int(one.max()) for one in bins) - lowest + 1
    most = min(MOST_COLUMNS, max(MOST_BINS // height, FEWEST_COLUMNS))
    chosen = numbers[np.linspace(0, len(numbers) - 1, min(most, len(numbers))).astype(np.int64)]
    place = np.full(shape[0] * shape[1], -1)
    place[chosen] = np.arange(len(chosen))
    size = fft.next_fast_len(2 * height, real=True)
    spectra, rough = [], 0.0
    for (xyz, column), one in zip(cells, bins, strict=True):
        rough = max(rough, _roughness(xyz[:, 2], column, chosen, shape, bin_m))
        row = place[column]
        image = np.zeros((len(chosen), height), np.float32)
        image[row[row >= 0], one[row >= 0] - lowest] = 1.0
        spectra.append(fft.rfft(image, size, axis=1))
    product = np.einsum("ij,ij->j", np.conj(spectra[0]), spectra[1])
    counts = fft.irfft(product, size)
    filled = np.concatenate([counts[size - height + 1 :], counts[:height]]) / len(chosen)
    rise = np.arange(1 - height, height).astype(np.float64) * bin_m
    return CommonHeights(rise, filled.astype(np.float64), len(numbers), rough)


def _roughness(
    z: Floats, column: NDArray[np.int64], chosen: NDArray[np.int64], shape: list[int], bin_m: float
) -> float:
    """Return the share of chosen columns whose lowest point lies off the median of those around by a bin."""
    lowest = np.full((shape[0] + 2, shape[1] + 2), np.nan)
    filled = np.full(shape[0] * shape[1], np.inf)
    np.minimum.at(filled, column, z)
    lowest[1:-1, 1:-1] = np.where(np.isfinite(filled), filled, np.nan).reshape(shape)
    i, j = np.divmod(chosen, shape[1])
    steps = [(a, b) for a in (0, 1, 2) for b in (0, 1, 2) if (a, b) != (1, 1)]
    around = np.stack([lowest[i + a, j + b] for a, b in steps], axis=1)
    known = np.isfinite(around).sum(axis=1) >= FEWEST_AROUND
    if not known.any():
        return 0.0
    off = lowest[i + 1, j + 1][known] - np.nanmedian(around[known], axis=1)
    return float((np.abs(off) > bin_m).mean())


def _cells(xyz: Floats, low: Floats, shape: list[int], column_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """Return the points in the columns, evenly chosen, and the number of each one's column."""
    column, row = np.floor((xyz[:, :2] - low).T / column_m).astype(np.int64)
    inside = np.flatnonzero((column >= 0) & (row >= 0) & (column < shape[0]) & (row < shape[1]))
    inside = inside[:: max(1, -(-len(inside) // MOST_POINTS))]
    return np.asarray(xyz[inside]), column[inside] * shape[1] + row[inside]


def _filled(column: NDArray[np.int64], shape: list[int]) -> Mask:
    found = np.zeros(shape[0] * shape[1], bool)
    found[column] = True
    return found
