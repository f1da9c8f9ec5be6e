"""The values that travel from stage to stage: immutable, and filled in one step at a time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.grid import Grid

if TYPE_CHECKING:
    from mtpcr_geo.core.frames import FrameLink, WorkFrame

Floats = NDArray[np.float64]
VerdictName = Literal["accepted", "doubtful", "refused"]
Look = Literal["band_pass", "paper", "paper_normalised", "grey", "grey_printed"]
"""How the image of a raster is made that keypoint matchers see, see `mtpcr_geo.method.images.image_of`."""


@dataclass(frozen=True)
class Bev:
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


@dataclass(frozen=True)
class Appearance:
    """What keypoint matchers see of a raster.

    Attributes:
        look: how the image was made, see `mtpcr_geo.method.images.image_of`.
        plain: (h, w) uint8 the grey image of heights (Eq. 3), before any enhancement.
        image: (h, w) uint8 what is matched.

    """

    look: Look
    plain: NDArray[np.uint8]
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class Side:
    """One of the two clouds on its way through the run.

    Attributes:
        role: "source" (moves) or "target" (stays).
        cloud: the cloud as read.
        link: takes its file coordinates to its work coordinates (metric, near zero) and back.
        sample: (n, 3) float64 work coordinates, at most the budget; the whole cloud where it fits.
        T_level_work: 4x4 levelling rotation, from work to levelled coordinates (identity if upright).
        level_report: how it was levelled, for the audit.
        bev: its height raster, in levelled coordinates.
        appearance: the image made of the raster, where one was asked for.

    """

    role: Literal["source", "target"]
    cloud: Cloud
    link: FrameLink
    sample: Floats
    T_level_work: Floats = field(default_factory=lambda: np.eye(4))
    level_report: dict[str, Any] = field(default_factory=dict)
    bev: Bev | None = None
    appearance: Appearance | None = None

    @property
    def levelled_sample(self) -> Floats:
        """The sample in levelled coordinates, (n, 3) metres."""
        return transforms.apply(self.T_level_work, self.sample)


@dataclass(frozen=True)
class Hypothesis:
    """A candidate pose: levelled target = Rz(yaw) * levelled source + shift, seen from above.

    Attributes:
        yaw: radians, counter-clockwise.
        shift: (2,) metres.
        score: the correlation score by which hypotheses are ranked; higher is better.
        overlap_cells: cells that both images fill under this pose.

    """

    yaw: float
    shift: tuple[float, float]
    score: float
    overlap_cells: int = 0


@dataclass(frozen=True)
class Matches:
    """Point pairs in the two BEVs.

    Attributes:
        source_px, target_px: (n, 2) float64 pixel coordinates (column, row), pixel centres at integers.
        score: (n,) in 0..1.
        hypotheses: candidates in falling order of score; the first is the one the matches follow.
        report: what the matcher wants on record.
        source_keypoints, target_keypoints: (k, 2) pixels of all keypoints, matched or not; None from
            matchers that have none.
        matcher: what found them, so that FOCUS can ask it again.
        before_focus: the matches of the first pass, where FOCUS replaced them.

    """

    source_px: Floats
    target_px: Floats
    score: Floats
    hypotheses: tuple[Hypothesis, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)
    source_keypoints: Floats | None = None
    target_keypoints: Floats | None = None
    matcher: Any = None
    before_focus: Matches | None = None


@dataclass(frozen=True)
class TiePoints:
    """Matches lifted to 3D, in levelled work coordinates, metres.

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
    held_out: NDArray[np.bool_]
    inlier: NDArray[np.bool_]


@dataclass(frozen=True)
class Verdict:
    """The judgement of a run.

    Attributes:
        name: "accepted", "doubtful" or "refused".
        reasons: one sentence each: why it is not accepted, or what the acceptance rests on.
        metrics: the numbers behind it, with units in their names.

    """

    name: VerdictName
    reasons: tuple[str, ...]
    metrics: dict[str, Any]


@dataclass(frozen=True)
class Pair:
    """The state of a registration: two sides and what has been found so far.

    Attributes:
        target, source: the two clouds.
        frame: the work frame (target's).
        matches, tie_points: what links them, once found.
        T_target_source: 4x4 in work coordinates (source work -> target work), once solved.
        solve_report, refine_report: how it came about, for the audit.
        T_prior: 4x4 in work coordinates that was known beforehand, where a prior was asked for.
        verdict: the judgement, once made.

    """

    target: Side
    source: Side
    frame: WorkFrame
    matches: Matches | None = None
    tie_points: TiePoints | None = None
    T_target_source: Floats | None = None
    solve_report: dict[str, Any] = field(default_factory=dict)
    refine_report: dict[str, Any] = field(default_factory=dict)
    T_prior: Floats | None = None
    verdict: Verdict | None = None

    @property
    def cell(self) -> float:
        """The larger cell of both rasters, metres: how exact matches can be; 1 where there is none."""
        cells = [side.bev.grid.cell for side in (self.source, self.target) if side.bev is not None]
        return max(cells, default=1.0)

    def with_(self, **changes: Any) -> Pair:
        """Copy with some fields replaced."""
        return replace(self, **changes)
