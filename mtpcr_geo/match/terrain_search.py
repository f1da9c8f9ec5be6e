"""Search for poses under which both grounds have the same shape: any yaw and shift, see `terrain`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from mtpcr_geo.core.arrays import median
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.pose import Pose, centre_of, warp_to
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.search import distinct, spectrum
from mtpcr_geo.match.terrain import (
    FEWEST_CELLS,
    KNOWN,
    NOISE_M,
    GroundSpread,
    Terrain,
    ground_closeness,
    ground_spread,
)

PEAKS_A_YAW = 8
"""Shifts under one yaw that are proposed by each of both measures at most, where they are ranked by the
robust spread of the heights: no sum tells which of them are good, since brush and holes weigh in squares."""
APART_CELLS = 2
"""Cells between two of these at the least."""
SETTLED = 40
"""Poses that are settled, of which those are proposed under which the grounds are closest."""
SETTLING_STEPS, STILL_CELLS = 15, 0.002


def propose(
    bare: tuple[Bev, Bev],
    cell_m: float,
    count: int,
    step_deg: float,
    *,
    least_m2: float,
    prior: Prior | None = None,
    plane: bool = False,
    robustly: bool = False,
) -> list[Hypothesis]:
    """Propose poses under which the grounds of two clouds have the same shape, best first.

    Args:
        bare: height rasters of the bare ground, the source's first.
        cell_m: cell in which they are compared, metres.
        count: how many to propose at most.
        step_deg: step over all yaws.
        least_m2: ground that both must show under a pose, square metres.
        prior: what is known of the pose; None to search everywhere.
        plane: whether a plane of height differences is free too, for clouds whose vertical is not trusted.
        robustly: smooth both grounds, and choose the poses that are settled by the robust spread of what they
            differ, from several shifts of each yaw.

    """
    source, target = (Terrain.of(bev, cell_m) for bev in bare)
    if robustly:
        source, target = source.smoothed(), target.smoothed()
    cell = source.grid.cell
    reached = target if prior is None else prior.terrain(source.grid, target)
    if reached is None or min(source.mask.sum(), reached.mask.sum()) < 4 * FEWEST_CELLS:
        return []
    step = float(np.radians(step_deg))
    yaws = np.arange(round(2 * np.pi / step)) * step
    search = TerrainSearch(source, reached, least_m2 / cell**2)
    if prior is not None:
        yaws = prior.yaws(step)
        place = prior.place_of(source.grid)
        if place is not None:
            search.restrict(place, prior.radius_m)
    ranked = search.run_robustly(yaws, plane=plane) if robustly else search.run(yaws)
    found = distinct(ranked, SETTLED, 2 * step, 3 * cell)
    centre = centre_of(source.grid)
    return [pose.hypothesis(centre) for pose in closest(source, target, found, count, plane=plane)]


class TerrainSearch:
    """Finds poses under which both grounds have the same shape, for any yaw and shift.

    The score of a pose is half the logarithm of the likelihood ratio of Gaussian heights: with n cells in
    common, ``n / 2 * log((var s + var t) / var(t - s))``, each variance about its own mean over those cells.
    Neighbouring heights go together, so that this evidence grows too fast with the overlap; closeness, with
    the root of n in its place, finds small overlaps in which the grounds agree.

    Args:
        source, target: both terrains, of one cell size.
        min_cells: overlaps of fewer cells are not considered.

    """

    def __init__(self, source: Terrain, target: Terrain, min_cells: float) -> None:
        self.source, self.target = source, target
        self.min_cells = max(min_cells, FEWEST_CELLS)
        self._side = int(np.ceil(np.hypot(*source.grid.shape))) + 2
        height, width = target.grid.shape
        self._shape = (
            cv2.getOptimalDFTSize(height + self._side - 1),
            cv2.getOptimalDFTSize(width + self._side - 1),
        )
        self._target = [spectrum(one, self._shape) for one in (target.mask, target.low, target.low**2)]
        self._near: tuple[Callable[[float], tuple[float, float]], float] | None = None

    def restrict(self, place: Callable[[float], tuple[float, float]], radius: float) -> None:
        """Consider only poses that put the source terrain's centre near a place, see `GlobalSearch.restrict`.

        Args:
            place: gives east and north of it for a yaw, metres.
            radius: how far from it, metres; a cell is added, by which poses lie apart.

        """
        self._near = place, radius + self.target.grid.cell

    def peaks(self, yaw: float, count: int) -> list[list[tuple[Pose, float]]]:
        """Return the best shifts under one yaw, by evidence and by closeness, each with its closeness.

        Args:
            yaw: radians.
            count: how many by each at most; they lie more than `APART_CELLS` apart, but on flats.

        Returns:
            Those by evidence, and those by closeness, best first; none where nothing is considered.

        """
        grid = self.target.grid
        half = self._side * grid.cell / 2
        square = Grid(-half, half, grid.cell, self._side, self._side)
        low, mask = warp_to(
            np.stack([self.source.low, self.source.mask]), self.source.grid, square, Pose(yaw, 0.0, 0.0)
        )
        mask = (mask > KNOWN).astype(np.float32)
        low = low * mask
        m, a, aa = (spectrum(one, self._shape) for one in (mask, low, low**2))
        M, A, AA = self._target
        n, sa, saa, ta, taa, cross = (
            cv2.idft(cv2.mulSpectrums(t, s, 0, conjB=True), flags=cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
            for t, s in ((M, m), (M, a), (M, aa), (A, m), (AA, m), (A, a))
        )
        cells = np.maximum(n, 1.0)
        mean_s, mean_t = sa / cells, ta / cells
        var_s = np.maximum(saa / cells - mean_s**2, 0.0) + NOISE_M**2
        var_t = np.maximum(taa / cells - mean_t**2, 0.0) + NOISE_M**2
        both = cross / cells - mean_s * mean_t
        rest = np.maximum(var_s + var_t - 2 * both, 2 * NOISE_M**2)
        ratio = np.log((var_s + var_t) / rest)
        dy, dx = np.arange(self._shape[0])[:, None], np.arange(self._shape[1])[None, :]
        dy = np.where(dy < grid.height, dy, dy - self._shape[0])
        dx = np.where(dx < grid.width, dx, dx - self._shape[1])
        x = grid.west + (dx + self._side / 2) * grid.cell
        y = grid.north - (dy + self._side / 2) * grid.cell
        considered = n >= self.min_cells
        if self._near is not None:
            (near_x, near_y), reach = self._near[0](yaw), self._near[1]
            considered &= (x - near_x) ** 2 + (y - near_y) ** 2 <= reach**2
        if not considered.any():
            return []
        evidence, closeness = cells / 2 * ratio, np.sqrt(cells) * ratio
        near = np.ones((2 * APART_CELLS + 1, 2 * APART_CELLS + 1), np.uint8)
        found: list[list[tuple[Pose, float]]] = []
        for measure in (evidence, closeness):
            allowed = np.where(considered, measure, np.float32(-np.inf))
            if count == 1:
                places = [int(np.argmax(allowed))]
            else:
                highest = np.flatnonzero(considered & (allowed >= cv2.dilate(allowed, near)))
                places = highest[np.argsort(-allowed.ravel()[highest], kind="stable")[:count]].tolist()
            found.append([])
            for place in places:
                row, column = np.unravel_index(place, n.shape)
                east, north = float(x[0, column]), float(y[row, 0])
                pose = Pose(yaw, east, north, float(evidence[row, column]), round(float(n[row, column])))
                found[-1].append((pose, float(closeness[row, column])))
        return found

    def run(self, yaws: Iterable[float]) -> list[Pose]:
        """Search all yaws: the best of each by evidence and by closeness, best first of both in turn."""
        with ThreadPoolExecutor(usable_cores()) as threads:
            found = [best for some in threads.map(lambda yaw: self.peaks(yaw, 1), yaws) for (best,) in some]
        by_evidence = sorted(found, key=lambda one: -one[0].score)
        by_closeness = sorted(found, key=lambda one: -one[1])
        return [pose for both in zip(by_evidence, by_closeness, strict=True) for pose, _ in both]

    def run_robustly(self, yaws: Iterable[float], *, plane: bool = False) -> list[Pose]:
        """Search all yaws, and rank several shifts of each by the robust spread of what both grounds differ.

        Args:
            yaws: radians.
            plane: whether a plane of each ground is free, for clouds whose vertical is not trusted.

        Returns:
            The poses, best first.

        """
        both, centre = (self.source, self.target), centre_of(self.source.grid)

        def ranked(yaw: float) -> list[tuple[float, Pose]]:
            poses = {pose for found in self.peaks(yaw, PEAKS_A_YAW) for pose, _ in found}
            return [(ground_closeness(*both, pose.hypothesis(centre), plane=plane), pose) for pose in poses]

        with ThreadPoolExecutor(usable_cores()) as threads:
            found = [one for some in threads.map(ranked, yaws) for one in some]
        found.sort(key=lambda one: (-one[0], one[1].yaw, one[1].east, one[1].north))
        return [pose for value, pose in found if value > 0.0]


class Settling:
    """Moves poses to where both grounds agree best near by (Gauss and Newton, outliers weighed down).

    Args:
        source, target: both terrains.
        plane: whether a plane of height differences is free too, for clouds whose vertical is not trusted;
            else their mean alone.

    """

    def __init__(self, source: Terrain, target: Terrain, *, plane: bool = False) -> None:
        self.source, self.target, self.plane = source, target, plane
        self._centre = centre_of(source.grid)
        rows, columns = np.nonzero(source.mask)
        places = source.grid.to_metres(np.column_stack([columns, rows]).astype(np.float64))
        self._offset, self._height = places - self._centre, source.low[rows, columns].astype(np.float64)
        self._inner = cv2.erode(target.mask, np.ones((3, 3), np.uint8))
        north, east = np.gradient(target.low, target.grid.cell)
        self._images = [image.astype(np.float32) for image in (target.low, east, -north)]

    def settle(self, pose: Pose) -> tuple[Pose, GroundSpread]:
        """Settle a pose about the centre of the source's raster.

        Returns:
            The pose where the grounds agree better there, else the one given, and how far they differ under
            it.

        """
        before, moved = self._spread(pose), self._moved(pose)
        if moved is None:
            return pose, before
        after = self._spread(moved)
        return (moved, after) if after.known and after.spread_m <= before.spread_m else (pose, before)

    def _spread(self, pose: Pose) -> GroundSpread:
        return ground_spread(self.source, self.target, pose.hypothesis(self._centre), plane=self.plane)

    def _moved(self, pose: Pose) -> Pose | None:
        """Return where a pose moves to; None where too few cells lie on ground that both see."""
        grid = self.target.grid
        if len(self._offset) < FEWEST_CELLS:
            return None
        yaw, x, y = pose.yaw, pose.east, pose.north
        for _ in range(SETTLING_STEPS):
            c, s = np.cos(yaw), np.sin(yaw)
            turned = self._offset @ np.array([[c, s], [-s, c]])
            px = grid.to_pixel(turned + [x, y]).astype(np.float32)
            at = px[:, :1], px[:, 1:]
            known = cv2.remap(self._inner, *at, cv2.INTER_LINEAR)[:, 0] > KNOWN
            if known.sum() < 3 * FEWEST_CELLS:
                return None
            low, to_east, to_north = (
                cv2.remap(image, *at, cv2.INTER_LINEAR)[known, 0].astype(np.float64) for image in self._images
            )
            here = turned[known]
            level = [np.ones(len(here)), *here.T] if self.plane else [np.ones(len(here))]
            J = np.column_stack([to_east, to_north, to_north * here[:, 0] - to_east * here[:, 1], *level])
            rest = self._height[known] - low
            rest -= median(rest)
            scale = max(1.4826 * median(np.abs(rest)), NOISE_M / 2)
            weight = 1.0 / (1.0 + (rest / (2.0 * scale)) ** 2)
            # flat ground tells nothing: a step of a cell, or of what turns the rim by one, costs as much as
            # noise
            rim = float(np.hypot(*here.T).max())
            held = np.zeros(J.shape[1])
            held[:3] = np.array([1.0, 1.0, rim]) * NOISE_M / grid.cell
            weighed = (J * weight[:, None] ** 2).T
            step = np.linalg.solve(weighed @ J + np.diag(held**2 + 1e-12), weighed @ rest)
            longest = max(float(np.hypot(step[0], step[1])), abs(step[2]) * rim)
            step *= min(1.0, 2.0 * grid.cell / max(longest, 1e-12))
            x, y, yaw = x + step[0], y + step[1], yaw + step[2]
            if longest < STILL_CELLS * grid.cell:
                break
        return Pose(float(yaw), float(x), float(y), pose.score, pose.overlap_cells)


def closest(
    source: Terrain, target: Terrain, poses: Sequence[Pose], count: int, *, plane: bool = False
) -> list[Pose]:
    """Settle poses, and keep those under which the grounds are closest for the cells they share.

    Args:
        source, target: both terrains.
        poses: candidates, best first; the first is kept whatever it comes to.
        count: how many to keep at most.
        plane: see `Settling`.

    """
    relief = float(np.std(source.low[source.mask > 0])) if source.mask.any() else 0.0
    settling = Settling(source, target, plane=plane)
    ranked: list[tuple[float, Pose]] = []
    with ThreadPoolExecutor(usable_cores()) as threads:
        settled = list(threads.map(settling.settle, poses))
    for number, (moved, found) in enumerate(settled):
        if found.known:
            ratio = np.log((relief + NOISE_M / 2) / (found.spread_m + NOISE_M / 2))
            ranked.append((np.inf if number == 0 else float(np.sqrt(found.cells) * ratio), moved))
    ranked.sort(key=lambda one: -one[0])
    apart = source.grid.cell / 2
    return distinct((pose for _, pose in ranked), count, np.radians(1.0), apart)
