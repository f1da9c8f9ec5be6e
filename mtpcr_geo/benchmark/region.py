"""A made-up region of any size, tile by tile: what an aerial survey and scans from the ground see of it.

Land is laid out in squares of a quarter of a kilometre, each from a generator of its own, so that any tile
can be made without the others: terrain, rows of houses, fields, woods. An aerial tile samples the surface
from above; a scan from the ground sees, from some stations, the ground, the walls and the crowns that nothing
hides. Both are sampled and disturbed apart from each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS

from mtpcr_geo.benchmark.pairs import write_laz
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.cloud import ArrayCloud

EPSG = 25832
CORNER = (500_000.0, 5_800_000.0)
"""South-west corner of the region in its CRS, metres."""
SQUARE_M = 250.0
STEP_M = 0.5
_KINDS = ("town", "town", "suburb", "suburb", "fields", "wood")
_REACH_M = 16.0
_WAVES = 24


@dataclass(frozen=True)
class Things:
    """What stands on some land, one row a thing.

    Attributes:
        houses: (n, 7) middle x and y, yaw in radians, length, width, height of the eaves, rise of the roof.
        trees: (m, 4) x, y, radius of the crown, height.

    """

    houses: Floats
    trees: Floats


@dataclass(frozen=True)
class Region:
    """A made-up region.

    Attributes:
        seed: of everything random.

    """

    seed: int = 0

    def terrain(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the bare ground, metres."""
        rng = np.random.default_rng([self.seed, 1])
        z = np.full(np.broadcast(x, y).shape, 80.0)
        for _ in range(_WAVES):
            length = float(np.exp(rng.uniform(np.log(60.0), np.log(3000.0))))
            angle, phase = rng.uniform(0.0, 2 * np.pi, 2)
            along = (x * np.cos(angle) + y * np.sin(angle)) * (2 * np.pi / length)
            z = z + 0.004 * length * np.sin(along + phase)
        return np.asarray(z)

    def things(self, low: Floats, high: Floats) -> Things:
        """Return what stands within bounds, or just outside of them."""
        first = np.floor((np.asarray(low) - _REACH_M) / SQUARE_M).astype(int)
        last = np.floor((np.asarray(high) + _REACH_M) / SQUARE_M).astype(int)
        squares = [
            self._square(i, j) for i in range(first[0], last[0] + 1) for j in range(first[1], last[1] + 1)
        ]
        return Things(np.vstack([s.houses for s in squares]), np.vstack([s.trees for s in squares]))

    def _square(self, i: int, j: int) -> Things:
        rng = np.random.default_rng([self.seed, 2, i + 2**20, j + 2**20])
        corner = np.array([i, j]) * SQUARE_M
        kind = _KINDS[int(rng.integers(len(_KINDS)))]
        yaw = float(rng.uniform(0.0, np.pi))
        houses: list[list[float]] = []
        if kind in ("town", "suburb"):
            gap = (4.0, 9.0) if kind == "town" else (10.0, 24.0)
            v = -SQUARE_M
            while v < SQUARE_M:
                u = -SQUARE_M + float(rng.uniform(0.0, 20.0))
                while u < SQUARE_M:
                    length, width = float(rng.uniform(8.0, 22.0)), float(rng.uniform(7.0, 13.0))
                    turned = yaw + (np.pi / 2 if rng.random() < 0.3 else 0.0) + float(rng.normal(0.0, 0.04))
                    at = transforms.yaw_matrix(yaw)[:2, :2] @ [
                        u + length / 2,
                        v + float(rng.normal(0.0, 2.0)),
                    ]
                    eaves, rise = float(rng.uniform(3.0, 9.0)), float(rng.choice([0.0, 2.5, 4.0]))
                    if (np.abs(at) < SQUARE_M / 2 - 8.0).all() and rng.random() < 0.85:
                        middle = corner + SQUARE_M / 2 + at
                        houses.append([*middle, turned, length, width, eaves, rise])
                    u += length + float(rng.uniform(*gap))
                v += float(rng.uniform(22.0, 40.0))
        count = {"town": 60, "suburb": 150, "fields": 15, "wood": 1200}[kind]
        xy = corner + rng.uniform(0.0, SQUARE_M, (count, 2))
        height = rng.uniform(4.0, 20.0, count)
        trees = np.column_stack([xy, np.clip(height * rng.uniform(0.15, 0.3, count), 1.0, 5.0), height])
        found = np.array(houses).reshape(-1, 7)
        if len(found):
            apart = np.hypot(*(trees[:, None, :2] - found[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
            trees = trees[apart > 9.0]
        return Things(found, trees)

    def surfaces(self, low: Floats, high: Floats) -> tuple[Image, Image, Image]:
        """Return ground, ground and houses, and all with trees, on a raster of half a metre.

        Args:
            low, high: (2,) bounds in the region's metres, from its corner.

        Returns:
            Three (h, w) float32 heights, rows from the south.

        """
        width, height = (int(n) for n in np.ceil((np.asarray(high) - low) / STEP_M))
        x = low[0] + (np.arange(width) + 0.5) * STEP_M
        y = low[1] + (np.arange(height) + 0.5) * STEP_M
        ground = self.terrain(x[None, :], y[:, None]).astype(np.float32)
        built = ground.copy()
        things = self.things(low, high)
        for house in things.houses:
            _raise_house(built, ground, x, y, house)
        whole = built.copy()
        for tree in things.trees:
            _raise_tree(whole, ground, x, y, tree)
        return ground, built, whole


def _cut(axis: Floats, middle: float, reach: float) -> slice:
    return slice(*np.searchsorted(axis, [middle - reach, middle + reach]).tolist())


def _raise_house(surface: Image, ground: Image, x: Floats, y: Floats, house: Floats) -> None:
    east, north, yaw, length, width, eaves, rise = house
    reach = float(np.hypot(length, width)) / 2
    rows, columns = _cut(y, north, reach), _cut(x, east, reach)
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    dx, dy = x[None, columns] - east, y[rows, None] - north
    along, across = dx * np.cos(yaw) + dy * np.sin(yaw), -dx * np.sin(yaw) + dy * np.cos(yaw)
    inside = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)
    # a house stands level on the ground beneath its middle
    row, column = (min(int(np.searchsorted(a, at)), len(a) - 1) for a, at in ((y, north), (x, east)))
    roof = ground[row, column] + eaves + rise * (1.0 - 2.0 * np.abs(across) / width)
    part = surface[rows, columns]
    part[inside] = np.maximum(part, roof.astype(np.float32))[inside]


def _raise_tree(surface: Image, ground: Image, x: Floats, y: Floats, tree: Floats) -> None:
    east, north, radius, height = tree
    rows, columns = _cut(y, north, radius), _cut(x, east, radius)
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    squared = ((x[None, columns] - east) ** 2 + (y[rows, None] - north) ** 2) / radius**2
    crown = ground[rows, columns] + height * (0.55 + 0.45 * np.sqrt(np.maximum(1.0 - squared, 0.0)))
    part = surface[rows, columns]
    inside = squared < 1.0
    part[inside] = np.maximum(part, crown.astype(np.float32))[inside]


def aerial(region: Region, low: Floats, high: Floats, per_m2: float) -> Floats:
    """Return what an aerial survey sees within bounds, (n, 3) in the CRS of the region.

    Args:
        region: the region.
        low, high: (2,) bounds, metres from the region's corner.
        per_m2: points a square metre.

    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    rng = np.random.default_rng([region.seed, 3, *(low / STEP_M).astype(int) % 2**31])
    _, built, whole = region.surfaces(low, high)
    count = round(float(np.prod(high - low)) * per_m2)
    xy = rng.uniform(low, high, (count, 2))
    column, row = ((xy - low) / STEP_M).astype(int).T
    row, column = np.minimum(row, whole.shape[0] - 1), np.minimum(column, whole.shape[1] - 1)
    top, under = whole[row, column], built[row, column]
    # half of the pulses that meet a crown reach what is beneath
    z = np.where(rng.random(count) < 0.5, top, under) + rng.normal(0.0, 0.03, count)
    return np.column_stack([xy + CORNER + rng.normal(0.0, 0.05, (count, 2)), z])


def scan(region: Region, middle: Floats, seed: int, radius: float = 100.0, points: int = 300_000) -> Floats:
    """Return what a scanner sees from four stations around a place, (n, 3) in the CRS of the region.

    Args:
        region: the region.
        middle: (2,) the place, metres from the region's corner.
        seed: of stations and noise.
        radius: what lies farther from the place is left out, metres.
        points: how many points at most.

    """
    rng = np.random.default_rng([region.seed, 4, seed])
    low, high = np.asarray(middle) - radius - 2.0, np.asarray(middle) + radius + 2.0
    ground, built, whole = region.surfaces(low, high)
    found = []
    for number in range(4):
        angle = np.pi / 2 * number + rng.uniform(-0.4, 0.4)
        for _ in range(50):
            at = np.asarray(middle) + rng.uniform(0.3, 0.55) * radius * np.array(
                [np.cos(angle), np.sin(angle)]
            )
            column, row = ((at - low) / STEP_M).astype(int)
            if whole[row, column] - ground[row, column] < 0.1:
                break
            angle += rng.normal(0.0, 0.2)
        found.append(_seen(built, low, at, ground[row, column] + 1.8, radius, rng))
    found.append(_crowns(region, ground, low, high, rng))
    xyz = np.vstack(found)
    xyz = xyz[np.hypot(*(xyz[:, :2] - middle).T) < radius]
    if len(xyz) > points:
        xyz = xyz[np.sort(rng.choice(len(xyz), points, replace=False))]
    return np.asarray(xyz + rng.normal(0.0, 0.02, xyz.shape) + [*CORNER, 0.0])


def _seen(
    surface: Image, low: Floats, at: Floats, eye: float, radius: float, rng: np.random.Generator
) -> Floats:
    """Return points on what is not hidden from an eye: where the elevation rises above all nearer ones."""
    azimuth = rng.uniform(0.0, 2 * np.pi, 4000)
    away = np.arange(1.5, radius, 0.4)
    x = at[0] + np.cos(azimuth)[:, None] * away
    y = at[1] + np.sin(azimuth)[:, None] * away
    column = np.clip(((x - low[0]) / STEP_M).astype(int), 0, surface.shape[1] - 1)
    row = np.clip(((y - low[1]) / STEP_M).astype(int), 0, surface.shape[0] - 1)
    slope = (surface[row, column] - eye) / away
    highest = np.maximum.accumulate(slope, axis=1)
    before = np.column_stack([np.full(len(slope), -np.inf), highest[:, :-1]])
    seen = slope > before
    # of a wall all is seen that stands above the nearer things
    foot = np.where(np.isfinite(before), before * away + eye, surface[row, column])
    z = foot + (surface[row, column] - foot) * rng.random(slope.shape)
    return np.column_stack([x[seen], y[seen], z[seen]])


def _crowns(region: Region, ground: Image, low: Floats, high: Floats, rng: np.random.Generator) -> Floats:
    """Return points on the lower and outer parts of crowns, and on trunks; some trees have gone meanwhile."""
    trees = region.things(low, high).trees
    inside = ((trees[:, :2] > low) & (trees[:, :2] < high)).all(axis=1) & (rng.random(len(trees)) > 0.05)
    east, north, radius, height = np.repeat(trees[inside], 60, axis=0).T
    count = len(east)
    angle, up = rng.uniform(0.0, 2 * np.pi, count), rng.random(count)
    trunk = up < 0.3
    r = np.where(trunk, 0.2, radius * np.sqrt(1.0 - np.clip((up - 0.55) / 0.45, 0.0, 1.0) ** 2))
    up = np.where(trunk, up * 1.8, np.maximum(up, 0.5))
    x, y = east + r * np.cos(angle), north + r * np.sin(angle)
    column = np.clip(((x - low[0]) / STEP_M).astype(int), 0, ground.shape[1] - 1)
    row = np.clip(((y - low[1]) / STEP_M).astype(int), 0, ground.shape[0] - 1)
    return np.column_stack([x, y, ground[row, column] + up * height])


def write_tile(folder: Path, region: Region, low: tuple[float, float], edge: float, per_m2: float) -> Path:
    """Write one aerial tile, named by its corner in kilometres and metres; return its path."""
    xyz = aerial(region, np.array(low), np.array(low) + edge, per_m2)
    path = folder / f"tile_{low[0]:06.0f}_{low[1]:06.0f}.laz"
    write_laz(path, ArrayCloud(xyz, CRS.from_epsg(EPSG)))
    return path


def write_scan(
    path: Path, region: Region, middle: tuple[float, float], seed: int, radius: float
) -> tuple[Floats, Floats]:
    """Write a scan in a frame of its own, turned by any yaw and tilted by up to 3 degrees.

    Returns:
        4x4 from its coordinates to those of the region's CRS, and the (2,) mean of its points there.

    """
    xyz = scan(region, np.array(middle), seed, radius)
    rng = np.random.default_rng([region.seed, 5, seed])
    tilt = np.radians(rng.uniform(-2.0, 2.0, 2))
    c, s = np.cos(tilt), np.sin(tilt)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c[0], -s[0]], [0.0, s[0], c[0]]])
    about_y = np.array([[c[1], 0.0, s[1]], [0.0, 1.0, 0.0], [-s[1], 0.0, c[1]]])
    R = transforms.yaw_matrix(float(rng.uniform(0.0, 2 * np.pi))) @ about_x @ about_y
    T_region_scan = transforms.compose(R, np.array([*(np.array(middle) + CORNER), float(xyz[:, 2].mean())]))
    local = transforms.apply(transforms.inverse(T_region_scan), xyz)
    write_laz(path, ArrayCloud(local))
    return T_region_scan, transforms.apply(T_region_scan, local.mean(axis=0)[None])[0, :2]
