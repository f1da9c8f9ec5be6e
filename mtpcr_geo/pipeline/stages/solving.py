"""The steps of the method as stages, from lifting to the verdict: thin, each calling its room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Literal

from pydantic import Field

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import OptionError, RegistrationError
from mtpcr_geo.core.types import Bev, Pair, Refinement, Side, SolveSettings
from mtpcr_geo.method.scales import tolerance_for
from mtpcr_geo.pipeline.options import Motion, Seed
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value
from mtpcr_geo.pipeline.stages.pairs import bevs_of


class InverseMappingOptions(StageOptions):
    """Options of mtpcr.inverse_mapping."""

    surface: Literal["ground", "top", "grey"] = Field(
        "ground",
        description="height of a tie point: the lowest z around it, the highest z of its cell, or that in "
        "255 "
        "steps (the paper's Eq. 5)",
    )
    pixel: Literal["centre", "ceil"] = Field(
        "centre",
        description="where in its cell a pixel lies: the centre, or the north-east corner (Eq. 5)",
    )
    folds: int = Field(
        4,
        ge=2,
        le=20,
        description="parts of the tie points' ground; the first is held out from the solve to judge it by",
    )
    block: float | None = Field(
        None,
        gt=0,
        description="edge of the blocks in which tie points are held out, metres; from their extent if not "
        "given",
    )
    seed: Seed = 0


class InverseMapping(Stage):
    """Map matches back to 3D in metres (Eq. 5), and set some aside to judge by."""

    type: ClassVar[str] = "mtpcr.inverse_mapping"
    Options: ClassVar[OptionsModel] = InverseMappingOptions
    options: InverseMappingOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Lift the matches to tie points."""
        from mtpcr_geo.method.inverse_mapping import tie_points_of

        pair = self.one_pair(inputs)
        source, target = bevs_of(self, pair)
        if pair.matches is None:
            raise OptionError(f"{self.label} needs matches; put mtpcr.match before it")
        tie_points = tie_points_of(
            pair.matches,
            source,
            target,
            surface=self.options.surface,
            pixel=self.options.pixel,
            folds=self.options.folds,
            block_m=self.options.block,
            seed=self.options.seed,
        )
        self.metadata |= {"tie_points": len(tie_points.score), "held_out": int(tie_points.held_out.sum())}
        return pair.with_(tie_points=tie_points)


TRIES, MANY_TRIES = 2000, 20_000
"""Pairs of tie points tried for a robust start; with keypoint matchers, of whose matches 2 % may be right."""


class SolveOptions(StageOptions):
    """Options of mtpcr.solve."""

    tolerance: float | None = Field(
        None, gt=0, description="plan residual up to which tie points agree, metres; 1.5 cells if not given"
    )
    upright: bool = Field(
        True, description="solve yaw and shift, trusting the levelling; else all six degrees of freedom"
    )
    robust_start: bool = Field(
        True,
        description="start from the yaw and shift most tie points agree on (RANSAC); else from all (the "
        "paper)",
    )
    tries: int | None = Field(
        None,
        ge=1,
        description="pairs of tie points tried for the robust start; if not given 2,000, or 20,000 with "
        "keypoint matchers, of whose matches few may be right",
    )
    seed: Seed = 0


class Solve(Stage):
    """Solve the rigid transform from the tie points: iterative SVD with outlier rejection."""

    type: ClassVar[str] = "mtpcr.solve"
    Options: ClassVar[OptionsModel] = SolveOptions
    options: SolveOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Solve in levelled coordinates, and compose both levelling rotations into the result."""
        from mtpcr_geo.method.shortcomings import what_is_missing
        from mtpcr_geo.method.solve import solve_tie_points

        pair = self.one_pair(inputs)
        rasters = bevs_of(self, pair)
        if pair.tie_points is None:
            raise OptionError(f"{self.label} needs tie points; put mtpcr.inverse_mapping before it")
        tie_points = pair.tie_points
        tolerance = self.options.tolerance or 1.5 * tolerance_for(pair.cell)
        options = self.options
        matcher = None if pair.matches is None else pair.matches.matcher
        tries = options.tries or (MANY_TRIES if matcher is not None and matcher.needs_image else TRIES)
        settings = SolveSettings(options.robust_start, options.upright, tries, options.seed)
        try:
            solution, inlier = solve_tie_points(tie_points, tolerance, settings)
        except RegistrationError as error:
            what, _, advice = str(error).partition("; ")
            raise RegistrationError(f"{what}; {what_is_missing(*rasters) or advice}") from error
        T_work_level = transforms.inverse(pair.target.T_level_work)
        T = T_work_level @ solution.T @ pair.source.T_level_work
        self.metadata |= solution.audit()
        return pair.with_(T_target_source=T, tie_points=replace(tie_points, inlier=inlier), solution=solution)


class RefineOptions(StageOptions):
    """Options of mtpcr.refine."""

    method: Literal["gicp", "point_to_plane", "point_to_point", "none"] = Field(
        "gicp", description="ICP variant; point_to_point is what the paper cites"
    )
    voxel: float = Field(0.5, gt=0, description="thinning of the points, metres")
    max_correspondence_distance: list[float] | None = Field(
        None,
        min_length=1,
        description="farthest correspondence of each round, metres; if not given, far and near rounds are "
        "tried, and what the surfaces fit best is taken",
    )
    max_points: int = Field(
        60_000,
        ge=200,
        description="points of the source after thinning, about; the target may have twice as many",
    )
    iterations: int = Field(
        30, ge=1, description="iterations of a round at most; four times as many of the last"
    )
    motion: Motion = "rigid"
    ground: bool = Field(True, description="settle height and tilt on the ground before, and height after")
    feedback: bool = Field(
        True,
        description="match and solve again once where a vertical is not known and ICP tilts the source, "
        "levelled by that; or where surfaces fit better beside the tie points, at a coarser cell; refine "
        "from the pose of the search too where tie points led elsewhere",
    )
    keep_tie_points: float = Field(
        0.5,
        ge=0,
        le=1,
        description="share of the agreeing tie points that must still agree after ICP for it to be "
        "followed, since on open ground it may slide; where fewer than 20 agree it is followed without them "
        "too, if surfaces meet far better. 0 to follow it always, however they fit",
    )


class Refine(Stage):
    """Refine by ICP on the overlap, with the height settled on the ground."""

    type: ClassVar[str] = "mtpcr.refine"
    needs: ClassVar[tuple[str, ...]] = (
        "small_gicp",
        "mtpcr_geo.method.refine",
        "mtpcr_geo.pipeline.stages.feedback",
    )
    Options: ClassVar[OptionsModel] = RefineOptions
    options: RefineOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Refine the solved transform."""
        from mtpcr_geo.method.refine import RefineSettings
        from mtpcr_geo.pipeline.stages.closer import with_points_near
        from mtpcr_geo.pipeline.stages.feedback import (
            fed_back,
            matched_coarser,
            refined_from_search,
        )
        from mtpcr_geo.pipeline.stages.rasters import rasterised
        from mtpcr_geo.pipeline.stages.refining import refined_pair

        pair = self.one_pair(inputs)
        if pair.T_target_source is None:
            raise OptionError(f"{self.label} needs a transform; put mtpcr.solve before it")
        pair = with_points_near(pair, context)
        options = self.options
        distances = options.max_correspondence_distance
        settings = RefineSettings(
            method=None if options.method == "none" else options.method,
            voxel_m=options.voxel,
            max_correspondence_distances_m=None if distances is None else tuple(distances),
            max_points=options.max_points,
            iterations=options.iterations,
            # without tie points there is no middle of the overlap to hold
            motion="rigid" if pair.tie_points is None else options.motion,
            ground=options.ground,
            keep_tie_points=options.keep_tie_points,
        )
        refinement = refined_pair(pair, settings)

        def raster_at(side: Side, cell: float) -> Bev:
            return rasterised(side, cell, "centre", context)

        if options.feedback:
            elsewhere = refined_from_search(pair, refinement, settings)
            if elsewhere is not None:
                pair, refinement = pair.with_(T_target_source=elsewhere.T_before), elsewhere
        trusted = pair.source.levelling.trusted and pair.target.levelling.trusted
        if not trusted and options.feedback:
            again = fed_back(pair, refinement, settings, raster_at)
            if again is not None and again.refinement is not None:
                tilt = again.source.levelling.tilt_deg
                if options.keep_tie_points:
                    again = _held(again, again.refinement)
                assert again.refinement is not None
                self.metadata |= {"levelled_again": True, "tilt_deg": tilt, **again.refinement.audit()}
                return again
        found = pair.with_(T_target_source=refinement.T, refinement=refinement)
        if options.keep_tie_points:
            found = _held(found, refinement)
        if options.feedback and options.keep_tie_points and found.refinement is not None:
            again = matched_coarser(pair, found.refinement, settings, raster_at)
            if again is not None and again.refinement is not None:
                self.metadata |= {"matched_again_cell_m": again.cell, **again.refinement.audit()}
                return again
        assert found.refinement is not None
        from_search = {} if found.refinement.T_solved is None else {"from_search": True}
        self.metadata |= {**from_search, **found.refinement.audit()}
        return found


def _held(pair: Pair, refinement: Refinement) -> Pair:
    """Return the pair refined; where the scene repeats itself, no farther than its tie points allow."""
    from mtpcr_geo.method.held import SLIDES_CELLS, held_to_tie_points
    from mtpcr_geo.verdict.evidence import middle_of_tie_points

    middle = middle_of_tie_points(pair)
    if pair.matches is not None and pair.matches.repeats and middle is not None:
        R_level = pair.target.T_level_work[:3, :3]
        refinement = held_to_tie_points(refinement, middle, R_level, SLIDES_CELLS * pair.cell)
    return pair.with_(T_target_source=refinement.T, refinement=refinement)


class AssessOptions(StageOptions):
    """Options of mtpcr.assess."""

    tolerance: float | None = Field(
        None,
        gt=0,
        description="plan distance within which a held-out tie point agrees, metres; if not given one cell, "
        "or two "
        "for keypoint matchers",
    )
    probability: float = Field(
        0.9,
        ge=0,
        le=1,
        description="probability of being within 5 degrees and 2 m of the truth wanted to accept",
    )
    neg_log10_p: float = Field(
        6.0,
        ge=0,
        description="where no probability is known, as of keypoint matchers: significance of the held-out "
        "tie points' agreement wanted to accept, minus log10 of the probability that chance makes as many "
        "agree",
    )
    margin: float = Field(
        1.3, ge=1, description="strength over the next distinct hypothesis wanted to accept"
    )
    agreeing: float = Field(
        0.15,
        ge=0,
        le=1,
        description="where no probability is known: share of held-out tie points that must agree to accept",
    )
    null_ratio: float = Field(
        1.8, ge=0, description="strength over the best of the mirrored source wanted to accept"
    )
    min_overlap: float | None = Field(
        None,
        ge=0,
        description="overlap wanted to accept, square metres; from the clouds' areas if not given",
    )


class Assess(Stage):
    """Judge the result by what the fit did not see: accepted, doubtful or refused, with reasons."""

    type: ClassVar[str] = "mtpcr.assess"
    needs: ClassVar[tuple[str, ...]] = ("mtpcr_geo.verdict.evidence",)
    Options: ClassVar[OptionsModel] = AssessOptions
    options: AssessOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Gather the evidence and judge."""
        from mtpcr_geo.verdict.decision import Limits, assess
        from mtpcr_geo.verdict.evidence import gather, tie_point_agrees
        from mtpcr_geo.verdict.prior import departure

        pair = self.one_pair(inputs)
        if pair.T_target_source is None or pair.tie_points is None:
            raise OptionError(f"{self.label} needs a transform and tie points; put mtpcr.solve before it")
        options = self.options
        pair = self._no_worse_than_prior(pair)
        evidence, more = gather(pair, options.tolerance)
        distances, contradictions = departure(pair)
        evidence, more = replace(evidence, contradictions=contradictions), more | distances
        limits = Limits(
            probability=options.probability,
            neg_log10_p=options.neg_log10_p,
            agreeing=options.agreeing,
            margin=options.margin,
            null_ratio=options.null_ratio,
            overlap_m2=options.min_overlap,
        )
        verdict = assess(evidence, limits, more)
        self.metadata |= {"verdict": verdict.name, "reasons": list(verdict.reasons), **verdict.metrics}
        # from here on "agrees" means one thing everywhere: with the final transform, within the tolerance
        assert pair.T_target_source is not None
        assert pair.tie_points is not None
        agreeing = tie_point_agrees(pair, pair.T_target_source, evidence.tolerance_m)
        return pair.with_(verdict=verdict, tie_points=replace(pair.tie_points, inlier=agreeing))

    def _no_worse_than_prior(self, pair: Pair) -> Pair:
        """Keep the transform known beforehand where tie points, ground and surfaces agree with it as well."""
        from mtpcr_geo.verdict.prior import prior_or_found

        if pair.T_prior is None or pair.T_target_source is None:
            return pair
        compared = prior_or_found(pair, self.options.tolerance)
        self.metadata |= {
            "tie_points_and_ground_agreeing": compared.found,
            "with_prior": compared.prior,
            "surface_residual": [compared.found_residual, compared.prior_residual],
            "prior_kept": compared.keep_prior,
        }
        return pair.with_(T_target_source=pair.T_prior) if compared.keep_prior else pair
