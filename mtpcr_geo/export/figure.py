"""A registration as a matplotlib figure: both height rasters laid over each other."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.export import drawing
from mtpcr_geo.export.resample import placed_whole
from mtpcr_geo.method.bev import coarsen

_MOST_CELLS = 500  # of a side of the left panel
_DETAIL_CELLS = 300  # of a side of the right panel
_LARGEST_DIFFERENCE_M = 2.0
_GROUND_CELL_M = 1.0
_FILLED_SHARE = 0.95
_BLOCK_CELLS = 8
_SOURCE_OPACITY = 0.75
_WIDTH_INCHES, _HEIGHT_INCHES = 11.0, 5.4
_DPI = 110


class RegistrationFigure(Figure):
    """A matplotlib figure that notebooks show without pyplot; ``savefig`` writes it to a file."""

    def _repr_png_(self) -> bytes:
        image = io.BytesIO()
        self.savefig(image, format="png")
        return image.getvalue()


def registration_figure(pair: Pair, title: str = "") -> RegistrationFigure:
    """Draw both height rasters, the source where the transform puts it.

    Left the registered source over the target, seen from above; right the difference of their lowest heights
    in the middle of the overlap: pale where both see the same ground, and in pairs of red and blue along
    every edge where they are shifted. Cells are joined until nearly all are filled. Without a transform both
    rasters stand beside each other. Axes are metres in the target's work frame.

    Args:
        pair: a registration with rasters.
        title: stands above the figure.

    Raises:
        ValueError: if a cloud has no raster yet.

    """
    source, target = pair.source.bev, pair.target.bev
    if source is None or target is None:
        raise ValueError("a figure needs both height rasters")
    figure = RegistrationFigure(figsize=(_WIDTH_INCHES, _HEIGHT_INCHES), dpi=_DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    figure.suptitle(title, fontweight="bold")
    source, target = _readable(source), _readable(target)
    if pair.T_target_source is None:
        for axes, bev, role in ((left, source, "source"), (right, target, "target")):
            _show(axes, drawing.shaded_relief(bev.top, bev.grid.cell), bev.grid)
            axes.set(title=f"{role} (not registered)", xlabel="x (m)", ylabel="y (m)")
        return figure
    shown = pair.with_(source=replace(pair.source, bev=source), target=replace(pair.target, bev=target))
    moved = placed_whole(shown.source, pair.target.T_level_work @ pair.T_target_source)
    _draw_over(left, target, moved)
    left.set_title("registered source (coloured) over target (grey)", fontsize="medium")
    _draw_difference(figure, right, *_middle(*drawing.common_rasters(shown)))
    right.set_title("lowest heights, source minus target", fontsize="medium")
    for axes in (left, right):
        _label(axes, pair)
    return figure


def _draw_difference(figure: Figure, axes: Axes, source: Bev, target: Bev) -> None:
    """Draw by how much the source lies above the target: red above, blue below, pale where they agree."""
    # fine cells under a canopy hold branches more often than ground
    join = max(1, round(_GROUND_CELL_M / source.grid.cell))
    source, target = coarsen(source, join), coarsen(target, join)
    picture = axes.imshow(
        source.low - target.low,
        extent=_extent(source.grid),
        interpolation="nearest",
        cmap="RdBu_r",
        vmin=-_LARGEST_DIFFERENCE_M,
        vmax=_LARGEST_DIFFERENCE_M,
    )
    axes.set_facecolor("0.75")
    figure.colorbar(picture, ax=axes, label="metres", extend="both", shrink=0.8)


def _draw_over(axes: Axes, target: Bev, moved: Bev) -> None:
    """Draw the target in grey, and over it the registered source in colours of height."""
    grey = drawing.hillshade(target.top, target.grid.cell)
    _show(axes, np.where(grey == 0, 255, grey).astype(np.uint8), target.grid)
    relief = drawing.shaded_relief(moved.top, moved.grid.cell)
    opacity = np.where(np.isfinite(moved.top), round(255 * _SOURCE_OPACITY), 0).astype(np.uint8)
    _show(axes, np.dstack([relief, opacity]), moved.grid)
    extents = np.array([_extent(target.grid), _extent(moved.grid)])
    axes.set_xlim(extents[:, 0].min(), extents[:, 1].max())
    axes.set_ylim(extents[:, 2].min(), extents[:, 3].max())


def _readable(bev: Bev) -> Bev:
    """Join cells until nearly all within the cloud's outline are filled, and the raster fits a panel."""
    blocks = int((coarsen(bev, _BLOCK_CELLS).count > 0).sum())
    share = float((bev.count > 0).sum()) / max(1, blocks * _BLOCK_CELLS**2)
    # by Poisson's law for points spread at random
    per_cell = -math.log1p(-min(max(share, 1e-4), 1.0 - 1e-4))
    to_fill = math.sqrt(-math.log1p(-_FILLED_SHARE) / per_cell)
    factor = max(1, round(to_fill), -(-max(bev.grid.shape) // _MOST_CELLS))
    return coarsen(bev, factor)


def _middle(source: Bev, target: Bev) -> tuple[Bev, Bev]:
    """Cut two rasters of one grid to a window about the middle of what both fill."""
    grid = source.grid
    both = np.argwhere(np.isfinite(source.top) & np.isfinite(target.top))
    if not len(both):
        return source, target
    windows = []
    for size, centre in zip(grid.shape, np.median(both, axis=0), strict=True):
        start = int(np.clip(centre - _DETAIL_CELLS / 2, 0, max(0, size - _DETAIL_CELLS)))
        windows.append(slice(start, min(size, start + _DETAIL_CELLS)))
    rows, columns = windows
    cut = Grid(
        grid.west + columns.start * grid.cell,
        grid.north - rows.start * grid.cell,
        grid.cell,
        columns.stop - columns.start,
        rows.stop - rows.start,
    )
    return _cut(source, cut, rows, columns), _cut(target, cut, rows, columns)


def _cut(bev: Bev, grid: Grid, rows: slice, columns: slice) -> Bev:
    return Bev(grid, bev.top[rows, columns], bev.low[rows, columns], bev.count[rows, columns])


def _show(axes: Axes, picture: drawing.Picture, grid: Grid) -> None:
    axes.imshow(picture, extent=_extent(grid), interpolation="nearest", cmap="gray", vmin=0, vmax=255)
    axes.set_aspect("equal")


def _extent(grid: Grid) -> tuple[float, float, float, float]:
    """Return west, east, south and north of a raster, metres."""
    return (
        grid.west,
        grid.west + grid.width * grid.cell,
        grid.north - grid.height * grid.cell,
        grid.north,
    )


def _label(axes: Axes, pair: Pair) -> None:
    """Name both axes; georeferenced ones count from the work frame's origin."""
    if pair.frame.crs is None:
        axes.set(xlabel="x (m)", ylabel="y (m)")
        return
    east, north = (f"{value:.0f}" for value in pair.frame.origin[:2])
    axes.set(xlabel=f"metres east of {east}", ylabel=f"metres north of {north}")
