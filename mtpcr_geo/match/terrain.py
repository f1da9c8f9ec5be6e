"""The shape of the ground as evidence: where things repeat, the terrain beneath them rarely does.

The band-passed channels of the correlation leave the terrain out, since canopy and roofs hide parts of it and
two levellings may differ. Here lowest heights in coarse cells are compared after one shift in height, or one
plane where a vertical is not trusted: as a search of its own that proposes poses, and as a judge of any pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.pose import Pose, centre_of, pose_of, warp_to
from mtpcr_geo.match.search import distinct, spectrum
from mtpcr_geo.method.bev import coarsen

NOISE_M = 0.1
"""Spread of the ground's height differences below which cells, borders and noise leave nothing to compare."""
FEWEST_CELLS = 8
FINER_PARTS = (8, 4, 2)
LEAST_SEEN, LEAST_PART = 0.1, 0.2
"""Parts of the terrain's cell in which grounds may be compared, finest first; the share of the ground's area
that must show in them; and the part of the fewest cells' area that they must show under a pose."""
MOST_CELLS = 10_000
"""Cells of the source that are compared at most: every so many-th of more."""
CELLS_OF_PLANE = 1_000
"""Of these, how many tell how each ground varies beside its own plane."""
SETTLING_STEPS, STILL_CELLS = 15, 0.002
KNOWN = 0.99
"""Weight of filled cells above which an interpolated height is one of the ground alone."""


@dataclass(frozen=True)
class Terrain:
    """Lowest heights in coarse cells.

    Attributes:
        grid: where they lie, metres.
        low: (h, w) float32 metres about their median, 0 where empty.
        mask: (h, w) float32, 1 where filled.

    """

    grid: Grid
    low: Image
    mask: Image

    @classmethod
    def of(cls, bev: Bev, cell_m: float) -> Terrain:
        """Make it of a height raster of the bare ground, in cells of about ``cell_m`` metres."""
        coarse = coarsen(bev, max(1, round(cell_m / bev.grid.cell)))
        filled = coarse.count > 0
        middle = np.median(coarse.low[filled]) if filled.any() else np.float32(0.0)
        low = np.where(filled, coarse.low - middle, np.float32(0.0)).astype(np.float32)
        return cls(coarse.grid, low, filled.astype(np.float32))


@dataclass(frozen=True)
class GroundComparison:
    """How the shapes of both grounds compare under a pose.

    Attributes:
        cells: cells compared, of `MOST_CELLS` of the source at most.
        spread_m: robust standard deviation of their height differences, after one shift or one plane.
        fewest: cells that are ground enough to compare.
        relief_m: what that would be if neither ground told anything of the other: their own spreads in the
            cells compared, added in squares.
        beyond_plane_m: the same of what is left of each ground beside its own plane.

    """

    cells: int
    spread_m: float
    fewest: int = FEWEST_CELLS
    relief_m: float = 0.0
    beyond_plane_m: float = 0.0

    @property
    def known(self) -> bool:
        """Whether there was enough ground to compare."""
        return self.cells >= self.fewest


def cell_to_compare(source: Bev, target: Bev, coarsest_m: float) -> float:
    """Return the finest cell in which both clouds still see ground together, metres.

    The finer the cells, the less of a slope, and of what hides the ground, lies within one. In cells too fine
    for a thin cloud no ground lies beside other ground.

    Args:
        source, target: height rasters of the bare ground.
        coarsest_m: cell that is taken if no finer one will do.

    """
    wide = [float(Terrain.of(bev, coarsest_m).mask.sum()) * coarsest_m**2 for bev in (source, target)]
    for parts in FINER_PARTS:
        cell = coarsest_m / parts
        if cell < source.grid.cell:
            continue
        masks = [Terrain.of(bev, cell).mask for bev in (source, target)]
        areas = [float(cv2.erode(mask, np.ones((2, 2), np.uint8)).sum()) * cell**2 for mask in masks]
        if all(area >= LEAST_SEEN * most for area, most in zip(areas, wide, strict=True)):
            return cell
    return coarsest_m


def fewest_of(cell_m: float, coarsest_m: float) -> int:
    """Return how many cells are ground enough to compare: a part of the area of `FEWEST_CELLS` coarse ones.

    Args:
        cell_m: edge of a cell, metres.
        coarsest_m: edge of a cell of the terrain, metres.

    """
    return max(FEWEST_CELLS, int(np.ceil(FEWEST_CELLS * LEAST_PART * (coarsest_m / cell_m) ** 2)))


def compare_ground(
    source: Terrain,
    target: Terrain,
    hypothesis: Hypothesis,
    *,
    plane: bool = False,
    fewest: int = FEWEST_CELLS,
) -> GroundComparison:
    """Compare the shape of both grounds under a pose.

    Args:
        source, target: both terrains.
        hypothesis: the pose.
        fewest: cells that are ground enough to compare.
        plane: remove the best plane of the differences, for clouds whose vertical is not trusted; else
            their median alone.

    """
    row, column = np.nonzero(source.mask)
    every = max(1, -(-len(row) // MOST_CELLS))
    row, column = row[::every], column[::every]
    fewest = max(FEWEST_CELLS, -(-fewest // every))
    xy = source.grid.to_metres(np.column_stack([column, row]).astype(np.float64))
    c, s = np.cos(hypothesis.yaw), np.sin(hypothesis.yaw)
    placed = xy @ np.array([[c, s], [-s, c]]) + hypothesis.shift
    px = target.grid.to_pixel(placed).astype(np.float32)
    x, y = px[:, :1], px[:, 1:]
    weight = cv2.remap(target.mask, x, y, cv2.INTER_LINEAR)[:, 0]
    known = weight > KNOWN
    cells = int(known.sum())
    if cells < FEWEST_CELLS:
        return GroundComparison(cells, np.inf, fewest)
    height = cv2.remap(target.low, x, y, cv2.INTER_LINEAR)[:, 0]
    heights = [one[known].astype(np.float64) for one in (source.low[row, column], height)]
    places, step = placed[known], heights[1] - heights[0]
    some = slice(None, None, -(-cells // CELLS_OF_PLANE))
    own, other = (_spread(_without_plane(places[some], one[some])) for one in heights)
    beyond_plane = float(np.hypot(own, other))
    if plane and cells >= 3 * FEWEST_CELLS:
        return GroundComparison(
            cells, _spread(_without_plane(places, step)), fewest, beyond_plane, beyond_plane
        )
    own, other = (_spread(one) for one in heights)
    return GroundComparison(cells, _spread(step), fewest, float(np.hypot(own, other)), beyond_plane)


def _spread(height: Floats) -> float:
    """Return the robust spread of (n,) heights about their median."""
    return 1.4826 * float(np.median(np.abs(height - np.median(height))))


def _without_plane(xy: Floats, height: Floats) -> Floats:
    """Take the best plane from (n,) heights at (n, 2) places, outliers weighed down."""
    centred = xy - xy.mean(axis=0)
    # scaled to one, so that the normal equations stay well conditioned
    A = np.column_stack([np.ones(len(xy)), centred / max(float(np.abs(centred).max()), 1e-9)])
    weight = np.ones(len(xy))
    rest = height
    for _ in range(4):
        W = A * weight[:, None] ** 2
        rest = height - A @ np.linalg.lstsq(W.T @ A, W.T @ height, rcond=None)[0]
        scale = max(1.4826 * float(np.median(np.abs(rest))), NOISE_M)
        weight = 1.0 / (1.0 + (rest / (2.0 * scale)) ** 2)
    return np.asarray(rest)


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

    def best(self, yaw: float) -> list[tuple[Pose, float]]:
        """Return the best shifts under one yaw, by evidence and by closeness, each with its closeness."""
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
        found = []
        for measure in (evidence, closeness):
            place = int(np.argmax(np.where(considered, measure, -np.inf)))
            row, column = np.unravel_index(place, n.shape)
            east, north = float(x[0, column]), float(y[row, 0])
            pose = Pose(yaw, east, north, float(evidence[row, column]), round(float(n[row, column])))
            found.append((pose, float(closeness[row, column])))
        return found

    def run(self, yaws: Iterable[float]) -> list[Pose]:
        """Search all yaws: the best of each by evidence and by closeness, best first of both in turn."""
        with ThreadPoolExecutor(usable_cores()) as threads:
            found = [one for some in threads.map(self.best, yaws) for one in some]
        by_evidence = sorted(found, key=lambda one: -one[0].score)
        by_closeness = sorted(found, key=lambda one: -one[1])
        return [pose for both in zip(by_evidence, by_closeness, strict=True) for pose, _ in both]


def settle(source: Terrain, target: Terrain, pose: Pose, *, plane: bool = False) -> Pose:
    """Move a pose to where both grounds agree best near by (Gauss and Newton, outliers weighed down).

    Args:
        source, target: both terrains.
        pose: about the centre of the source's raster.
        plane: whether a plane of height differences is free too, for clouds whose vertical is not trusted;
            else their mean alone.

    """
    grid = target.grid
    rows, columns = np.nonzero(source.mask)
    if len(rows) < FEWEST_CELLS:
        return pose
    offset = source.grid.to_metres(np.column_stack([columns, rows]).astype(np.float64)) - centre_of(
        source.grid
    )
    height = source.low[rows, columns].astype(np.float64)
    inner = cv2.erode(target.mask, np.ones((3, 3), np.uint8))
    north, east = np.gradient(target.low, grid.cell)
    yaw, x, y = pose.yaw, pose.east, pose.north
    for _ in range(SETTLING_STEPS):
        c, s = np.cos(yaw), np.sin(yaw)
        turned = offset @ np.array([[c, s], [-s, c]])
        px = grid.to_pixel(turned + [x, y]).astype(np.float32)
        at = px[:, :1], px[:, 1:]
        known = cv2.remap(inner, *at, cv2.INTER_LINEAR)[:, 0] > KNOWN
        if known.sum() < 3 * FEWEST_CELLS:
            return pose
        low, to_east, to_north = (
            cv2.remap(image.astype(np.float32), *at, cv2.INTER_LINEAR)[known, 0].astype(np.float64)
            for image in (target.low, east, -north)
        )
        here = turned[known]
        level = [np.ones(len(here)), *here.T] if plane else [np.ones(len(here))]
        J = np.column_stack([to_east, to_north, to_north * here[:, 0] - to_east * here[:, 1], *level])
        rest = height[known] - low
        rest -= np.median(rest)
        scale = max(1.4826 * float(np.median(np.abs(rest))), NOISE_M / 2)
        weight = 1.0 / (1.0 + (rest / (2.0 * scale)) ** 2)
        # flat ground tells nothing: a step of a cell, or of what turns the rim by one, costs as much as noise
        rim = float(np.hypot(*here.T).max())
        held = np.zeros(J.shape[1])
        held[:3] = np.array([1.0, 1.0, rim]) * NOISE_M / grid.cell
        step = np.linalg.solve(
            (J * weight[:, None] ** 2).T @ J + np.diag(held**2 + 1e-12), (J * weight[:, None] ** 2).T @ rest
        )
        longest = max(float(np.hypot(step[0], step[1])), abs(step[2]) * rim)
        step *= min(1.0, 2.0 * grid.cell / max(longest, 1e-12))
        x, y, yaw = x + step[0], y + step[1], yaw + step[2]
        if longest < STILL_CELLS * grid.cell:
            break
    moved = Pose(float(yaw), float(x), float(y), pose.score, pose.overlap_cells)
    before, after = (
        compare_ground(source, target, one.hypothesis(centre_of(source.grid)), plane=plane)
        for one in (pose, moved)
    )
    return moved if after.known and after.spread_m <= before.spread_m else pose


def closest(
    source: Terrain, target: Terrain, poses: Sequence[Pose], count: int, *, plane: bool = False
) -> list[Pose]:
    """Settle poses, and keep those under which the grounds are closest for the cells they share.

    Args:
        source, target: both terrains.
        poses: candidates, best first; the first is kept whatever it comes to.
        count: how many to keep at most.
        plane: see `settle`.

    """
    relief = float(np.std(source.low[source.mask > 0])) if source.mask.any() else 0.0
    ranked: list[tuple[float, Pose]] = []
    for number, pose in enumerate(poses):
        moved = settle(source, target, pose, plane=plane)
        found = compare_ground(source, target, moved.hypothesis(centre_of(source.grid)), plane=plane)
        if found.known:
            ratio = np.log((relief + NOISE_M / 2) / (found.spread_m + NOISE_M / 2))
            ranked.append((np.inf if number == 0 else float(np.sqrt(found.cells) * ratio), moved))
    ranked.sort(key=lambda one: -one[0])
    apart = source.grid.cell / 2
    return distinct((pose for _, pose in ranked), count, np.radians(1.0), apart)


def place_on(pose: Pose, terrain: Terrain, grid: Grid) -> Pose:
    """Express a pose about the terrain's centre as one about the centre of another raster of the source."""
    return pose_of(pose.hypothesis(centre_of(terrain.grid)), centre_of(grid))
