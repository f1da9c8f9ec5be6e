"""Cross-sections through both clouds: the points within a thin slab, seen from the side."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Image, Mask
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.export import drawing
from mtpcr_geo.export.report.rasters import structure

_LENGTH_SPACINGS = 400.0
_SLAB_SPACINGS = 2.5
_EXAGGERATIONS = (1, 2, 3, 5, 10, 20)
_LOWEST_ASPECT, _HIGHEST_ASPECT = 0.12, 0.3
_WIDTH_PX = 1800
_RADIUS_PX = 2.6
_MOST_POINTS = 60_000
_FEWEST_POINTS = 30
_SEED = 0


@dataclass(frozen=True, eq=False)
class Section:
    """Points of both clouds within a slab that stands on a line.

    Attributes:
        name: "along" or "across" the overlap.
        start, end: (2,) ends of the line, levelled target coordinates, metres.
        thickness_m: of the slab.
        source, target: (n, 2) and (m, 2) distance along the line and height, metres; the source as
            registered.
        low_m, high_m: heights that are shown.
        exaggeration: times that heights are stretched against distances.

    """

    name: str
    start: Floats
    end: Floats
    thickness_m: float
    source: Floats
    target: Floats
    low_m: float
    high_m: float
    exaggeration: int

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.hypot(*(self.end - self.start)))


def sections_of(pair: Pair, source: Bev, target: Bev) -> list[Section]:
    """Cut both clouds along and across their overlap, where it tells most whether they fit.

    The length and thickness of a slab follow from the spacing of the sparser cloud's points.

    Args:
        pair: with a transform.
        source, target: rasters on one grid, levelled target coordinates.

    Returns:
        At most two; none where nothing overlaps, or where too few points lie in a slab.

    """
    assert pair.T_target_source is not None
    weight = structure(source, target)
    both = weight > 0
    if np.count_nonzero(both) < _FEWEST_POINTS:
        return []
    clouds = (
        transforms.apply(pair.target.T_level_work @ pair.T_target_source, pair.source.sample),
        pair.target.levelled_sample,
    )
    spacing = max(_spacing(xyz, source, both) for xyz in clouds)
    if not np.isfinite(spacing):
        return []
    row, column = np.nonzero(both)
    xy = source.grid.to_metres(np.column_stack([column, row]).astype(np.float64))
    middle = xy.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((xy - middle).T))
    main = axes[:, 1] * (1.0 if axes[0, 1] >= 0 else -1.0)
    found = []
    for name, direction in (("along", main), ("across", np.array([main[1], -main[0]]))):
        direction = direction * (1.0 if direction[0] >= 0 else -1.0)
        start, end = _line(xy - middle, weight[both], direction, source.grid.cell, _LENGTH_SPACINGS * spacing)
        section = _cut(name, middle + start, middle + end, _SLAB_SPACINGS * spacing, clouds)
        if section is not None:
            found.append(section)
    return found


def picture_of(section: Section) -> drawing.Picture:
    """Draw a section's points, (h, w, 4) RGBA with nothing behind them; neither cloud hides the other."""
    scale = _WIDTH_PX / section.length_m
    height = max(round((section.high_m - section.low_m) * scale * section.exaggeration), 60)
    rng = np.random.default_rng(_SEED)
    points = np.concatenate([section.target, section.source])
    colour = np.repeat(
        np.array([drawing.TARGET_RGB, drawing.SOURCE_RGB], np.uint8),
        [len(section.target), len(section.source)],
        axis=0,
    )
    order = rng.permutation(len(points))
    points, colour = points[order], colour[order]
    x = points[:, 0] * scale
    y = (section.high_m - points[:, 1]) * scale * section.exaggeration
    # few points are drawn larger, so that lines show
    radius = _RADIUS_PX * float(np.clip(math.sqrt(6000.0 / max(len(points), 1)), 0.6, 1.6))
    picture = np.zeros((height, _WIDTH_PX, 4), np.uint8)
    for px, py, rgb in zip(np.rint(x * 8), np.rint(y * 8), colour, strict=True):
        ink = (*(int(part) for part in rgb), 255)
        cv2.circle(picture, (int(px), int(py)), round(radius * 8), ink, -1, cv2.LINE_AA, 3)
    return picture


def _spacing(xyz: Floats, bev: Bev, both: Mask) -> float:
    """Return the mean distance between neighbouring points of a cloud in the overlap, metres."""
    grid = bev.grid
    column, row = grid.cells(xyz)
    inside = grid.holds(column, row)
    number = int(both[row[inside], column[inside]].sum())
    return math.sqrt(np.count_nonzero(both) * grid.cell**2 / number) if number else math.inf


def _line(xy: Floats, weight: Image, direction: Floats, cell: float, length: float) -> tuple[Floats, Floats]:
    """Return the ends of the line of one direction and a length at most along which the weights sum to most.

    Args:
        xy: (n, 2) cells, metres.
        weight: (n,) of each.
        direction: (2,) unit vector.
        cell: edge of a cell, metres.
        length: metres.

    """
    normal = np.array([-direction[1], direction[0]])
    s, t = xy @ direction, xy @ normal
    low_s, low_t = s.min(), t.min()
    column = np.floor((s - low_s) / cell).astype(np.int64)
    row = np.floor((t - low_t) / (2.0 * cell)).astype(np.int64)
    table = np.zeros((int(row.max()) + 1, int(column.max()) + 1))
    np.add.at(table, (row, column), weight)
    size = int(np.clip(round(length / cell), 1, table.shape[1]))
    sums = np.cumsum(np.pad(table, ((0, 0), (1, 0))), axis=1)
    total = sums[:, size:] - sums[:, :-size]
    best_row, best = (int(k) for k in np.unravel_index(int(total.argmax()), total.shape))
    across = (low_t + (best_row + 0.5) * 2.0 * cell) * normal
    first = low_s + best * cell
    return first * direction + across, (first + size * cell) * direction + across


def _cut(
    name: str, start: Floats, end: Floats, thickness: float, clouds: tuple[Floats, Floats]
) -> Section | None:
    """Return the points of both clouds within a slab, and the heights that show them; None where few are."""
    length = float(np.hypot(*(end - start)))
    direction = (end - start) / max(length, 1e-9)
    parts = []
    for xyz in clouds:
        off = xyz[:, :2] - start
        s, t = off @ direction, off @ np.array([-direction[1], direction[0]])
        inside = (np.abs(t) <= thickness / 2) & (s >= 0) & (s <= length)
        part = np.column_stack([s, xyz[:, 2]])[inside]
        if len(part) < _FEWEST_POINTS:
            return None
        step = max(1, -(-len(part) // _MOST_POINTS))
        parts.append(part[::step])
    heights = [np.percentile(part[:, 1], [0.2, 99.8]) for part in parts]
    low = float(min(pair[0] for pair in heights))
    high = float(max(pair[1] for pair in heights))
    margin = 0.06 * max(high - low, 0.01 * length)
    low, high = low - margin, high + margin
    aspect = (high - low) / length
    stretch = next((k for k in _EXAGGERATIONS if k * aspect >= _LOWEST_ASPECT), _EXAGGERATIONS[-1])
    if stretch * aspect > _HIGHEST_ASPECT:  # a tower or a tall wood on a short line: its foot tells most
        high = low + _HIGHEST_ASPECT / stretch * length
    return Section(name, start, end, thickness, parts[0], parts[1], low, high, stretch)
