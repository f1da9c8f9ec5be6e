"""The pictures of a report: both clouds over each other, before and after, their differences, patches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Image, Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.export import drawing
from mtpcr_geo.export.report.rasters import (
    Window,
    closed,
    closed_mask,
    even,
    joined_cells,
    smooth_larger,
    structure,
    telling_window,
    windows_of,
)
from mtpcr_geo.export.resample import cut_to, grid_around, placed, snapped, warp_bev
from mtpcr_geo.method.bev import coarsen
from mtpcr_geo.method.overlap import CommonGround, overlap_of
from mtpcr_geo.method.scales import ground_cell_for
from mtpcr_geo.method.upright import points_near, seen_upright

_ZOOM_PX = 760
_PATCH_PX = 420
_WIDE_PX = 900
_ALONE = 0.35
_LEAST_BLOCKS = 12
_FEWEST_CELLS = 12
_SOME = 20_000
STATED_M = 0.5
"""Height difference up to which cells of ground agree, as the check has it."""


@dataclass(frozen=True)
class Patch:
    """A square of the overlap and how well heights agree in it.

    Attributes:
        name: "best", "median" or "worst".
        window: of the common grid.
        off_m: median of the absolute differences of the lowest heights in it.

    """

    name: str
    window: Window
    off_m: float


@dataclass(frozen=True, eq=False)
class Overlay:
    """Both clouds on one grid where they overlap, in levelled coordinates of the target.

    Attributes:
        pair: with rasters and a transform.

    """

    pair: Pair

    @cached_property
    def rasters(self) -> tuple[Bev, Bev]:
        """Source and target where they overlap, of one grid, cells joined until most are filled."""
        source, target = drawing.common_rasters(self.pair)
        factor = max(joined_cells(bev) for bev in (source, target))
        return coarsen(source, factor), coarsen(target, factor)

    @property
    def cell(self) -> float:
        """Edge of a cell, metres."""
        return self.rasters[0].grid.cell

    @cached_property
    def shared(self) -> Mask:
        """Cells that both fill, small gaps closed, (h, w)."""
        source, target = self.rasters
        return closed_mask(np.isfinite(source.top)) & closed_mask(np.isfinite(target.top))

    @cached_property
    def tops(self) -> tuple[Image, Image]:
        """Highest heights of both with small gaps closed, and noise evened out where many cells are empty."""
        source, target = self.rasters
        return even(source.top), even(target.top)

    @cached_property
    def difference(self) -> Image:
        """Lowest height of the source over that of the target, (h, w) metres, NaN where not both fill."""
        source, target = self.rasters
        return np.asarray(source.low - target.low)

    @cached_property
    def ground(self) -> CommonGround:
        """The ground that both see, as the checks compare it."""
        seen = seen_upright(self.pair)
        assert seen.T_target_source is not None
        moved = transforms.apply(seen.T_target_source, points_near(seen.source))
        return overlap_of(moved, points_near(seen.target), ground_cell_for(seen.cell)).common_ground()

    @cached_property
    def box(self) -> Window:
        """The part of the grid that holds all that both see, and a little around it."""
        rows, columns = np.flatnonzero(self.shared.any(axis=1)), np.flatnonzero(self.shared.any(axis=0))
        around = max(1, round(0.03 * max(np.ptp(rows), np.ptp(columns))))
        return Window(
            *(
                slice(max(int(part[0]) - around, 0), min(int(part[-1]) + 1 + around, size))
                for part, size in zip((rows, columns), self.shared.shape, strict=True)
            )
        )

    @cached_property
    def window(self) -> Window:
        """The part in which one sees best whether both fit."""
        return telling_window(*self.rasters)

    def zoom(self, window: Window | None = None, side: int = _ZOOM_PX) -> tuple[drawing.Picture, float]:
        """Return a part of the overlap with both clouds' heights, and the metres of a pixel."""
        window = window or self.window
        tops = [top[window.rows, window.columns] for top in self.tops]
        factor = max(1, side // max(tops[0].shape))
        source, target = (smooth_larger(top, factor) for top in tops)
        return heights_of_both(source, target), self.cell / factor

    def patches(self) -> list[Patch]:
        """Return the best, the median and the worst of the overlap's squares in which something stands."""
        source, target = self.rasters
        count = np.count_nonzero(self.shared)
        if not count:
            return []
        side = int(np.clip(np.sqrt(count / _LEAST_BLOCKS) * 0.7, 8, 48))
        windows = windows_of(self.shared, structure(source, target), side)
        if len(windows) < 3:
            return []
        found = []
        for window in windows:
            off = np.abs(self.difference[window.rows, window.columns])
            off = off[np.isfinite(off)]
            if len(off) >= _FEWEST_CELLS:
                found.append((float(np.median(off)), window))
        found.sort(key=lambda one: one[0])
        if len(found) < 3:
            return []
        names = (("best", 0), ("median", len(found) // 2), ("worst", len(found) - 1))
        return [Patch(name, found[k][1], found[k][0]) for name, k in names]


def heights_of_both(source: Image, target: Image) -> drawing.Picture:
    """Return heights of both as (h, w, 4) RGBA, in two colours that add up to grey where they are equal.

    A plane is taken off both. Where one of them alone is seen, it is dim and nearly grey.

    Args:
        source, target: (h, w) metres, NaN where empty.

    """
    low, high, plane = _stretch(source, target)
    seen = [np.isfinite(top) for top in (source, target)]
    scale = np.float32(0.88 / (high - low))
    light = [
        np.where(one, np.float32(0.12) + np.clip((top - plane - low) * scale, 0.0, np.float32(0.88)), 0.0)
        for one, top in zip(seen, (source, target), strict=True)
    ]
    orange = np.array(drawing.SOURCE_RGB, np.float64)
    orange *= 255.0 / orange.max()
    hues = orange, 255.0 - orange
    # what one of them alone sees says nothing of the fit
    alone = [one & ~other for one, other in (seen, seen[::-1])]
    out = np.empty((*source.shape, 4), np.uint8)
    for k in range(3):
        mixed = light[0] * np.float32(hues[0][k]) + light[1] * np.float32(hues[1][k])
        for one, hue, share in zip(alone, hues, light, strict=True):
            dim = np.float32(_ALONE * (0.75 * 255.0 + 0.25 * hue[k]))
            mixed = np.where(one, np.float32(20.0) + dim * share, mixed)
        out[..., k] = np.clip(mixed, 0, 255)
    out[..., 3] = np.where(seen[0] | seen[1], 255, 0)
    return out


def _stretch(source: Image, target: Image) -> tuple[float, float, Image]:
    """Return the least and greatest height that are told apart, and the plane from which they count."""
    both = np.isfinite(source) & np.isfinite(target)
    seen = np.flatnonzero(both if both.any() else np.isfinite(source) | np.isfinite(target))
    if not len(seen):
        return 0.0, 1.0, np.zeros(source.shape, np.float32)
    seen = seen[:: max(1, len(seen) // 20_000)]
    z = np.where(np.isfinite(target.flat[seen]), target.flat[seen], source.flat[seen]).astype(np.float64)
    row, column = np.divmod(seen, source.shape[1])
    A = np.column_stack([np.ones(len(z)), row, column])
    x: Floats = np.zeros(3)
    weight: Floats = np.ones(len(z))
    for _ in range(4):  # the ground, not what stands on it
        x = np.asarray(np.linalg.lstsq(A * weight[:, None], z * weight, rcond=None)[0])
        left = z - A @ x
        scale = max(1.4826 * float(np.median(np.abs(left))), 1e-3)
        weight = np.asarray(np.where(left > 0, 1.0 / (1.0 + (left / scale) ** 2), 1.0), np.float64)
    rows, columns = (np.arange(size) for size in source.shape)
    plane = (x[0] + x[1] * rows[:, None] + x[2] * columns).astype(np.float32)
    low, high = np.percentile(z - A @ x, [2.0, 98.0])
    return float(low), float(max(high, low + 0.5)), plane


def difference_colours(difference: Image, most: float) -> drawing.Picture:
    """Return signed differences as (h, w, 4) RGBA: blue below, red above, pale near 0, clear where NaN.

    Args:
        difference: (h, w) metres.
        most: metres at which the colours are full.

    """
    stops = np.array(
        [
            (33, 102, 172), (103, 169, 207), (209, 229, 240), (247, 247, 247),
            (253, 219, 199), (239, 138, 98), (178, 24, 43),
        ],
        np.float64,
    )  # fmt: skip  # ColorBrewer's RdBu, told apart by colour-blind readers
    place = np.clip(np.nan_to_num(difference) / most, -1.0, 1.0) * 3.0 + 3.0
    out = np.empty((*difference.shape, 4), np.uint8)
    for k in range(3):
        out[..., k] = np.rint(np.interp(place, np.arange(7), stops[:, k]))
    out[..., 3] = np.where(np.isfinite(difference), 255, 0)
    return out


def difference_limit(difference: Floats) -> float:
    """Return where colours are full: a round number of metres, six robust standard deviations at most."""
    known = np.abs(difference[np.isfinite(difference)])
    if not len(known):
        return 1.0
    return float(np.clip(drawing.round_number(6.0 * 1.4826 * float(np.median(known))), 0.1, 5.0))


@dataclass(frozen=True, eq=False)
class Swipe:
    """The source over the target before and after the registration, on one grid.

    Attributes:
        before, after: pictures of the same extent.
        cell: metres of a pixel.
        as_it_lay: whether before is where the source's own coordinates put it; else it is only turned as
            there, since the clouds share no frame or it lies too far away.

    """

    before: drawing.Picture
    after: drawing.Picture
    cell: float
    as_it_lay: bool


def before_and_after(pair: Pair) -> Swipe:
    """Draw the source over the target before and after the registration.

    Args:
        pair: with rasters and a transform.

    """
    source, target = pair.source.bev, pair.target.bev
    assert source is not None
    assert target is not None
    assert pair.T_target_source is not None
    after = pair.levelled(pair.T_target_source)
    before, as_it_lay = _pose_before(pair, after)
    source, target = (coarsen(bev, joined_cells(bev)) for bev in (source, target))
    # what is laid over each other has one cell
    cell = max(source.grid.cell, target.grid.cell)
    corners = np.array(
        [_ends(grid_around(source, T)) for T in (after, before)] + [_ends(target.grid)], np.float64
    )
    low, high = corners[:2, 0].min(axis=0), corners[:2, 1].max(axis=0)
    around = 0.08 * float((high - low).max())
    # of a large target only what lies around the source
    low = np.maximum(low - around, np.minimum(corners[2, 0], low))
    high = np.minimum(high + around, np.maximum(corners[2, 1], high))
    cell = max(cell, float((high - low).max()) / _WIDE_PX)
    width, height = (int(size) for size in np.maximum(np.ceil((high - low) / cell), 1))
    grid = Grid(float(low[0]), float(high[1]), cell, width, height)
    if cell == target.grid.cell:
        grid = snapped(grid, target.grid)
    T_level = pair.target.T_level_work
    ground = closed((cut_to(target, grid) or placed(pair.target, T_level, grid)).top)
    factor = max(1, _WIDE_PX // max(grid.shape))
    ground = smooth_larger(ground, factor)
    seen = np.isfinite(ground)
    base = np.where(
        seen,
        np.float32(0.75) * drawing.hillshade(ground, cell / factor) + np.float32(20.0),
        np.float32(130.0),
    )
    pictures = []
    for moved in (
        warp_bev(source, before, grid),
        placed(pair.source, T_level @ pair.T_target_source, grid),
    ):
        over = smooth_larger(closed(moved.top), factor)
        pictures.append(_laid_over(over, base, seen, cell / factor))
    return Swipe(pictures[0], pictures[1], cell / factor, as_it_lay)


def _pose_before(pair: Pair, after: Floats) -> tuple[Floats, bool]:
    """Return the source's pose before, levelled source to levelled target, and whether it is its own."""
    links = pair.source.link, pair.target.link
    shift = links[0].origin - links[1].origin
    own = pair.levelled(transforms.translation((float(shift[0]), float(shift[1]), float(shift[2]))))
    step = max(1, len(pair.source.sample) // _SOME)
    some = transforms.apply(pair.source.T_level_work, pair.source.sample[::step])
    middle = some.mean(axis=0, keepdims=True)
    size = float(np.ptp(some[:, :2], axis=0).max())
    moved = transforms.apply(after, middle)[0] - transforms.apply(own, middle)[0]
    if links[0].georeferenced == links[1].georeferenced and np.hypot(moved[0], moved[1]) < size:
        return own, True
    # turned as in its file, but where it belongs
    upright = np.eye(4)
    upright[:3, 3] = (transforms.apply(after, middle) - middle)[0]
    return upright, False


def _ends(grid: Grid) -> tuple[tuple[float, float], tuple[float, float]]:
    return (
        (grid.west, grid.north - grid.height * grid.cell),
        (grid.west + grid.width * grid.cell, grid.north),
    )


def _laid_over(over: Image, base: Image, ground: Mask, cell: float) -> drawing.Picture:
    """Return the source in orange over the target in grey, where it is seen through it.

    Args:
        over: (h, w) heights of the source, metres, NaN where empty.
        base: (h, w) grey of the target.
        ground: (h, w) where the target is seen.
        cell: metres of a pixel.

    """
    seen = np.isfinite(over)
    shade = drawing.hillshade(over, cell).astype(np.float32) / np.float32(255.0)
    out = np.empty((*over.shape, 4), np.uint8)
    for k, part in enumerate((255.0, 150.0, 60.0)):
        tint = np.float32(0.85 * part) * (np.float32(0.25) + np.float32(0.75) * shade)
        out[..., k] = np.clip(np.where(seen, np.float32(0.15) * base + tint, base), 0, 255)
    out[..., 3] = np.where(seen | ground, 255, 0)
    return out


def relief(bev: Bev, side: int = _WIDE_PX) -> tuple[drawing.Picture, float]:
    """Return a raster as relief, small gaps closed, and the metres of a pixel."""
    bev = coarsen(bev, joined_cells(bev, most_cells=side))
    factor = max(1, side // max(bev.grid.shape))
    top = smooth_larger(closed(bev.top), factor)
    return drawing.shaded_relief(top, bev.grid.cell / factor), bev.grid.cell / factor


def enlarged(picture: drawing.Picture, side: int) -> drawing.Picture:
    """Return a picture at a whole number of times its size, squares kept."""
    factor = max(1, side // max(picture.shape[:2]))
    size = (picture.shape[1] * factor, picture.shape[0] * factor)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST), np.uint8)
