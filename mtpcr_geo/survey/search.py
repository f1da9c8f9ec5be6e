"""Finding a scan in a survey: the search of a pair, in windows of the mosaic, coarse to fine.

A coarse level is searched over all yaws and shifts, window by window. What it proposes, from the whole survey
together, is followed down to finer cells in small windows, the best of it to the finest, and judged there
like the hypotheses of a pair: by patches and by the ground. So is the mirrored source, which has no right
pose anywhere. The best is thus held against its rivals and against chance wherever in the survey they lie.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from threading import Lock

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import Bev
from mtpcr_geo.match.candidates import Candidate, Pool
from mtpcr_geo.match.correlation import CorrelationSettings, mirror
from mtpcr_geo.match.descent import follow
from mtpcr_geo.match.exploration import (
    COARSEST_YAW_STEP_DEG,
    CONVINCING_NULL_RATIO,
    FEWEST_OVERLAP_CELLS,
    FINEST_YAW_STEP_DEG,
    HYPOTHESES,
    PROMISING_NEG_LOG10_P,
)
from mtpcr_geo.match.judge import CLEAR_MARGIN, Judge
from mtpcr_geo.match.pose import Pose, centre_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.pyramid import COARSEST_SEARCH_M, LARGEST_SEARCH, Pyramid
from mtpcr_geo.match.search import GlobalSearch, Layer, all_yaws, distinct
from mtpcr_geo.match.terrain import Terrain
from mtpcr_geo.method.bev import coarsen
from mtpcr_geo.method.ground import bare
from mtpcr_geo.method.images import channels
from mtpcr_geo.method.scales import Scales, filled_share, occupied_area, scales_for
from mtpcr_geo.survey.levels import MARGIN_M, Ground, widened, windows
from mtpcr_geo.survey.mosaic import FACTORS
from mtpcr_geo.survey.sought import Sought, Window

FEWEST_ACROSS = 24
"""Cells along the source's raster that the coarsest level leaves at least."""
LEVELS = 2
PEAKS_A_YAW = 8
"""Shifts that a window proposes at each yaw: it has room for more places than a pair has."""
FEWEST_PROPOSED, PROPOSED = 24, 192
"""Hypotheses of a level that are followed down to the middle level, at least and at most: the more, the more
places the source may lie in."""
FEWEST_JUDGED, JUDGED = 12, 24
"""Of these, hypotheses that are followed to the finest level and judged."""
DESCENT = 2
"""The middle level's cells are those of the searched one divided by this."""
CHUNK_M = 1000.0
"""Edge of the windows in which hypotheses are followed to the middle level together."""

FEW_CELLS = 1_000_000
"""Finest cells of all that is searched up to which they are read once for all hypotheses."""
AT_ONCE = 4
"""Hypotheses whose finest windows are held at once."""

Advance = Callable[[int], object]


@dataclass(frozen=True, eq=False)
class FoundPlace:
    """What a search of a survey found.

    Attributes:
        pool: hypotheses, best first; poses are about the middle of the source's raster, metres from `origin`.
        mirrored: those of the mirrored source.
        origin: (2,) metres from the CRS's origin.
        pivot: (2,) the middle of the source's raster in the levelled source's frame, metres.
        reach_m: how far the raster reaches from there, metres.
        scales: lengths of the judgement.
        searched: cell of each level that was searched, and how many windows it had.
        proposed: hypotheses that were followed.

    """

    pool: Pool
    mirrored: Pool
    origin: Floats
    pivot: Floats
    reach_m: float
    scales: Scales
    searched: tuple[tuple[float, int], ...]
    proposed: int

    @property
    def best(self) -> Candidate:
        """The strongest hypothesis."""
        return self.pool.candidates[0]

    @property
    def null_ratio(self) -> float:
        """Strength of the best over the best of the mirrored source anywhere in the survey."""
        return self.pool.over(self.mirrored)

    @property
    def place(self) -> Floats:
        """(2,) where the middle of the source's raster lies, metres from the CRS's origin."""
        return np.array([self.best.pose.east, self.best.pose.north]) + self.origin


def search(
    source: Bev,
    ground: Ground,
    settings: CorrelationSettings,
    seed: int = 0,
    prior: Prior | None = None,
    advance: Advance = lambda n: None,
) -> FoundPlace:
    """Search a survey for a source.

    Args:
        source: its height raster at the survey's finest cell, levelled.
        ground: the survey's mosaic.
        settings: what governs the search.
        seed: of the sampling when patches vote.
        prior: what is known of the pose, in metres from the ground's origin; None to search everywhere.
        advance: called with 1 after each yaw of each window.

    Raises:
        RegistrationError: if no place shares enough with the source to be compared.

    """
    return _Search(source, ground, settings, seed, prior, advance).run()


class _Search:
    """The search of one source: see `search`."""

    def __init__(
        self,
        source: Bev,
        ground: Ground,
        settings: CorrelationSettings,
        seed: int,
        prior: Prior | None,
        advance: Advance,
    ) -> None:
        self.ground, self.settings, self.seed, self.advance = ground, settings, seed, advance
        self.cell = source.grid.cell
        self.area = occupied_area(source)
        self.fill = filled_share(source)
        self.scales = scales_for(self.cell, self.area, self.fill)
        self.both = [
            Sought(bev, known, Terrain.of(bare(bev), self.scales.terrain_cell_m))
            for bev, known in ((source, prior), (mirror(source), None if prior is None else prior.mirrored()))
        ]
        self.pools = [Pool(), Pool()]
        self.judged: list[list[Candidate]] = [[], []]
        self.searched: list[tuple[float, int]] = []
        self.proposed = 0
        self.told = False
        self._over_all: dict[int, Pyramid] = {}
        self._terrains: dict[float, Terrain] = {}
        self._lock = Lock()

    def run(self) -> FoundPlace:
        for factor in self._factors():
            proposed = self._propose(factor)
            self.proposed += len(proposed[0])
            middle = max(1, factor // DESCENT)
            best = self._followed(factor, middle, proposed)
            self._judge(middle, best)
            if self._settles():
                break
        if not self.pools[0].candidates:
            raise RegistrationError(
                "no place of the survey shares enough with the source to be compared; is it another region, "
                "or does --near name another place?"
            )
        source = self.both[0]
        return FoundPlace(
            self.pools[0],
            self.pools[1],
            self.ground.origin,
            centre_of(source.grid),
            source.reach_m,
            self.scales,
            tuple(self.searched),
            self.proposed,
        )

    def _factors(self) -> list[int]:
        """Choose the levels that are searched over all yaws, coarsest first."""
        across = max(self.both[0].grid.shape)
        wanted = max(min(across / FEWEST_ACROSS, COARSEST_SEARCH_M / self.cell), 1.0)
        # the turned source must leave most of a window to search
        least = 4.0 * self.both[0].reach_m / self.cell / LARGEST_SEARCH
        fitting = [factor for factor in FACTORS if factor >= least] or [FACTORS[-1]]
        first = max((factor for factor in fitting if factor <= wanted), default=fitting[0])
        return [one for one in reversed(fitting) if one <= first][:LEVELS]

    def _region(self) -> Floats:
        """Return where the source may lie: the survey, or what a prior leaves of it."""
        source, bounds = self.both[0], self.ground.bounds
        if source.prior is None or source.prior.place is None:
            return bounds
        off = float(np.hypot(*(centre_of(source.grid) - source.prior.pivot)))
        near = np.tile(np.asarray(source.prior.place), (2, 1))
        near = widened(near, source.prior.radius_m + off + source.reach_m)
        return np.stack([np.maximum(near[0], bounds[0]), np.minimum(near[1], bounds[1])])

    def _propose(self, factor: int) -> list[list[Pose]]:
        """Return what a level proposes for the source and its mirror image, about that level's centres."""
        region, cell = self._region(), self.cell * factor
        if (region[0] >= region[1]).any():
            return [[], []]
        layers = [_layer(one.bev, factor) for one in self.both]
        # a pose belongs to the window that holds its middle; the source may reach beyond
        reach = self.both[0].reach_m
        edge = LARGEST_SEARCH * cell - 4.0 * reach - 2.0 * MARGIN_M
        parts = list(windows(region, max(edge, reach)))
        self.searched.append((cell, len(parts)))
        step = self._yaw_step(layers[0])
        found: list[list[Pose]] = [[], []]
        for window in parts:
            target = self.ground.layer(widened(window, reach), factor)
            if not target.channels.mask.any():
                continue
            for number, (one, layer) in enumerate(zip(self.both, layers, strict=True)):
                found[number] += self._propose_in(window, one, layer, target, step)
        return [
            distinct(sorted(poses, key=lambda pose: -pose.score), self._most(), 2 * step, 5 * cell)
            for poses in found
        ]

    def _propose_in(
        self, window: Floats, one: Sought, source: Layer, target: Layer, step: float
    ) -> list[Pose]:
        prior = one.prior
        reached = target if prior is None else prior.layer(source.grid, target)
        if reached is None:
            return []
        search = GlobalSearch(source, reached, self._fewest(source))
        yaws = all_yaws(step)
        if prior is not None:
            yaws = prior.yaws(step)
            place = prior.place_of(source.grid)
            if place is not None:
                search.restrict(place, prior.radius_m)
        poses = search.run(yaws, PEAKS_A_YAW, 4, self.advance)
        slack = source.grid.cell
        return [
            pose
            for pose in poses
            if (window[0] - slack <= (pose.east, pose.north)).all()
            and (window[1] + slack >= (pose.east, pose.north)).all()
        ]

    def _most(self) -> int:
        """Return how many hypotheses are worth following, by how much land the source's middle may lie on."""
        prior = self.both[0].prior
        land = float(np.prod(self.ground.bounds[1] - self.ground.bounds[0]))
        if prior is not None and prior.place is not None:
            land = min(land, np.pi * prior.radius_m**2)
        return int(np.clip(HYPOTHESES * land / self.area, FEWEST_PROPOSED, PROPOSED))

    def _yaw_step(self, source: Layer) -> float:
        """Step over all yaws, radians: about a cell and a half at the source's rim."""
        if self.settings.yaw_step_deg is not None:
            return float(np.radians(self.settings.yaw_step_deg))
        step = np.degrees(1.5 / max(max(source.grid.shape) / 2, 1.0))
        return float(np.radians(np.clip(step, FINEST_YAW_STEP_DEG, COARSEST_YAW_STEP_DEG)))

    def _fewest(self, source: Layer) -> float:
        """Return how many cells of a level both must fill at a pose for it to be considered."""
        least = self.settings.min_overlap_m2
        least = self.scales.least_overlap_m2 if least is None else least
        share = self.settings.min_overlap_share * float(source.channels.mask.sum())
        return max(least / source.grid.cell**2, share, FEWEST_OVERLAP_CELLS)

    def _followed(self, factor: int, middle: int, proposed: list[list[Pose]]) -> list[list[Pose]]:
        """Follow hypotheses down to the middle level, those of a part of the survey together.

        Returns:
            The best of each source, about the centre of its raster at the middle level.

        """
        most = int(np.clip(max(len(poses) for poses in proposed) // 4, FEWEST_JUDGED, JUDGED))
        if middle == factor:
            return [poses[:most] for poses in proposed]
        coarse = [coarsen(one.bev, middle) for one in self.both]
        above = [coarsen(one.bev, factor).grid for one in self.both]
        chunks: dict[tuple[int, int], list[list[Pose]]] = {}
        for number, poses in enumerate(proposed):
            for pose in poses:
                key = (int(pose.east // CHUNK_M), int(pose.north // CHUNK_M))
                chunks.setdefault(key, [[], []])[number].append(pose)
        made: list[dict[int, Layer]] = [{}, {}]
        found: list[list[Pose]] = [[], []]
        reach = max(one.reach_m for one in self.both) + MARGIN_M
        for key in sorted(chunks):
            here = chunks[key]
            held = np.array([(pose.east, pose.north) for pose in here[0] + here[1]])
            target = self.ground.bev(widened(np.stack([held.min(axis=0), held.max(axis=0)]), reach), middle)
            shared: Pyramid | None = None
            for number, some in enumerate(here):
                pyramid = Window(coarse[number], target, made[number], shared)
                shared = pyramid
                fine = [
                    self.both[number].pose_at(p, above[number], pyramid.at(factor // middle)[0].grid)
                    for p in some
                ]
                found[number] += follow(pyramid, factor // middle, fine).poses
        step, apart = np.radians(COARSEST_YAW_STEP_DEG), 3 * self.cell * middle
        return [
            distinct(sorted(poses, key=lambda pose: -pose.score), most, float(step), apart) for poses in found
        ]

    def _judge(self, middle: int, best: list[list[Pose]]) -> None:
        """Follow the best to the finest cells and judge them there: first the source's, then its mirror's."""
        for number, poses in enumerate(best):
            one, judged = self.both[number], self.judged[number]
            grid = coarsen(one.bev, middle).grid
            poses = [pose for pose in poses if np.isfinite(pose.score)]
            if poses and not self.told:
                # the likeliest place tells how densely the survey is filled
                fill = self.fill * filled_share(self._around(one, poses[0]))
                self.scales, self.told = scales_for(self.cell, self.area, fill), True
            known = max([0.0, *(candidate.strength for candidate in judged)])
            if number == 1 and self.pools[0].candidates:
                known = max(known, self.pools[0].candidates[0].strength)
            left = self.pools[number].bound
            for start in range(0, len(poses), AT_ONCE):
                for pose, pyramid in self._fine(one, middle, grid, poses[start : start + AT_ONCE]):
                    if pose.score * CLEAR_MARGIN < known:
                        # as in `Judge.judge`: its strength is at most its score
                        left = max(left, pose.score)
                        continue
                    some, unjudged = self._judge_with(one, pyramid).judge([pose], known)
                    left = max([left, *(one.score for one in unjudged)])
                    judged += some
                    known = max([known, *(candidate.strength for candidate in some)])
            self._rank(number, left)

    def _around(self, one: Sought, pose: Pose) -> Bev:
        """Read the finest cells that a source can fill at a pose about its middle."""
        here = np.tile(np.array([pose.east, pose.north]), (2, 1))
        return self.ground.bev(widened(here, one.reach_m + MARGIN_M), 1)

    @cached_property
    def _all_cells(self) -> Bev | None:
        """The finest cells of all that is searched, where these are few; None where they are many."""
        region = self._region()
        if (region[0] >= region[1]).any():
            return None
        region = widened(region, MARGIN_M)
        if float(np.prod((region[1] - region[0]) / self.cell)) > FEW_CELLS:
            return None
        return self.ground.bev(region, 1)

    def _fine(
        self, one: Sought, middle: int, grid: Grid, poses: Sequence[Pose]
    ) -> list[tuple[Pose, Pyramid]]:
        """Follow poses to the finest cells, each in a window of its own."""

        def made(pose: Pose) -> tuple[Pose, Pyramid]:
            pyramid = self._over(one, pose)
            start = one.pose_at(pose, grid, pyramid.at(middle)[0].grid)
            return follow(pyramid, middle, [start]).poses[0], pyramid

        with ThreadPoolExecutor(usable_cores()) as threads:
            return [found for found in threads.map(made, poses) if np.isfinite(found[0].score)]

    def _over(self, one: Sought, pose: Pose) -> Pyramid:
        """Return the levels of a source and the finest cells around a pose."""
        if self._all_cells is None:
            return one.over(self._around(one, pose))
        key = id(one)
        with self._lock:
            if key not in self._over_all:
                shared = next(iter(self._over_all.values()), None)
                self._over_all[key] = one.over(self._all_cells, shared)
            return self._over_all[key]

    def _terrain_of(self, pyramid: Pyramid) -> Terrain:
        """Return the bare ground of a window; that of all cells is made once for each way to see it."""
        cell = self.scales.terrain_cell_m
        if pyramid.target is not self._all_cells:
            return Terrain.of(bare(pyramid.target), cell)
        if cell not in self._terrains:
            self._terrains[cell] = Terrain.of(bare(pyramid.target), cell)
        return self._terrains[cell]

    def _judge_with(self, one: Sought, pyramid: Pyramid) -> Judge:
        settings = self.settings
        patch, radius = settings.patch_m, settings.search_radius_m
        return Judge(
            pyramid,
            (one.ground, self._terrain_of(pyramid)),
            self.scales,
            patch_m=self.scales.patch_m if patch is None else patch,
            search_radius_m=self.scales.search_radius_m if radius is None else radius,
            trust_vertical=settings.trust_vertical,
            seed=self.seed,
        )

    def _rank(self, number: int, bound: float) -> None:
        """Rank what was judged; the best is judged at the finest cells, if a first look had been enough."""
        judged = self.judged[number]
        pool = Pool.of(judged, self.scales, bound)
        while pool.candidates and not pool.candidates[0].complete:
            at = next(k for k, one in enumerate(judged) if one is pool.candidates[0])
            one, pose = self.both[number], judged[at].pose
            judged[at] = self._judge_with(one, self._over(one, pose)).judge_one(pose)
            pool = Pool.of(judged, self.scales, bound)
        self.pools[number] = pool

    def _settles(self) -> bool:
        """Return whether the best stands out so far that no finer level need be searched."""
        pool = self.pools[0]
        return (
            pool.by_itself(self.judged[0])
            and pool.margin >= self.settings.convincing_margin
            and pool.candidates[0].neg_log10_p >= PROMISING_NEG_LOG10_P
            and pool.over(self.pools[1]) >= CONVINCING_NULL_RATIO
        )


def _layer(bev: Bev, factor: int) -> Layer:
    coarse = coarsen(bev, factor)
    return Layer(coarse.grid, channels(coarse))
