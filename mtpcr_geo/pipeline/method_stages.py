"""The steps of the method as stages: thin, each calling its room."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mtpcr_geo import geometry
from mtpcr_geo.cloud.base import Cloud
from mtpcr_geo.errors import OptionError
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value
from mtpcr_geo.scene import Bev, Pair, Side

if TYPE_CHECKING:
    from mtpcr_geo.crs import FrameLink, WorkFrame

Floats = NDArray[np.float64]


class LevelOptions(StageOptions):
    """Options of mtpcr.level."""

    method: Literal["auto", "ransac", "none"] = Field(
        "auto",
        description="how to make clouds upright: auto trusts the vertical of a georeferenced cloud and "
        "levels a local one by ground and vertical structure; ransac turns the ground plane horizontal; "
        "none keeps them",
    )
    target_crs: str | None = Field(
        None, description="CRS of the first cloud instead of what it states, or local"
    )
    source_crs: str | None = Field(
        None, description="CRS of the second cloud instead of what it states, or local"
    )
    local: bool = Field(False, description="all clouds are local, in metres, whatever they state")
    budget: int = Field(
        4_000_000, ge=1000, description="points of each cloud to work on; rasters always use all points"
    )
    seed: int = Field(0, ge=0, description="seed of the random choices")


class Level(Stage):
    """Bring clouds into the work frame and make them upright.

    Takes two clouds, the fixed one (target) first as in PDAL's filters.icp, or one cloud for a raster alone.
    """

    type: ClassVar[str] = "mtpcr.level"
    Options: ClassVar[OptionsModel] = LevelOptions
    options: LevelOptions

    def check_inputs(self, inputs: Sequence[Value], context: RunContext) -> None:
        """Settle the frames from the headers, so that a CRS that does not do is known before the run."""
        from mtpcr_geo.cloud.las import check_distinct

        clouds = [value for value in inputs if isinstance(value, Cloud)]
        if len(clouds) in (1, 2) and all(cloud.count for cloud in clouds):
            self._frames(clouds[0], clouds[-1])
        if len(clouds) == 2:
            check_distinct(*clouds)

    def _frames(self, target: Cloud, source: Cloud) -> tuple[WorkFrame, FrameLink, FrameLink]:
        from mtpcr_geo.crs import resolve_frames

        return resolve_frames(
            target,
            source,
            target_crs=self.options.target_crs,
            source_crs=self.options.target_crs if source is target else self.options.source_crs,
            local=self.options.local,
        )

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Scan, sample and level each cloud."""
        from mtpcr_geo.cloud.las import check_distinct
        from mtpcr_geo.cloud.sample import scan
        from mtpcr_geo.level import level

        clouds = [value for value in inputs if isinstance(value, Cloud)]
        if len(clouds) != len(inputs) or len(clouds) not in (1, 2):
            raise OptionError(f"{self.label} takes two clouds, the fixed one first, or one; set its inputs")
        target, source = clouds[0], clouds[-1]
        if len(clouds) == 2:
            check_distinct(target, source)
        options = self.options
        found = [
            scan(cloud, budget=options.budget, seed=options.seed, progress=context.progress)
            for cloud in clouds
        ]
        frame, *links = self._frames(target, source)
        sides = []
        for role, cloud, link, looked in zip(("target", "source"), clouds, links, found, strict=False):
            sample = in_work_frame(link, looked.sample)
            upright = level(sample, options.method, link.file_crs is not None, options.seed)
            self.metadata[role] = {
                "points": looked.count,
                "noise_points": looked.dropped,
                "sampled": len(looked.sample),
                **upright.report,
            }
            sides.append(
                Side(
                    role,  # type: ignore[arg-type]
                    cloud,
                    link,
                    sample,
                    upright.T_level_work,
                    {**upright.report, "complete": looked.complete},
                )
            )
        return Pair(sides[0], sides[-1], frame)


def in_work_frame(link: FrameLink, xyz: Floats) -> Floats:
    """Take (n, 3) file coordinates to work coordinates, rounded to 10 micrometres.

    Far from the origin a float64 coordinate carries nanometres of noise, and points that a LAS scale puts
    exactly on the line between two cells would fall to either side by it.
    """
    return np.round(link.to_work(xyz), 5)


class BevOptions(StageOptions):
    """Options of mtpcr.bev."""

    cell: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="edge of a raster cell in metres; chosen from both clouds' densities if not given",
    )


class MakeBev(Stage):
    """Rasterise highest z, lowest z and point count of each cloud (Eq. 2), streamed."""

    type: ClassVar[str] = "mtpcr.bev"
    Options: ClassVar[OptionsModel] = BevOptions
    options: BevOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Choose the cell and rasterise both sides."""
        from mtpcr_geo.bev import choose_cell, density, grid_around, rasterise

        pair = self.one_pair(inputs)
        sides = [pair.target] if pair.source is pair.target else [pair.target, pair.source]
        densities = [density(side.sample, side.cloud.count) for side in sides]
        cell = self.options.cell or choose_cell(*densities)
        self.metadata |= {"cell_m": cell, "cell_chosen": self.options.cell is None}
        made = []
        for side, dense in zip(sides, densities, strict=True):
            levelled = side.levelled_sample
            low, high = geometry.bounds(levelled)
            whole = bool(side.level_report.get("complete", True))
            if not whole:
                # the sample may miss the outermost points
                low, high = _levelled_bounds(side)
            chunks = [levelled] if whole else _levelled_chunks(side, context)
            bev = rasterise(chunks, grid_around(low, high, cell))
            made.append(bev)
            self.metadata[side.role] = {
                "width": bev.grid.width,
                "height": bev.grid.height,
                "filled_share": float((bev.count > 0).mean()),
                "points_per_m2": dense.per_m2,
                "area_m2": dense.area_m2,
            }
        from dataclasses import replace

        done = [replace(side, bev=bev) for side, bev in zip(sides, made, strict=True)]
        return pair.with_(target=done[0], source=done[-1])


def _levelled_chunks(side: Side, context: RunContext) -> Iterator[Floats]:
    from mtpcr_geo.cloud.sample import surface_chunks

    with context.progress.task(f"rasterising {side.cloud.name}", side.cloud.count) as advance:
        for xyz in surface_chunks(side.cloud):
            yield geometry.apply(side.T_level_work, in_work_frame(side.link, xyz))
            advance(len(xyz))


def _levelled_bounds(side: Side) -> tuple[Floats, Floats]:
    """Bounds of the whole cloud once levelled, from the corners of its box: a little generous."""
    low, high = side.cloud.minimum, side.cloud.maximum
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    placed = geometry.apply(side.T_level_work, side.link.to_work(corners))
    return placed.min(axis=0), placed.max(axis=0)


class MatchOptions(StageOptions):
    """Options of mtpcr.match."""

    method: Literal["correlation"] = Field("correlation", description="which matcher")
    yaw_step: float = Field(4.0, gt=0, le=30, description="step of the search over all yaws, degrees")
    patch: float = Field(24.0, gt=0, description="edge of a patch of the local matches, metres")
    reach: float = Field(6.0, gt=0, description="how far a patch may lie from the hypothesis, metres")
    min_overlap: float = Field(400.0, ge=0, description="smallest overlap considered, square metres")
    seed: int = Field(0, ge=0, description="seed of the random choices")


class Match(Stage):
    """Find point pairs in the two rasters, at any yaw."""

    type: ClassVar[str] = "mtpcr.match"
    Options: ClassVar[OptionsModel] = MatchOptions
    options: MatchOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Match the source's raster to the target's."""
        from mtpcr_geo.match.correlation import CorrelationSettings, match

        pair = self.one_pair(inputs)
        source, target = _bevs(self, pair)
        settings = CorrelationSettings(
            yaw_step_deg=self.options.yaw_step,
            patch_m=self.options.patch,
            reach_m=self.options.reach,
            min_overlap_m2=self.options.min_overlap,
        )
        with context.progress.task("searching all yaws", None) as advance:
            matches = match(source, target, settings, self.options.seed, advance)
        self.metadata |= {"matches": len(matches.score), **matches.report}
        return pair.with_(matches=matches)


def _bevs(stage: Stage, pair: Pair) -> tuple[Bev, Bev]:
    if pair.source is pair.target:
        raise OptionError(f"{stage.label} needs two clouds; give mtpcr.level a target and a source")
    if pair.source.bev is None or pair.target.bev is None:
        raise OptionError(f"{stage.label} needs height rasters; put mtpcr.bev before it")
    return pair.source.bev, pair.target.bev


class LiftOptions(StageOptions):
    """Options of mtpcr.lift."""

    surface: Literal["ground", "top"] = Field(
        "ground",
        description="height of a tie: the lowest z around it, or the highest z of its cell (the paper)",
    )
    folds: int = Field(
        4,
        ge=2,
        le=20,
        description="parts of the ties' ground; the first is withheld from the solve to judge it by",
    )
    block: float = Field(40.0, gt=0, description="edge of the blocks in which ties are withheld, metres")
    seed: int = Field(0, ge=0, description="seed that chooses the withheld blocks")


class Lift(Stage):
    """Map matches back to 3D in metres (Eq. 5), and set some aside to judge by."""

    type: ClassVar[str] = "mtpcr.lift"
    Options: ClassVar[OptionsModel] = LiftOptions
    options: LiftOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Lift the matches to ties."""
        from mtpcr_geo.lift import lift

        pair = self.one_pair(inputs)
        source, target = _bevs(self, pair)
        if pair.matches is None:
            raise OptionError(f"{self.label} needs matches; put mtpcr.match before it")
        ties = lift(
            pair.matches,
            source,
            target,
            surface=self.options.surface,
            folds=self.options.folds,
            block_m=self.options.block,
            seed=self.options.seed,
        )
        self.metadata |= {"ties": len(ties.score), "withheld": int(ties.withheld.sum())}
        return pair.with_(ties=ties)


class SolveOptions(StageOptions):
    """Options of mtpcr.solve."""

    tolerance: float | None = Field(
        None, gt=0, description="plan residual up to which ties agree, metres; 1.5 cells if not given"
    )
    upright: bool = Field(
        True, description="solve yaw and shift, trusting the levelling; else all six degrees of freedom"
    )
    robust_start: bool = Field(
        True,
        description="start from the yaw and shift most ties agree on (RANSAC); else from all (the paper)",
    )
    seed: int = Field(0, ge=0, description="seed of the robust start")


class Solve(Stage):
    """Solve the rigid transform from the ties: iterative SVD with outlier rejection."""

    type: ClassVar[str] = "mtpcr.solve"
    Options: ClassVar[OptionsModel] = SolveOptions
    options: SolveOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Solve in levelled coordinates, and compose both levelling rotations into the result."""
        from dataclasses import replace

        from mtpcr_geo.solve import solve_ties

        pair = self.one_pair(inputs)
        source, _ = _bevs(self, pair)
        if pair.ties is None:
            raise OptionError(f"{self.label} needs ties; put mtpcr.lift before it")
        ties = pair.ties
        tolerance = self.options.tolerance or 1.5 * source.grid.cell
        solution, inlier = solve_ties(
            ties.source,
            ties.target,
            ties.score,
            ties.withheld,
            tolerance=tolerance,
            robust_start=self.options.robust_start,
            upright=self.options.upright,
            seed=self.options.seed,
        )
        T_work_level = geometry.inverse(pair.target.T_level_work)
        T = T_work_level @ solution.T @ pair.source.T_level_work
        report = {
            "used": int((~ties.withheld).sum()),
            "inliers": int(solution.inlier.sum()),
            "iterations": solution.iterations,
            "threshold_m": solution.threshold,
            "yaw_deg": float(np.degrees(geometry.yaw_of(solution.T[:3, :3]))),
            "settings": {
                "robust_start": self.options.robust_start,
                "upright": self.options.upright,
                "seed": self.options.seed,
            },
        }
        self.metadata |= report
        return pair.with_(T_target_source=T, ties=replace(ties, inlier=inlier), solve_report=report)


class RefineOptions(StageOptions):
    """Options of mtpcr.refine."""

    method: Literal["gicp", "point_to_plane", "point_to_point", "none"] = Field(
        "gicp", description="ICP variant; point_to_point is what the paper cites"
    )
    voxel: float = Field(0.5, gt=0, description="thinning of the points, metres; grows with large overlaps")
    reach: list[float] | None = Field(
        None,
        min_length=1,
        description="farthest correspondence of each round, metres; from the cell if not given",
    )
    max_points: int = Field(
        30_000,
        ge=200,
        description="points of the source after thinning; the target may have three times as many",
    )
    iterations: int = Field(30, ge=1, description="iterations of each round at most")
    ground: bool = Field(True, description="settle height and tilt on the ground before, and height after")


class Refine(Stage):
    """Refine by ICP on the overlap, with the height settled on the ground."""

    type: ClassVar[str] = "mtpcr.refine"
    Options: ClassVar[OptionsModel] = RefineOptions
    options: RefineOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Refine the solved transform."""
        from mtpcr_geo.refine import icp, reaches_for, settle_on_ground

        pair = self.one_pair(inputs)
        if pair.T_target_source is None:
            raise OptionError(f"{self.label} needs a transform; put mtpcr.solve before it")
        source, target, T = pair.source.sample, pair.target.sample, pair.T_target_source
        report: dict[str, object] = {}
        if self.options.ground:
            settled = settle_on_ground(source, target, T, tilt=True)
            T, report["ground_before"] = settled.T, settled.report
        if self.options.method != "none":
            cell = pair.source.bev.grid.cell if pair.source.bev is not None else 1.0
            reach = self.options.reach or reaches_for(cell)
            refined = icp(
                source,
                target,
                T,
                method=self.options.method,
                voxel_m=self.options.voxel,
                reach_m=tuple(reach),
                most_points=self.options.max_points,
                iterations=self.options.iterations,
            )
            T, report["icp"] = refined.T, refined.report
        if self.options.ground:
            settled = settle_on_ground(source, target, T, tilt=False)
            T, report["ground_after"] = settled.T, settled.report
        self.metadata |= report
        return pair.with_(T_target_source=T, refine_report={**report, "T_before": pair.T_target_source})


class AssessOptions(StageOptions):
    """Options of mtpcr.assess."""

    tolerance: float | None = Field(
        None,
        gt=0,
        description="plan distance within which a withheld tie agrees, metres; one cell if not given",
    )
    surprise: float = Field(
        6.0, ge=0, description="digits of improbability of the withheld ties' agreement wanted to accept"
    )
    margin: float = Field(
        1.3, ge=1, description="strength over the next distinct hypothesis wanted to accept"
    )
    agreeing: float = Field(0.15, ge=0, le=1, description="share of withheld ties that must agree to accept")
    min_overlap: float = Field(400.0, ge=0, description="overlap wanted to accept, square metres")


class Assess(Stage):
    """Judge the result by what the fit did not see: accepted, doubtful or refused, with reasons."""

    type: ClassVar[str] = "mtpcr.assess"
    Options: ClassVar[OptionsModel] = AssessOptions
    options: AssessOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Gather the evidence and judge."""
        from mtpcr_geo.assess import Limits, assess
        from mtpcr_geo.evidence import gather

        pair = self.one_pair(inputs)
        if pair.T_target_source is None or pair.ties is None:
            raise OptionError(f"{self.label} needs a transform and ties; put mtpcr.solve before it")
        options = self.options
        evidence, more = gather(pair, options.tolerance)
        limits = Limits(
            surprise=options.surprise,
            agreeing=options.agreeing,
            margin=options.margin,
            overlap_m2=options.min_overlap,
        )
        verdict = assess(evidence, limits, more)
        self.metadata |= {"verdict": verdict.name, "reasons": list(verdict.reasons), **verdict.metrics}
        return pair.with_(verdict=verdict)
