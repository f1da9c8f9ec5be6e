"""The values that one step hands to the next: immutable, typed, filled in one step at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import ComparesArrays, Grey, Mask
from mtpcr_geo.core.arrays import Floats as Floats
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.fits import GroundFit as GroundFit
from mtpcr_geo.core.fits import IcpMethod as IcpMethod
from mtpcr_geo.core.fits import IcpResult as IcpResult
from mtpcr_geo.core.fits import IcpRound as IcpRound
from mtpcr_geo.core.fits import IcpTrial as IcpTrial
from mtpcr_geo.core.fits import Refinement as Refinement
from mtpcr_geo.core.fits import Solution as Solution
from mtpcr_geo.core.fits import SolveSettings as SolveSettings
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.prior import KnownPlace as KnownPlace
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.core.wording import visible

if TYPE_CHECKING:
    from mtpcr_geo.core.frames import FrameLink, WorkFrame

VerdictName = Literal["accepted", "doubtful", "refused"]
LevellingMethod = Literal["none", "plane", "floor", "verticals", "refinement"]
Look = Literal["band_pass", "paper", "paper_normalised", "grey", "grey_printed"]
"""How the image of a raster is made that keypoint matchers see, see `mtpcr_geo.method.images.image_of`."""


@dataclass(frozen=True, eq=False)
class Bev(ComparesArrays):
    """A height raster seen from above.

    Attributes:
        grid: where it lies, in the levelled work frame, metres.
        top: (h, w) float32 highest z per cell in metres, NaN where empty.
        low: (h, w) float32 lowest z per cell in metres, NaN where empty.
        count: (h, w) uint32 points per cell.

    """

    grid: Grid
    top: NDArray[np.float32]
    low: NDArray[np.float32]
    count: NDArray[np.uint32]

    def __repr__(self) -> str:
        """Return size, cell and the share of filled cells in one line."""
        filled = float((self.count > 0).mean()) if self.count.size else 0.0
        grid = self.grid
        return f"<Bev {grid.width} x {grid.height} cells of {grid.cell:g} m, {filled:.0%} filled>"


@dataclass(frozen=True, eq=False)
class Appearance(ComparesArrays):
    """The images that keypoint matchers see of a raster.

    Attributes:
        look: how the image was made, see `mtpcr_geo.method.images.image_of`.
        plain: (h, w) uint8 the grey image of heights (Eq. 3), before any enhancement.
        image: (h, w) uint8 what is matched.

    """

    look: Look
    plain: Grey
    image: Grey


@dataclass(frozen=True, eq=False)
class Levelling(ComparesArrays):
    """How a cloud was made upright.

    Attributes:
        T_level_work: 4x4 rotation about the sample's centre, work to levelled coordinates.
        method: "none", "plane" (the paper), "floor" (the lowest points of coarse cells), "verticals", or
            "refinement" where ICP told the vertical.
        tilt_deg: angle between the cloud's z axis and the vertical found, degrees.
        why: why it was kept as it is, where it was.
        trusted: whether the vertical is known: by the CRS, or since the user says so.
        plane_tilt_deg, plane_inlier_share: tilt of the ground plane, degrees, and share of points on it.
        verticals: points on walls, poles and trunks that agree on the vertical.
        verticals_spread_deg: their robust spread about it, degrees.
        plane_to_verticals_deg: angle between the plane's normal and the vertical, degrees.
        floor_tilt_deg, floor_share: tilt of the sheet of lowest points, degrees, and share of the cells
            whose lowest point lies near it.
        others: what the vertical may be instead, likeliest first; None where that was not looked for.

    """

    T_level_work: Floats = field(default_factory=lambda: np.eye(4))
    method: LevellingMethod = "none"
    tilt_deg: float = 0.0
    why: str | None = None
    trusted: bool = False
    plane_tilt_deg: float | None = None
    plane_inlier_share: float | None = None
    verticals: int | None = None
    verticals_spread_deg: float | None = None
    plane_to_verticals_deg: float | None = None
    floor_tilt_deg: float | None = None
    floor_share: float | None = None
    others: tuple[Levelling, ...] | None = None

    def audit(self) -> dict[str, Any]:
        """Return everything but matrices, without what is not known, for the audit."""
        names = [one.name for one in fields(self) if one.name not in ("T_level_work", "others")]
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


@dataclass(frozen=True)
class RasterSettings:
    """How rasters are made, so that they can be made again under another vertical.

    Attributes:
        cell: edge of a cell, metres; chosen from the densities if None.
        finest: no finer cell is chosen than this, metres; None where the extent of the clouds plays a part.
        resolution: "common" for one cell, "eq1" or "eq1_occupied" for a cell of each cloud's own.
        gamma: the gamma of Eq. 1, metres; None for the usual one.
        pixel: which points a cell holds: "centre" or "ceil".

    """

    cell: float | None = None
    finest: float | None = None
    resolution: Literal["common", "eq1", "eq1_occupied"] = "common"
    gamma: float | None = None
    pixel: Literal["centre", "ceil"] = "centre"


@dataclass(frozen=True, eq=False)
class Side(ComparesArrays):
    """One of the two clouds on its way through the run.

    Attributes:
        role: "source" (moves) or "target" (stays).
        cloud: the cloud as read.
        link: takes its file coordinates to its work coordinates (metric, near zero) and back.
        sample: (n, 3) float64 work coordinates, at most the budget; the whole cloud where it fits.
        complete: whether the sample is the whole cloud but for noise and no returns.
        levelling: how it was made upright.
        bev: its height raster, in levelled coordinates.
        appearance: the image made of the raster, where one was asked for.
        bounds: (2, 3) least and greatest file coordinates without noise and no returns; None to take the
            header's.
        no_returns: points that mark beams without a return: kept in what is written, and in nothing else.
        no_return_places: (k, 3) file coordinates where these are.
        strays: points that lie far from all others, likewise.
        box: (2, 3) file coordinates beyond which these lie; None where there are none.
        remarks: what the points say otherwise than the header of the file, a sentence each.
        near: (k, 3) work coordinates about the other cloud, denser than the sample there; None if it is not.

    """

    role: Literal["source", "target"]
    cloud: Cloud
    link: FrameLink
    sample: Floats
    complete: bool = True
    levelling: Levelling = field(default_factory=Levelling)
    bev: Bev | None = None
    appearance: Appearance | None = None
    bounds: Floats | None = None
    no_returns: int = 0
    no_return_places: Floats = field(default_factory=lambda: np.empty((0, 3)))
    strays: int = 0
    box: Floats | None = None
    remarks: tuple[str, ...] = ()
    near: Floats | None = None

    @property
    def T_level_work(self) -> Floats:
        """4x4 levelling rotation, from work to levelled coordinates (identity if upright)."""
        return self.levelling.T_level_work

    @property
    def levelled_sample(self) -> Floats:
        """The sample in levelled coordinates, (n, 3) metres."""
        if np.array_equal(self.T_level_work, np.eye(4)):
            return self.sample
        return transforms.apply(self.T_level_work, self.sample)


@dataclass(frozen=True)
class Hypothesis:
    """A candidate pose: levelled target = Rz(yaw) * levelled source + shift, seen from above.

    Attributes:
        yaw: radians, counter-clockwise.
        shift: (2,) metres.
        score: the score by which hypotheses are ranked; higher is better.
        overlap_cells: cells that both images fill under this pose.
        strength: what the margin between hypotheses is taken of; None where a matcher has none.

    """

    yaw: float
    shift: tuple[float, float]
    score: float
    overlap_cells: int = 0
    strength: float | None = None


@dataclass(frozen=True, eq=False)
class Matches(ComparesArrays):
    """Point pairs in the two BEVs.

    Attributes:
        source_px, target_px: (n, 2) float64 pixel coordinates (column, row), pixel centres at integers.
        score: (n,) in 0..1.
        hypotheses: candidates in falling order of score; the first is the one the matches follow.
        search_radius_m: how far a match may lie from where the best hypothesis puts it, metres; None from
            matchers that search the whole raster.
        by_chance: share of matches that agree under a pose that is surely wrong, and within how many metres;
            None where that was not measured.
        margin: strength of the best hypothesis over the next distinct one; None where there is no telling.
        support: share of the patches in the overlap that agree on the pose; None likewise.
        strength: of the best hypothesis, score times support; None from matchers that have none.
        null_ratio: strength of the best hypothesis over the best of the mirrored source; None likewise.
        mirrored_strengths: strengths of the mirrored source's hypotheses; None where it was not searched.
        repeats: whether the scene under the best hypothesis fits itself after a shift, as rows do.
        self_likeness: correlation of that scene with itself, moved; None from matchers that do not tell.
        report: further figures of the matcher, for the audit only.
        source_keypoints, target_keypoints: (k, 2) pixels of all keypoints, matched or not; None from
            matchers that have none.
        matcher: what found them, so that FOCUS can ask it again.
        before_focus: the matches of the first pass, where FOCUS replaced them.
        search_further: carries on a search that was left off, and returns its matches; it is given what is
            called with 1 after each yaw searched. None where there is nothing more to do.

    """

    source_px: Floats
    target_px: Floats
    score: Floats
    hypotheses: tuple[Hypothesis, ...] = ()
    search_radius_m: float | None = None
    by_chance: tuple[float, float] | None = None
    margin: float | None = None
    support: float | None = None
    null_ratio: float | None = None
    strength: float | None = None
    mirrored_strengths: tuple[float, ...] | None = None
    repeats: bool = False
    self_likeness: float | None = None
    report: Mapping[str, Any] = field(default_factory=dict)
    source_keypoints: Floats | None = None
    target_keypoints: Floats | None = None
    matcher: Any = None
    before_focus: Matches | None = None
    search_further: Callable[[Callable[[int], object]], Matches] | None = None

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True, eq=False)
class TiePoints(ComparesArrays):
    """Matches mapped back to 3D (Eq. 5), in levelled work coordinates, metres.

    Attributes:
        source, target: (n, 3) float64.
        score: (n,) in 0..1.
        fold: (n,) which of the folds a tie point is in, for cross-validation.
        held_out: (n,) bool, True for tie points kept from the solve to judge it: the first fold.
        inlier: (n,) bool, True for tie points that agree with the solved transform.

    """

    source: Floats
    target: Floats
    score: Floats
    fold: NDArray[np.int64]
    held_out: Mask
    inlier: Mask

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True)
class Rival:
    """Another pose that fits nearly as well as the one found.

    Attributes:
        east_m, north_m: where it puts the middle of the tie points, from where the pose found does, metres.
        turn_deg: by how much it is turned against the pose found, -180 to 180 degrees, counter-clockwise.
        margin: strength of the pose found over its own.
        far: whether it is another place, and not the same a little off.

    """

    east_m: float
    north_m: float
    turn_deg: float
    margin: float
    far: bool

    @property
    def apart_m(self) -> float:
        """Distance in plan, metres."""
        return float(np.hypot(self.east_m, self.north_m))


@dataclass(frozen=True)
class Check:
    """One check of a verdict.

    Attributes:
        name: what is checked, in a few words.
        value: what was found.
        wanted: what is wanted.
        passed: whether it is met; None where it could not be checked, or only informs.
        meaning: what the figure is, in a sentence.
        decides: whether the verdict depends on it; else it warns.

    """

    name: str
    value: str
    wanted: str
    passed: bool | None
    meaning: str
    decides: bool = True

    @property
    def status(self) -> str:
        """Return "passed", "not passed", "warning" or "not checked"."""
        if self.passed is None:
            return "not checked"
        return "passed" if self.passed else "not passed" if self.decides else "warning"


@dataclass(frozen=True)
class Verdict:
    """The judgement of a run.

    Attributes:
        name: "accepted", "doubtful" or "refused".
        reasons: one sentence each: why it is not accepted, or what the acceptance rests on; then what could
            not be checked.
        metrics: the numbers behind it, with units in their names.
        rivals: other poses that fit nearly as well, the strongest first.
        sentence: verdict, probability and expected accuracy in one sentence.
        checks: what was checked, each with what was wanted.
        uncertainty: of the pose; None where too little agrees to tell.

    """

    name: VerdictName
    reasons: tuple[str, ...]
    metrics: dict[str, Any]
    rivals: tuple[Rival, ...] = ()
    sentence: str = ""
    checks: tuple[Check, ...] = ()
    uncertainty: Uncertainty | None = None

    @property
    def headline(self) -> str:
        """The sentence, or where nothing was judged the verdict and its first reason."""
        return self.sentence or f"{self.name.capitalize()}: {'; '.join(self.reasons[:1]) or 'not judged'}."

    def __post_init__(self) -> None:
        # they name clouds and CRSs, and go to terminals, pages and files
        object.__setattr__(self, "reasons", tuple(visible(reason) for reason in self.reasons))
        object.__setattr__(self, "sentence", visible(self.sentence))

    @property
    def withholds_transform(self) -> str | None:
        """Why the transform files are written only if forced; None where they are written."""
        return "the verdict is refused" if self.name == "refused" else None

    @property
    def withholds_cloud(self) -> str | None:
        """Why the registered cloud is written only if forced; None where it is written."""
        if self.name == "doubtful" and any(rival.far for rival in self.rivals):
            return "another pose, far from this one, fits nearly as well"
        return self.withholds_transform


@dataclass(frozen=True, eq=False)
class Pair(ComparesArrays):
    """The state of a registration: two sides and what has been found so far.

    Attributes:
        target, source: the two clouds.
        frame: the work frame (target's).
        raster: how the rasters were made, once they were.
        matches, tie_points: what links them, once found.
        T_target_source: 4x4 in work coordinates (source work -> target work), once solved.
        solution: how it was solved.
        refinement: how it was refined.
        known: what was known beforehand of the source's place and yaw, where a prior was given.
        verdict: the judgement, once made.

    """

    target: Side
    source: Side
    frame: WorkFrame
    raster: RasterSettings | None = None
    matches: Matches | None = None
    tie_points: TiePoints | None = None
    T_target_source: Floats | None = None
    solution: Solution | None = None
    refinement: Refinement | None = None
    known: KnownPlace | None = None
    verdict: Verdict | None = None

    @property
    def cell(self) -> float:
        """The larger cell of both rasters, metres: how exact matches can be; 1 where there is none."""
        cells = [side.bev.grid.cell for side in (self.source, self.target) if side.bev is not None]
        return max(cells, default=1.0)

    @property
    def T_prior(self) -> Floats | None:
        """4x4 in work coordinates that was known beforehand; None where no whole pose was."""
        return None if self.known is None else self.known.T

    @property
    def T_level_target_source(self) -> Floats:
        """4x4 from levelled source to levelled target coordinates.

        Raises:
            ValueError: if the pair has no transform yet.

        """
        if self.T_target_source is None:
            raise ValueError("the pair has no transform yet")
        return self.levelled(self.T_target_source)

    def levelled(self, T_target_source: Floats) -> Floats:
        """Take a 4x4 between work coordinates to the same between levelled coordinates."""
        return np.asarray(
            self.target.T_level_work @ T_target_source @ transforms.inverse(self.source.T_level_work)
        )

    def with_(self, **changes: Any) -> Pair:
        """Copy with some fields replaced."""
        return replace(self, **changes)
