"""Bringing clouds into the work frame, upright, and onto rasters: the stages before any matching."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from mtpcr_geo.core import transforms
from mtpcr_geo.core.ahead import ahead
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import CrsError, InputError, OptionError
from mtpcr_geo.core.scanner import Scanner, check_unit
from mtpcr_geo.core.types import Bev, Levelling, Pair, RasterSettings, Side
from mtpcr_geo.method.bev import (
    Cells,
    Convention,
    Coverage,
    ceil_grid,
    choose_cells,
    coverage_of,
    grid_around,
    make_bev,
    rasterise,
)
from mtpcr_geo.pipeline.options import (
    Cell,
    LevelMethod,
    Local,
    OutCrs,
    Seed,
    SourceAxes,
    SourceCrs,
    SourceUnit,
    TargetAxes,
    TargetCrs,
    TargetUnit,
    Vertical,
)
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value

if TYPE_CHECKING:
    from mtpcr_geo.core.frames import FrameLink, WorkFrame
    from mtpcr_geo.io.sample import Scan


class LevelOptions(StageOptions):
    """Options of mtpcr.level."""

    method: LevelMethod = "auto"
    target_crs: TargetCrs = None
    source_crs: SourceCrs = None
    target_unit: TargetUnit = None
    source_unit: SourceUnit = None
    target_axes: TargetAxes = "z-up"
    source_axes: SourceAxes = "z-up"
    local: Local = False
    vertical: Vertical = "refuse"
    out_crs: OutCrs = None
    budget: int = Field(
        4_000_000, ge=1000, description="points of each cloud to work on; rasters always use all points"
    )
    seed: Seed = 0


class Level(Stage):
    """Bring clouds into the work frame and make them upright.

    Takes two clouds, the fixed one (target) first as in PDAL's filters.icp, or one cloud for a raster alone.
    """

    type: ClassVar[str] = "mtpcr.level"
    needs: ClassVar[tuple[str, ...]] = ("mtpcr_geo.method.levelling", "mtpcr_geo.crs")
    Options: ClassVar[OptionsModel] = LevelOptions
    options: LevelOptions

    def check_inputs(self, inputs: Sequence[Value], context: RunContext) -> None:
        """Settle the frames from the headers, so that a CRS that does not do is known before the run."""
        from mtpcr_geo.io.las import check_distinct
        from mtpcr_geo.io.sample import bounds_of_some

        clouds = [value for value in inputs if isinstance(value, Cloud)]
        if len(clouds) in (1, 2) and all(cloud.count for cloud in clouds):
            try:
                self._frames(clouds[0], clouds[-1])
            except (CrsError, InputError):
                # a header is a hint: ask again by some points before refusing
                self._frames(clouds[0], clouds[-1], [bounds_of_some(cloud) for cloud in clouds])
        if len(clouds) == 2:
            check_distinct(*clouds)

    def _frames(
        self, target: Cloud, source: Cloud, bounds: Sequence[Floats | None] = (None,)
    ) -> tuple[WorkFrame, FrameLink, FrameLink]:
        from mtpcr_geo.crs import resolve_frames

        return resolve_frames(
            target,
            source,
            target_crs=self.options.target_crs,
            source_crs=self.options.target_crs if source is target else self.options.source_crs,
            local=self.options.local,
            vertical=self.options.vertical,
            out_crs=self.options.out_crs,
            target_bounds=bounds[0],
            source_bounds=bounds[-1],
            target_scanner=self._scanner("target"),
            source_scanner=self._scanner("target" if source is target else "source"),
        )

    def _scanner(self, role: Literal["target", "source"]) -> Scanner:
        if role == "target":
            return Scanner(self.options.target_unit, self.options.target_axes)
        return Scanner(self.options.source_unit, self.options.source_axes)

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Scan, sample and level each cloud."""
        from mtpcr_geo.io.file_cloud import precision_remark
        from mtpcr_geo.io.las import check_distinct
        from mtpcr_geo.io.sample import header_remark

        clouds = [value for value in inputs if isinstance(value, Cloud)]
        if len(clouds) != len(inputs) or len(clouds) not in (1, 2):
            raise OptionError(f"{self.label} takes two clouds, the fixed one first, or one; set its inputs")
        target, source = clouds[0], clouds[-1]
        if len(clouds) == 2:
            check_distinct(target, source)
        options = self.options
        for cloud in clouds:
            if cloud.count > options.budget:
                # the rasters take all points: a second pass
                cloud.keep(context.at_end)
        roles: tuple[Literal["target", "source"], ...] = ("target", "source")
        found = [self.scanned(role, cloud, context) for role, cloud in zip(roles, clouds, strict=False)]
        frame, *links = self._frames(target, source, [scanned.bounds for scanned in found])
        sides = []
        for role, cloud, link, scanned in zip(roles, clouds, links, found, strict=False):
            if link.file_crs is None and link.scanner.unit is None:
                check_unit(cloud.name, role, scanned.sample, scanned.count)
            sample = in_work_frame(link, scanned.sample)
            levelling = self.levelled(role, link, sample)
            self.metadata[role] = {
                "points": scanned.count,
                "noise_points": scanned.dropped,
                "no_return_points": scanned.no_returns,
                "stray_points": scanned.strays,
                "sampled": len(scanned.sample),
                **levelling.audit(),
            }
            found_remarks = header_remark(cloud, scanned.whole), precision_remark(cloud, scanned.sample)
            remarks = tuple(remark for remark in found_remarks if remark is not None)
            if remarks:
                self.metadata[role]["header_remarks"] = list(remarks)
            side = side_of(role, cloud, link, scanned, sample, levelling)
            sides.append(replace(side, remarks=remarks))
        return Pair(sides[0], sides[-1], frame)

    def scanned(self, role: Literal["target", "source"], cloud: Cloud, context: RunContext) -> Scan:
        """Return what one pass over a cloud gives."""
        from mtpcr_geo.io.sample import scan

        return scan(cloud, budget=self.options.budget, seed=self.options.seed, progress=context.progress)

    def levelled(self, role: Literal["target", "source"], link: FrameLink, sample: Floats) -> Levelling:
        """Return the rotation that makes a cloud upright, from a sample (n, 3) in work coordinates."""
        from mtpcr_geo.method.levelling import level

        return level(sample, self.options.method, link.georeferenced, self.options.seed)


def side_of(
    role: Literal["source", "target"],
    cloud: Cloud,
    link: FrameLink,
    scanned: Scan,
    sample: Floats,
    levelling: Levelling,
) -> Side:
    """Return a side of a pair from what was seen of its cloud.

    Args:
        role: which side it is.
        cloud: as it was opened.
        link: between the file's coordinates and the work frame.
        scanned: what the first pass found.
        sample: (n, 3) work coordinates, metres.
        levelling: the rotation that makes it upright.

    """
    return Side(
        role,
        cloud,
        link,
        sample,
        scanned.complete,
        levelling,
        bounds=scanned.bounds,
        no_returns=scanned.no_returns,
        no_return_places=scanned.no_return_places,
        strays=scanned.strays,
        box=scanned.box,
    )


def in_work_frame(link: FrameLink, xyz: Floats) -> Floats:
    """Take (n, 3) file coordinates to work coordinates, rounded to 10 micrometres.

    Far from the origin a float64 coordinate carries nanometres of noise, and points that a LAS scale puts
    exactly on the line between two cells would fall to either side by it.
    """
    if link.pipeline is not None:
        return np.round(link.to_work(xyz), 5)
    return transforms.by_blocks(lambda some: np.round(link.to_work(some), 5), xyz)


class BevOptions(StageOptions):
    """Options of mtpcr.bev."""

    cell: Cell = None
    finest: float | None = Field(
        None,
        ge=0.25,
        le=8,
        allow_inf_nan=False,
        description="no finer cell is chosen than this, metres; chosen from the clouds' extent if not given",
    )
    resolution: Literal["common", "eq1", "eq1_occupied"] = Field(
        "common",
        description="one cell for both clouds, or a cell of its own for each by the paper's Eq. 1, from "
        "points per area of the bounding box or of the occupied ground",
    )
    gamma: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="the gamma of Eq. 1, metres; if not given, such that the geometric mean of both cells is "
        "the cell given, or the one that would be chosen",
    )
    pixel: Literal["centre", "ceil"] = Field(
        "centre",
        description="which points a cell holds: our pixel centres, or the paper's ceiling (Eq. 2)",
    )


class MakeBev(Stage):
    """Rasterise highest z, lowest z and point count of each cloud (Eq. 2), streamed."""

    type: ClassVar[str] = "mtpcr.bev"
    Options: ClassVar[OptionsModel] = BevOptions
    options: BevOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Choose the cell and rasterise both sides."""
        options = self.options
        settings = RasterSettings(
            options.cell, options.finest, options.resolution, options.gamma, options.pixel
        )
        pair, cells, coverages = with_rasters(self.one_pair(inputs), settings, context)
        self.metadata |= {"cell_m": cells.cells_m[-1], "cell_chosen": options.cell is None}
        if cells.gamma_m is not None:
            self.metadata["gamma_m"] = cells.gamma_m
        for side, coverage in zip((pair.target, pair.source), (coverages[0], coverages[-1]), strict=True):
            assert side.bev is not None
            self.metadata[side.role] = {
                "cell_m": side.bev.grid.cell,
                "width": side.bev.grid.width,
                "height": side.bev.grid.height,
                "filled_share": float((side.bev.count > 0).mean()),
                "points_per_m2": coverage.per_m2,
                "area_m2": coverage.occupied_m2,
            }
        return pair


def with_rasters(
    pair: Pair, settings: RasterSettings, context: RunContext
) -> tuple[Pair, Cells, list[Coverage]]:
    """Choose the cells and rasterise both sides; return how they were chosen, target first.

    Raises:
        RegistrationError: if a raster would not fit into memory.

    """
    sides = [pair.target] if pair.source is pair.target else [pair.target, pair.source]
    coverages = [_coverage(side) for side in sides]
    cells = choose_cells(
        coverages,
        cell=settings.cell,
        finest=settings.finest,
        resolution=settings.resolution,
        gamma=settings.gamma,
    )
    done = [
        replace(side, bev=rasterised(side, cell, settings.pixel, context))
        for side, cell in zip(sides, cells.cells_m, strict=True)
    ]
    return pair.with_(target=done[0], source=done[-1], raster=settings), cells, coverages


def _coverage(side: Side) -> Coverage:
    points = None if side.complete else side.cloud.count - side.no_returns - side.strays
    return coverage_of(side.levelled_sample, points=points)


def rasterised(side: Side, cell: float, convention: Convention, context: RunContext) -> Bev:
    """Rasterise a side from its sample where that is the whole cloud, else from a pass over its points."""
    if side.complete:
        return make_bev(side.levelled_sample, cell, convention)
    # the sample may miss the outermost points
    lay = grid_around if convention == "centre" else ceil_grid
    return rasterise(_levelled_chunks(side, context), lay(*_levelled_bounds(side), cell), convention)


def _levelled_chunks(side: Side, context: RunContext) -> Iterator[Floats]:
    from mtpcr_geo.io.sample import surface_chunks

    upright = np.array_equal(side.T_level_work, np.eye(4))

    def levelled() -> Iterator[Floats]:
        for xyz in surface_chunks(side.cloud, places=side.no_return_places, box=side.box):
            work = in_work_frame(side.link, xyz)
            yield work if upright else transforms.apply(side.T_level_work, work)

    with context.progress.task(f"rasterising {side.cloud.name}", side.cloud.count) as advance:
        for xyz in ahead(levelled()):
            yield xyz
            advance(len(xyz))


def _levelled_bounds(side: Side) -> tuple[Floats, Floats]:
    """Bounds of the whole cloud once levelled, from the corners of its box: a little generous."""
    low, high = (side.cloud.minimum, side.cloud.maximum) if side.bounds is None else side.bounds
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    placed = transforms.apply(side.T_level_work, side.link.to_work(corners))
    return placed.min(axis=0), placed.max(axis=0)
