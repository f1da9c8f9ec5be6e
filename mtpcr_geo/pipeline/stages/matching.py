"""The stages that find matches: the image, the matcher, FOCUS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.system import core_limit
from mtpcr_geo.core.types import Appearance, Look, Pair, Side
from mtpcr_geo.pipeline.options import AskProposals, MatcherName, Models, PriorOptions, Seed, Threads
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value
from mtpcr_geo.pipeline.stages.pairs import bevs_of
from mtpcr_geo.pipeline.stages.priors import audit_of, known_place, prior_of
from mtpcr_geo.pipeline.stages.views import look_of, shown, view_as, view_of

if TYPE_CHECKING:
    from mtpcr_geo.match.base import Matcher
    from mtpcr_geo.match.prior import Prior
    from mtpcr_geo.match.registry import Network

_FOR_CORRELATION = {"yaw_step", "patch", "search_radius", "min_overlap", "proposals"}
_FOR_KEYPOINTS = {
    "models", "turns", "tolerance", "max_keypoints", "tile", "ratio", "cross_check", "device", "threads",
}  # fmt: skip
TOLERATED_ROTATION_DEG = 22.5
"""Rotation that every keypoint matcher tolerates: a yaw known as well as that needs no sweep."""


class EnhanceOptions(StageOptions):
    """Options of mtpcr.enhance."""

    look: Look = Field(
        "band_pass",
        description="image that keypoint matchers see: height above the surroundings; the paper's grey "
        "values sharpened by its two filters (paper), or by the same without their gain (paper_normalised); "
        "the paper's grey values alone (grey), or as its Eq. 3 is printed (grey_printed)",
    )


class Enhance(Stage):
    """Make the images that keypoint matchers see (Eq. 3 and 4, or band-passed heights)."""

    type: ClassVar[str] = "mtpcr.enhance"
    Options: ClassVar[OptionsModel] = EnhanceOptions
    options: EnhanceOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Make both images."""
        pair = self.one_pair(inputs)
        sides = [pair.target] if pair.source is pair.target else [pair.target, pair.source]
        done = [replace(side, appearance=self._look_at(side)) for side in sides]
        for side in done:
            assert side.appearance is not None
            image = side.appearance.image
            self.metadata[side.role] = {
                "mean_grey": float(image.mean()),
                "saturated_share": float(((image == 0) | (image == 255)).mean()),
            }
        return pair.with_(target=done[0], source=done[-1])

    def _look_at(self, side: Side) -> Appearance:
        from mtpcr_geo.method.images import grey, image_of

        if side.bev is None:
            raise OptionError(f"{self.label} needs height rasters; put mtpcr.bev before it")
        return Appearance(self.options.look, grey(side.bev), image_of(side.bev, self.options.look))


class MatchOptions(PriorOptions, StageOptions):
    """Options of mtpcr.match."""

    method: MatcherName = "correlation"
    yaw_step: float | None = Field(
        None,
        gt=0,
        le=30,
        description="step of the search over all yaws, degrees; follows from the clouds' extent if not given",
    )
    patch: float | None = Field(
        None,
        gt=0,
        description="edge of a patch of the local matches, metres; from the clouds' extent if not given",
    )
    search_radius: float | None = Field(
        None,
        gt=0,
        description="how far a patch may lie from the hypothesis, metres; from the patch if not given",
    )
    min_overlap: float | None = Field(
        None,
        ge=0,
        description="smallest overlap considered, square metres; from the clouds' area if not given",
    )
    verticals: bool = Field(
        True,
        description="where a vertical is not known and the matches under the likeliest one do not convince: "
        "level, rasterise and match again under others, and keep the strongest",
    )
    proposals: AskProposals = True
    models: Models = None
    turns: int | None = Field(
        None,
        ge=1,
        le=72,
        description="orientations in which learned matchers are tried, round the circle; the model's own if "
        "not given",
    )
    tolerance: float | None = Field(
        None,
        gt=0,
        description="plan distance within which keypoint matches agree on an orientation, metres; 1.5 cells "
        "if not given",
    )
    max_keypoints: int | None = Field(
        None, ge=8, description="keypoints of an image at most; the matcher's own if not given"
    )
    tile: int | None = Field(
        None,
        ge=128,
        description="edge of the tiles in which learned extractors work, pixels; the model's if not given",
    )
    ratio: float | None = Field(
        None,
        gt=0,
        le=1,
        description="nearest over second nearest descriptor distance at most; 0.9 or the model's own if not "
        "given, 1 turns it off",
    )
    cross_check: bool | None = Field(
        None, description="nearest neighbours must be mutual; the matcher's own if not given"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where learned matchers run; auto takes CUDA where onnxruntime offers it"
    )
    threads: Threads = 0
    seed: Seed = 0


class Match(Stage):
    """Find point pairs in the two rasters, at any yaw."""

    type: ClassVar[str] = "mtpcr.match"
    needs: ClassVar[tuple[str, ...]] = ("mtpcr_geo.match.correlation", "mtpcr_geo.pipeline.stages.hypotheses")
    Options: ClassVar[OptionsModel] = MatchOptions
    options: MatchOptions

    _matcher: Matcher | None = None
    _network: Network | None = None

    def reads(self) -> list[Path]:
        """Return the file of the prior, if there is one."""
        return [] if self.options.prior_file is None else [self.options.prior_file]

    def check(self, context: RunContext) -> None:
        """Find out whether there is such a matcher, with its files, and whether the options are its own."""
        correlation = self.options.method == "correlation"
        foreign = self.options.model_fields_set & (_FOR_KEYPOINTS if correlation else _FOR_CORRELATION)
        # options equal to the default count as not given
        fields = type(self.options).model_fields
        reported = sorted(name for name in foreign if getattr(self.options, name) != fields[name].default)
        if reported:
            kind = "keypoint matchers" if correlation else "correlation"
            raise OptionError(
                f"{self.label}: option {reported[0]!r} is one of {kind}; the method is "
                f"{self.options.method!r}"
            )
        if not correlation:
            self._matcher = self._make(None)

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Match the source's raster to the target's; under several verticals where none is known."""
        try:
            return self._run(inputs, context)
        finally:
            if self._network is not None:
                self._network.forget()

    def _run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        from mtpcr_geo.pipeline.stages.hypotheses import best_vertical
        from mtpcr_geo.pipeline.stages.rasters import with_rasters

        pair = self.one_pair(inputs)
        bevs_of(self, pair)
        known = known_place(self.options, pair, self.label)
        if known is not None:
            return self._matched(pair, context)
        if not self.options.verticals or pair.raster is None:
            return self._or_by_network(self._matched(pair, context), context)
        raster = pair.raster
        upright = pair.source.levelling.trusted and pair.target.levelling.trusted
        pair, tried = best_vertical(
            pair,
            self.options.seed,
            lambda one: self._matched(one, context, provisional=not upright),
            lambda one: self._matched(with_rasters(one, raster, context)[0], context, provisional=True),
        )
        matches = pair.matches
        assert matches is not None
        if matches.search_further is not None:
            # once, under the verticals that were found likeliest
            with context.progress.task("searching on") as advance:
                matches = replace(matches.search_further(advance), matcher=matches.matcher)
        self.metadata |= {"matches": len(matches.score), **matches.report}
        if tried:
            self.metadata["verticals"] = tried
        return self._or_by_network(pair.with_(matches=matches), context)

    def _or_by_network(self, pair: Pair, context: RunContext) -> Pair:
        """Return the pair as the network matches it, where the search by heights can't be accepted."""
        from mtpcr_geo.pipeline.stages.second_opinion import is_doubted, is_weak, matched_by_network

        options, first = self.options, pair.matches
        assert first is not None
        if options.method != "correlation" or not options.proposals:
            return pair
        if not (is_doubted(first) or is_weak(first)):
            return pair
        with context.progress.task("asking the network", None) as advance:
            network = self._asked(options.threads or core_limit())
            found, margin = matched_by_network(pair, options.seed, network, advance)
        if found is not None and found.matches is not None:
            kept = {name: self.metadata[name] for name in ("verticals",) if name in self.metadata}
            self.metadata.clear()
            self.metadata |= {"matches": len(found.matches), **found.matches.report, **kept}
            return found
        self.metadata["second_opinion"] = {"margin": margin, "taken": False}
        return pair

    def _asked(self, threads: int) -> Network:
        """Return the network, one for all questions of this stage."""
        from mtpcr_geo.match.registry import Network

        if self._network is None:
            self._network = Network(threads)
        return self._network

    def _matched(self, pair: Pair, context: RunContext, *, provisional: bool = False) -> Pair:
        source, target = bevs_of(self, pair)
        known = known_place(self.options, pair, self.label)
        prior = None if known is None else prior_of(known, pair)
        if known is not None:
            self.metadata["prior"] = audit_of(known, pair)
        trusted = pair.source.levelling.trusted and pair.target.levelling.trusted
        matcher = kept = self._matcher or self._make(prior, trusted)
        if self._matcher is None:
            # who asks again, asks about a pose that is known roughly
            matcher = self._make(prior, trusted, first=True, provisional=provisional)
        if matcher.needs_one_cell and source.grid.cell != target.grid.cell:
            raise OptionError(
                f"{self.label}: {self.options.method} needs one cell size, and the rasters have "
                f"{source.grid.cell:g} and {target.grid.cell:g} m; set resolution to common in mtpcr.bev"
            )
        if matcher.needs_image:
            pair = pair.with_(source=shown(pair.source), target=shown(pair.target))
        yaw = None
        if prior is not None and prior.yaw_range <= np.radians(TOLERATED_ROTATION_DEG):
            yaw = prior.yaw
        with context.progress.task("searching all yaws" if prior is None else "searching", None) as advance:
            matches = matcher.match(
                view_of(pair.source, matcher.needs_image),
                view_of(pair.target, matcher.needs_image),
                seed=self.options.seed,
                yaw=yaw,
                advance=advance,
            )
        self.metadata |= {"matches": len(matches.score), **matches.report}
        return pair.with_(matches=replace(matches, matcher=kept), known=known)

    def _make(
        self,
        prior: Prior | None,
        trust_vertical: bool = True,
        *,
        first: bool = False,
        provisional: bool = False,
    ) -> Matcher:
        from mtpcr_geo.match.correlation import CorrelationSettings
        from mtpcr_geo.match.registry import (
            CorrelationMatcher,
            KeypointSettings,
            make_matcher,
        )

        o = self.options
        threads = o.threads or core_limit()
        correlation = CorrelationSettings(
            yaw_step_deg=o.yaw_step,
            patch_m=o.patch,
            search_radius_m=o.search_radius,
            min_overlap_m2=o.min_overlap,
            trust_vertical=trust_vertical,
            proposals=self._asked(threads).proposals() if o.proposals and first else None,
        )
        if o.method == "correlation":
            return CorrelationMatcher(correlation, prior, provisional)
        keypoints = KeypointSettings(
            models=o.models,
            turns=o.turns,
            tolerance_m=o.tolerance,
            max_keypoints=o.max_keypoints,
            tile=o.tile,
            ratio=o.ratio,
            cross_check=o.cross_check,
            device=o.device,
            threads=threads,
        )
        return make_matcher(o.method, correlation, keypoints)


class FocusOptions(StageOptions):
    """Options of mtpcr.focus."""

    theta: float = Field(
        0.3,
        ge=0,
        le=1,
        description="overlap below which is matched again, as a share of the less covered cloud; the paper "
        "gives no value",
    )
    finer: float = Field(2.0, ge=1, le=16, description="by which the cells are divided")
    radius: float = Field(25.0, gt=0, description="of the neighbourhood of a match, metres")
    finest: float = Field(0.25, gt=0, description="cells are made no finer than this, metres")
    seed: Seed = 0


class Focus(Stage):
    """Match again at finer cells around the first matches, where the overlap is small (FOCUS)."""

    type: ClassVar[str] = "mtpcr.focus"
    Options: ClassVar[OptionsModel] = FocusOptions
    options: FocusOptions

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Ask the matcher of the first pass again."""
        from mtpcr_geo.method.focus import FocusSettings, Subject, focus

        pair = self.one_pair(inputs)
        source, target = bevs_of(self, pair)
        first = pair.matches
        if first is None or first.matcher is None:
            raise OptionError(f"{self.label} needs matches; put mtpcr.match before it")
        matcher = first.matcher
        look = look_of(pair.source) if matcher.needs_image else None
        settings = FocusSettings(
            self.options.theta, self.options.finer, self.options.radius, self.options.finest
        )
        with context.progress.task("matching again", None) as advance:
            matches = focus(
                lambda s, t, yaw: matcher.match(
                    view_as(s, look), view_as(t, look), seed=self.options.seed, yaw=yaw, advance=advance
                ),
                first,
                Subject(pair.source.levelled_sample, source.grid),
                Subject(pair.target.levelled_sample, target.grid),
                settings,
                self.options.seed,
            )
        self.metadata |= matches.report["focus"]
        return pair.with_(matches=matches)
