"""A registration as a matplotlib figure: both height rasters laid over each other."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mtpcr_geo.core import transforms
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Floats, Pair
from mtpcr_geo.export import drawing
from mtpcr_geo.export.geotiff import grid_around, warp_bev

_MOST_CELLS = 800  # of a side of a panel
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

    Left the registered source over the target, seen from above; right the height steps of both where they
    overlap: where the registration holds, the source's run along the target's. Without a transform both
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
    if pair.T_target_source is None:
        for axes, bev, role in ((left, source, "source"), (right, target, "target")):
            _show(axes, drawing.shaded_relief(_thin(bev).top, _thin(bev).grid.cell), _thin(bev).grid)
            axes.set(title=f"{role} (not registered)", xlabel="x (m)", ylabel="y (m)")
        return figure
    T = pair.target.T_level_work @ pair.T_target_source @ transforms.inverse(pair.source.T_level_work)
    _draw_over(left, source, target, T)
    left.set_title("registered source, coloured by height, over the target in grey")
    pictured = drawing.common_rasters(pair, max_side=_MOST_CELLS)
    _show(right, drawing.edge_overlay(*pictured), pictured[0].grid)
    right.set_title("height steps in the overlap")
    labels = [
        Patch(color=np.array(colour) / 255, label=label)
        for colour, label in ((drawing.SOURCE_RGB, "source"), (drawing.TARGET_RGB, "target"))
    ]
    right.legend(handles=labels, loc="upper right", framealpha=0.85)
    for axes in (left, right):
        _label(axes, pair)
    return figure


def _draw_over(axes: Axes, source: Bev, target: Bev, T: Floats) -> None:
    """Draw the target in grey, and over it the source in colours of height."""
    target = _thin(target)
    around = grid_around(source, T)
    step = max(1.0, max(around.shape) / _MOST_CELLS)
    cell = around.cell * step
    moved = warp_bev(
        source, T, Grid(around.west, around.north, cell, *(int(n / step) + 1 for n in around.shape[::-1]))
    )
    grey = drawing.hillshade(target.top, target.grid.cell)
    _show(axes, np.where(grey == 0, 255, grey).astype(np.uint8), target.grid)
    relief = drawing.shaded_relief(moved.top, cell)
    opacity = np.where(np.isfinite(moved.top), round(255 * _SOURCE_OPACITY), 0).astype(np.uint8)
    _show(axes, np.dstack([relief, opacity]), moved.grid)
    extents = np.array([_extent(target.grid), _extent(moved.grid)])
    axes.set_xlim(extents[:, 0].min(), extents[:, 1].max())
    axes.set_ylim(extents[:, 2].min(), extents[:, 3].max())


def _thin(bev: Bev) -> Bev:
    """Return every n-th cell of a raster, at most so many a side as a panel shows."""
    top, cell, _ = drawing.thinned(bev, _MOST_CELLS)
    grid = Grid(bev.grid.west, bev.grid.north, cell, top.shape[1], top.shape[0])
    return replace(bev, grid=grid, top=np.ascontiguousarray(top))


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
