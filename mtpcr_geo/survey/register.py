"""Registering a cloud to a survey: found in the mosaic, then registered to the points there as to any target.

The verdict is that of a pair, and every number in it keeps its meaning, but what the pose is held against is
the whole survey: the margin is the lesser of those over the rivals at the place and over the rivals anywhere
in what was searched, and so is the strength over the mirrored source.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.core.paths import real
from mtpcr_geo.core.progress import NoProgress, Progress
from mtpcr_geo.core.system import cores
from mtpcr_geo.core.types import Hypothesis, Levelling, Matches, Pair
from mtpcr_geo.io.formats import files_at, open_any
from mtpcr_geo.io.memory import cloud_of
from mtpcr_geo.match.base import LARGEST_MARGIN, Advance, View
from mtpcr_geo.match.correlation import CorrelationSettings, match
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.runner import run
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, Value, chained
from mtpcr_geo.pipeline.stages.matching import Match, MatchOptions
from mtpcr_geo.pipeline.stages.memory import MemoryReader
from mtpcr_geo.pipeline.stages.pairs import bevs_of
from mtpcr_geo.pipeline.stages.priors import audit_of, known_place
from mtpcr_geo.pipeline.stages.rasters import Level, LevelOptions
from mtpcr_geo.pipeline.stages.steps import further_files, reader_of, steps_of, writers_for
from mtpcr_geo.pipeline.stages.views import view_of
from mtpcr_geo.registration import Registration, read_options
from mtpcr_geo.survey.cut import CutOut, cut_out
from mtpcr_geo.survey.index import Survey
from mtpcr_geo.survey.locate import Located, locate
from mtpcr_geo.survey.search import FoundPlace

if TYPE_CHECKING:
    from mtpcr_geo.core.arrays import Floats
    from mtpcr_geo.core.frames import FrameLink
    from mtpcr_geo.io.memory import CloudLike
    from mtpcr_geo.io.sample import Scan

NEAR_YAW_DEG = 10.0
"""How far the pose is sought again from the yaw that the mosaic gave, on the points themselves."""


@dataclass(frozen=True, eq=False)
class SurveyMatcher:
    """Matches around the place that a survey gave, and holds the pose against all that was searched.

    Whoever matches again, under another vertical, asks the same matcher, and so has the same rivals.

    Attributes:
        settings: what governs the search.
        prior: where the pose is sought.
        located: what the survey gave.
        hypotheses: of the survey, best first, between the levelled clouds.

    """

    settings: CorrelationSettings
    prior: Prior
    located: Located
    hypotheses: tuple[Hypothesis, ...]
    needs_image: bool = False
    needs_one_cell: bool = True

    def match(
        self,
        source: View,
        target: View,
        *,
        seed: int = 0,
        yaw: float | None = None,
        advance: Advance = lambda n: None,
    ) -> Matches:
        """Match two rasters, see `mtpcr_geo.match.base.Matcher.match`; a known yaw is not made use of."""
        found = match(source.bev, target.bev, self.settings, seed, advance, self.prior)
        return in_survey(found, self.located.found, self.hypotheses)


class LevelInSurvey(Level):
    """Levels as usual, but does not look again at the source, which the search has scanned and levelled."""

    def __init__(self, options: LevelOptions, tag: str, located: Located) -> None:
        super().__init__(options, tag)
        self.located = located

    def scanned(self, role: Literal["target", "source"], cloud: Cloud, context: RunContext) -> Scan:
        """Return what one pass over a cloud gives."""
        return self.located.scan if role == "source" else super().scanned(role, cloud, context)

    def levelled(self, role: Literal["target", "source"], link: FrameLink, sample: Floats) -> Levelling:
        """Return the rotation that makes a cloud upright, from a sample (n, 3) in work coordinates."""
        known = self.located.source
        if role == "source" and np.array_equal(sample, known.sample):
            return known.levelling
        return super().levelled(role, link, sample)


class MatchInSurvey(Stage):
    """Match the source to what was cut out of a survey, near where the survey's mosaic puts it."""

    type: ClassVar[str] = "mtpcr.match"
    Options: ClassVar[OptionsModel] = MatchOptions
    options: MatchOptions

    def __init__(self, options: MatchOptions, tag: str, located: Located, cut: CutOut) -> None:
        super().__init__(options, tag)
        self.located, self.cut = located, cut

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Match around the place found, and hold the pose against what the survey has elsewhere."""
        pair = self.one_pair(inputs)
        source, _ = bevs_of(self, pair)
        known = known_place(self.options, pair, self.label)
        if known is not None:
            self.metadata["prior"] = audit_of(known, pair)
        trusted = pair.source.levelling.trusted and pair.target.levelling.trusted
        hypotheses = tuple(self._hypothesis(one.pose, pair) for one in self.located.found.pool.candidates)
        scales = self.located.found.scales
        pivot = (float(self.located.pivot[0]), float(self.located.pivot[1]))
        radius = max(scales.same_pose_m, 4.0 * max(scales.cell_m, source.grid.cell))
        prior = Prior.around(hypotheses[0], pivot, radius, float(np.radians(NEAR_YAW_DEG)))
        settings = CorrelationSettings(trust_vertical=trusted)
        matcher = SurveyMatcher(settings, prior, self.located, hypotheses)
        with context.progress.task("searching", None) as advance:
            matches = matcher.match(
                view_of(pair.source, False),
                view_of(pair.target, False),
                seed=self.options.seed,
                advance=advance,
            )
        self.metadata |= {"matches": len(matches), **matches.report, "survey": self._report()}
        return pair.with_(matches=replace(matches, matcher=matcher), known=known)

    def _hypothesis(self, pose: Pose, pair: Pair) -> Hypothesis:
        """Express a pose in the survey as one between the levelled clouds."""
        place = np.array([pose.east, pose.north]) + self.located.found.origin
        work = np.array([[*place, 0.0]]) - pair.target.link.origin
        east, north, _ = transforms.apply(pair.target.T_level_work, work)[0]
        moved = Pose(pose.yaw, float(east), float(north), pose.score, pose.overlap_cells)
        return moved.hypothesis(self.located.pivot)

    def _report(self) -> dict[str, Any]:
        found = self.located.found
        return {
            "place": self.located.place.tolist(),
            "yaw_deg": float(np.degrees(found.best.pose.yaw)),
            "cell_m": found.scales.cell_m,
            "searched": [{"cell_m": cell, "windows": count} for cell, count in found.searched],
            "hypotheses": found.proposed,
            "margin": found.pool.margin,
            "null_ratio": found.null_ratio,
            "strengths": [round(strength, 3) for strength in found.pool.strengths],
            "mirrored_strengths": [round(one.strength, 3) for one in found.mirrored.candidates],
            "cut_out": self.cut.box.tolist(),
            "tiles": [
                {"path": str(tile.path), "bytes": tile.size, "modified_ns": tile.modified_ns}
                for tile in self.cut.tiles
            ],
        }


def in_survey(matches: Matches, found: FoundPlace, hypotheses: Sequence[Hypothesis]) -> Matches:
    """Return matches at a place with the rivals and the mirrored world of the whole survey.

    Strengths depend on the cell; those of the survey are scaled so that its best equals the place's.

    Args:
        matches: of the source to the points at the place.
        found: what the search of the survey found.
        hypotheses: of the survey, best first, between the levelled clouds that were matched.

    """
    strength = matches.strength or 0.0
    best = found.best.strength
    scale = strength / best if best > 0.0 else 0.0
    ranked = found.pool.strengths
    first = ranked[0] if ranked else 0.0
    elsewhere = [
        replace(one, strength=strength * value / first)
        for one, value in zip(hypotheses[1:], ranked[1:], strict=True)
        if first > 0.0 and not _same(one, matches.hypotheses[0], found)
    ]
    further = sorted([*matches.hypotheses[1:], *elsewhere], key=lambda one: -(one.strength or 0.0))
    mirrored = [*(matches.mirrored_strengths or ()), *(c.strength * scale for c in found.mirrored.candidates)]
    ratios = [ratio for ratio in (matches.null_ratio, found.null_ratio) if ratio is not None]
    margin = min(found.pool.margin, LARGEST_MARGIN if matches.margin is None else matches.margin)
    every = tuple(sorted(mirrored, reverse=True))
    report = {
        **matches.report,
        "margin": margin,
        "null_ratio": min(ratios),
        "mirrored_strengths": [round(one, 3) for one in every],
        "margin_at_the_place": matches.margin,
        "null_ratio_at_the_place": matches.null_ratio,
    }
    return replace(
        matches,
        hypotheses=(matches.hypotheses[0], *further),
        margin=margin,
        null_ratio=min(ratios),
        mirrored_strengths=every,
        report=report,
    )


def _same(one: Hypothesis, other: Hypothesis, found: FoundPlace) -> bool:
    """Return whether two hypotheses put the source's middle at one place, turned alike."""
    from mtpcr_geo.match.candidates import SAME_YAW_DEG
    from mtpcr_geo.match.pose import pose_of

    a, b = pose_of(one, found.pivot), pose_of(other, found.pivot)
    near = float(np.hypot(a.east - b.east, a.north - b.north)) < found.scales.same_pose_m
    return near and angle_between(a.yaw, b.yaw) < np.radians(SAME_YAW_DEG)


def register_in_survey(
    source: CloudLike,
    survey: str | os.PathLike[str] | Survey,
    out: str | os.PathLike[str] | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Registration:
    """Find a cloud in a survey, and register it to the points of the tiles there.

    Args:
        source: the cloud that moves, as `mtpcr_geo.register` takes it.
        survey: the survey, or its folder.
        out: folder for the result and its evidence, as of `mtpcr_geo.register`; nothing is written if None.
        progress: receives the progress of long steps.
        options: fields of `mtpcr_geo.pipeline.options.RegisterOptions`.

    Returns:
        The result, as of `mtpcr_geo.register`. Its margin and its strength over the mirrored source are those
        over the whole survey, or what of it the options leave to search.

    Raises:
        RegistrationError: if nowhere in the survey is anything to compare.
        MtpcrError: if an input, an option or an output cannot be used; nothing is written then.

    """
    chosen = read_options({"recording": out is not None, **options})
    _check(chosen)
    opened = survey if isinstance(survey, Survey) else Survey.open(survey)
    progress = progress or NoProgress()
    reader = reader_of(source, "source", chosen.source_text)
    cloud: Cloud = (
        open_any(Path(source), None, chosen.source_text)
        if isinstance(source, str | os.PathLike)
        else cloud_of(source, "source")
    )
    writers = [] if out is None else writers_for(source, Path(out), chosen)
    _refuse_existing(writers, chosen)
    _check_foreign(source, opened)
    with cores(chosen.threads):
        located = locate(cloud, opened, chosen, progress)
        cut = cut_out(opened, located.box)
        steps = [_in_survey(stage, located, cut) for stage in steps_of(chosen)]
        nodes = [*chained([MemoryReader(cut, "target")]), *chained([reader])]
        nodes += chained(steps, ("target", "source"))
        if out is None:
            return Registration(run(nodes, progress=progress), chosen)
        nodes += chained(writers, (nodes[-1].tag,))
        earlier = further_files(Path(out))
        result = run(nodes, overwrite=chosen.overwrite, progress=progress, replaces=earlier)
    return Registration(result, chosen)


def _in_survey(stage: Stage, located: Located, cut: CutOut) -> Stage:
    """Return what a stage is in a survey."""
    if isinstance(stage, Match):
        return MatchInSurvey(stage.options, stage.tag, located, cut)
    if isinstance(stage, Level):
        return LevelInSurvey(stage.options, stage.tag, located)
    return stage


def _check(options: RegisterOptions) -> None:
    """Refuse options that have no meaning for a survey.

    Raises:
        OptionError: naming the option.

    """
    rules = (
        (options.profile != "default", "--profile paper"),
        (options.matcher not in (None, "correlation"), f"--matcher {options.matcher}"),
        (options.local, "--local (for a local scan give --source-crs local)"),
        (options.target_crs is not None, "--target-crs (survey build --crs says it)"),
        (options.target_unit is not None, "--target-unit"),
        (options.target_axes != "z-up", "--target-axes"),
        (options.target_text is not None, "--target-text"),
    )
    for wrong, name in rules:
        if wrong:
            raise OptionError(f"{name} does not go with a survey as the target; leave it out")


def _check_foreign(source: CloudLike, survey: Survey) -> None:
    """Refuse a source that is a tile of the survey: it would fit itself perfectly.

    Raises:
        InputError: naming it.

    """
    if not isinstance(source, str | os.PathLike):
        return
    tiles = {tile.path for tile in survey.tiles}
    own = next((path for path in files_at(Path(source)) if real(path) in tiles), None)
    if own is not None:
        raise InputError(f"{own} is a tile of the survey {survey.folder}; give a cloud that is none")


def _refuse_existing(writers: Sequence[Stage], options: RegisterOptions) -> None:
    """Refuse outputs that may not be written before the long search, and not behind it."""
    from mtpcr_geo.io.outputs import OutputSet

    with OutputSet(options.overwrite) as outputs:
        for stage in writers:
            for path in stage.writes():
                if "#" not in path.name:
                    outputs.check(path)
