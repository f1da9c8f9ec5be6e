"""Judging hypotheses at the finest cells: by patches that must agree with each other, and by the ground."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Mask
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.match.candidates import (
    AGREE_TOLERANCES,
    RADIUS_TOLERANCES,
    Candidate,
    GroundWeights,
    same_pose,
)
from mtpcr_geo.match.nearby import score_nearby
from mtpcr_geo.match.patches import PatchMatches, match_patches
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.pyramid import Pyramid
from mtpcr_geo.match.search import Layer
from mtpcr_geo.match.terrain import GroundComparison, Terrain, compare_ground, fewest_of
from mtpcr_geo.method.scales import Scales
from mtpcr_geo.method.solve import iterative_svd, ransac_upright

CLEAR_MARGIN = 4.0
"""Times by which the best strength exceeds a hypothesis' score, which bounds its strength, where patches need
not be asked: but for what the ground may tell for it, the margin could not fall below this."""
MAX_RADIUS_CELLS = 10
WIDE_PATCH_CELLS = 24
"""Cells along a patch from which the first look at a hypothesis is taken at cells twice as large."""
FEWEST_PATCHES, LEAST_PATCH_CELLS = 16, 16
"""Patches in the overlap below which tie points come of patches half as large, and cells along these."""
LEAST_FILL = 0.25
"""Share of a patch's cells that must be filled in both rasters; half of what is usual in thin ones."""
CELLS_TO_LOOK_AHEAD = 1_000_000
"""Cells of a source up to which several first looks are taken at once; a larger one keeps all cores busy."""
FAINT = 3.0
"""Times by which the best strength exceeds that of a first look where the second, closer one is not taken: it
seldom changes a strength by half, and a margin of two is clear."""


@dataclass(frozen=True)
class Judge:
    """Judges poses of one source over one target.

    Attributes:
        pyramid: both rasters.
        ground: terrain of source and target.
        scales: lengths of the judgement.
        patch_m: edge of a patch, metres.
        search_radius_m: how far a patch may lie from where a hypothesis puts it at the first look, metres.
        trust_vertical: whether both verticals are known, so that the terrains may differ by a shift alone.
        seed: of the sampling when patches vote.

    """

    pyramid: Pyramid
    ground: tuple[Terrain, Terrain]
    scales: Scales
    patch_m: float
    search_radius_m: float
    trust_vertical: bool
    seed: int

    @property
    def radius_cells(self) -> int:
        """How far a patch may lie from where the pose puts it at the second look, cells."""
        return max(1, round(RADIUS_TOLERANCES * self.scales.tolerance_m / self.scales.cell_m))

    def judge(
        self, poses: Sequence[Pose], known: float, before: Sequence[Candidate] = ()
    ) -> tuple[list[Candidate], list[Pose]]:
        """Judge poses, those of the highest score first.

        A strength is at most the score. What cannot come within `CLEAR_MARGIN` of the best is left, unjudged.

        Args:
            poses: at the finest cells.
            known: strength reached by any hypothesis so far, the ground included.
            before: what was judged before, which tells how well the grounds can agree.

        Returns:
            What was judged, and what was not.

        """
        separate: list[Pose] = []
        near = self.scales.same_pose_m / 4
        for pose in sorted(poses, key=lambda pose: -pose.score):
            if np.isfinite(pose.score) and not any(same_pose(pose, o, near, np.inf) for o in separate):
                separate.append(pose)
        judged: list[Candidate] = []
        with closing(self._first_looks(separate)) as looks:
            for number, pose in enumerate(separate):
                if pose.score * CLEAR_MARGIN < known:
                    return judged, separate[number:]
                judged.append(self._second_look(next(looks), known))
                known = max(known, GroundWeights.of([*before, *judged]).weighed(judged[-1]))
        return judged, []

    def judge_one(self, pose: Pose, known: float = 0.0) -> Candidate:
        """Match patches around a pose, let them correct it, and match again from there.

        The first look is a wide one, at cells twice as large where patches still hold enough of them. Where
        so few patches agree already there that the pose will not come near the strength ``known``, the second
        is not taken.
        """
        return self._second_look(self._first_look(pose), known)

    @property
    def _first_factor(self) -> int:
        """Cell of the first look as a multiple of the finest."""
        return 2 if self.patch_m >= WIDE_PATCH_CELLS * self.scales.cell_m else 1

    def _first_looks(self, poses: Sequence[Pose]) -> Generator[Candidate, None, None]:
        """Take first looks in order; they do not hang on what is found, so that some are taken ahead."""
        cells = self.pyramid.source.grid.width * self.pyramid.source.grid.height
        ahead = usable_cores() if cells <= CELLS_TO_LOOK_AHEAD else 1
        if ahead == 1 or len(poses) < 2:
            yield from map(self._first_look, poses)
            return
        for factor in (1, self._first_factor):
            self.pyramid.at(factor)  # so that threads do not each make it
        with ThreadPoolExecutor(ahead) as threads:
            left = iter(poses)
            begun = deque(threads.submit(self._first_look, pose) for pose in islice(left, ahead))
            try:
                while begun:
                    look = begun.popleft().result()
                    begun.extend(threads.submit(self._first_look, pose) for pose in islice(left, 1))
                    yield look
            finally:
                for one in begun:
                    one.cancel()

    def _first_look(self, pose: Pose) -> Candidate:
        """Match patches in a wide surrounding of a pose."""
        cell, factor = self.scales.cell_m, self._first_factor
        radius = min(max(self.radius_cells, round(self.search_radius_m / cell)), MAX_RADIUS_CELLS)
        patches, supporting = self._patches(factor, pose, max(1, round(radius / factor)))
        return Candidate(pose, patches, supporting, self._compare_ground(pose), complete=False)

    def _second_look(self, first: Candidate, known: float) -> Candidate:
        """Match again from where the first look's patches put the pose, if it may come near ``known``."""
        if FAINT * first.strength < known:
            return first
        pose, patches, supporting = first.pose, first.patches, first.supporting
        assert patches is not None
        assert supporting is not None
        fine = self.pyramid.at(1)
        corrected = _corrected(
            pose, patches, supporting, self.pyramid.at(self._first_factor), self._agree_m, fine[0]
        )
        rescored = score_nearby(*fine, corrected, 1)[0]
        # patches that do not agree must not carry a good hypothesis away
        ground = first.ground
        if rescored.score >= pose.score:
            pose, ground = rescored, self._compare_ground(rescored)
        return Candidate(pose, *self._patches(1, pose, self.radius_cells), ground)

    def tie_points(self, best: Candidate) -> PatchMatches:
        """Return the patches of a hypothesis, smaller ones where the overlap holds few of the usual size.

        The size of a patch follows from the extent of the clouds; of what they share it may be a third.
        """
        patches = best.patches
        assert patches is not None  # hypotheses in a pool are judged by patches
        smaller = self.patch_m / 2
        if patches.patches >= FEWEST_PATCHES or smaller < LEAST_PATCH_CELLS * self.scales.cell_m:
            return patches
        return replace(self, patch_m=smaller)._patches(1, best.pose, self.radius_cells)[0]

    @property
    def _agree_m(self) -> float:
        return AGREE_TOLERANCES * self.scales.tolerance_m

    def _patches(self, factor: int, pose: Pose, window: int) -> tuple[PatchMatches, Mask]:
        """Match the patches of a level around a pose of the finest, and mark those that agree on one."""
        source, target = self.pyramid.at(factor)
        if factor > 1:
            pose = pose_of(pose.hypothesis(centre_of(self.pyramid.source.grid)), centre_of(source.grid))
        stride = max(4, round(self.patch_m / 2 / source.grid.cell))
        fill = min(LEAST_FILL, self.scales.fill / 2)
        found = match_patches(source, target, pose, window=window, stride=stride, min_fill=fill)
        s, t = source.grid.to_metres(found.source_px), target.grid.to_metres(found.target_px)
        return found, ransac_upright(s, t, self._agree_m, self.seed, 500)[1]

    def _compare_ground(self, pose: Pose) -> GroundComparison:
        hypothesis = pose.hypothesis(centre_of(self.pyramid.source.grid))
        fewest = fewest_of(self.ground[1].grid.cell, self.scales.terrain_cell_m)
        return compare_ground(*self.ground, hypothesis, plane=not self.trust_vertical, fewest=fewest)


def _corrected(
    pose: Pose,
    patches: PatchMatches,
    supporting: Mask,
    layers: tuple[Layer, Layer],
    agree_m: float,
    finest: Layer,
) -> Pose:
    """Fit yaw and shift of the finest source raster to patches, starting from those that agree."""
    if supporting.sum() < 4:
        return pose
    flat = np.zeros((len(patches), 1))
    solution = iterative_svd(
        np.hstack([layers[0].grid.to_metres(patches.source_px), flat]),
        np.hstack([layers[1].grid.to_metres(patches.target_px), flat]),
        start=supporting,
        weight=patches.score**2,
        floor=agree_m,
        upright=True,
    )
    east, north = transforms.apply(solution.T, np.array([[*centre_of(finest.grid), 0.0]]))[0, :2]
    return Pose(
        transforms.yaw_of(solution.T[:3, :3]), float(east), float(north), pose.score, pose.overlap_cells
    )
