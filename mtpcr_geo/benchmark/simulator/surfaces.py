"""Plates, crowns and posts on smooth land, and points sampled directly on them: scans without rays.

Many thousand equal things are sampled at once. What hides what is simple: from above, solid plates hide the
ground below, and crowns most of it; from the ground, points get rarer with the distance from the
scanner's way, and what faces the sky is seen little.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from mtpcr_geo.benchmark.simulator.scanners import HeightAt
from mtpcr_geo.core.arrays import Floats, Indices, Mask

COVER_CELL_M = 0.25
COVER_DENSITY = 60.0
CROWN_HIDES = 0.7
WALL_FROM_AIR = 0.04
"""Aerial points on a square metre of an upright plate, over those on one of level ground."""
OPEN_BELOW = 0.45
"""The ground is seen from the side below solid plates that are seen this well from the ground."""
NEAR_M = 9.0
"""From the ground, points are half as dense at this distance from the scanner's way."""
NOISE_M = 0.02
DRIFT_M = 0.03


@dataclass(frozen=True)
class Rectangle:
    """Part of the plane.

    Attributes:
        low, high: (2,) metres.

    """

    low: Floats
    high: Floats

    def contains(self, xy: Floats, margin: float = 0.0) -> Mask:
        """Return which (n, 2 or 3) places lie in it, or within `margin` metres of it."""
        at = np.asarray(xy)[:, :2]
        return np.asarray(((at >= self.low - margin) & (at < self.high + margin)).all(axis=1))

    @property
    def area(self) -> float:
        """Return the area, square metres."""
        return float(np.prod(self.high - self.low))


@dataclass(frozen=True)
class Plates:
    """Parallelograms.

    Attributes:
        centre: (n, 3) metres.
        u, v: (n, 3) half edges, metres.
        from_ground: (n,) points per square metre that a ground scanner gets, over those of a wall as near.
        solid: (n,) whether it hides the ground below it from the air.

    """

    centre: Floats
    u: Floats
    v: Floats
    from_ground: Floats
    solid: Mask


@dataclass(frozen=True)
class Crowns:
    """Ellipsoids of leaves.

    Attributes:
        centre, radii: (n, 3) metres.
        yaw: (n,) turn of the radii about the vertical, radians.

    """

    centre: Floats
    radii: Floats
    yaw: Floats


@dataclass
class Scene:
    """What is scanned.

    Attributes:
        ground: height of the land.
        plates, crowns: in parts, in order of making.
        posts: upright cylinders, (n, 5): foot x, y, z, height, radius in metres.

    """

    ground: HeightAt
    plates: list[Plates] = field(default_factory=list)
    crowns: list[Crowns] = field(default_factory=list)
    posts: list[Floats] = field(default_factory=list)

    def add_plates(
        self, centre: Floats, u: Floats, v: Floats, from_ground: float = 1.0, solid: bool = True
    ) -> None:
        """Add plates, each array (n, 3) metres."""
        n = len(centre)
        self.plates.append(Plates(centre, u, v, np.full(n, from_ground), np.full(n, solid)))

    def add_boxes(
        self, xy: Floats, yaw: Floats, size: Floats, base: Floats, *, roof_from_ground: float = 0.15
    ) -> None:
        """Add boxes.

        Args:
            xy: (n, 2) middles, metres.
            yaw: (n,) radians.
            size: (n, 3) width, depth and height, metres.
            base: (n,) heights of their feet, metres.
            roof_from_ground: how well their tops are seen from the ground; low boxes better.

        """
        along, across = _axes(yaw)
        w, d, h = (size / 2).T[:, :, None]
        foot = np.c_[xy, base]
        up = np.array([0.0, 0.0, 1.0])
        self.add_plates(foot + 2 * h * up, w * along, d * across, roof_from_ground)
        for sign in (-1.0, 1.0):
            self.add_plates(foot + sign * d * across + h * up, w * along, h * up, 1.0, False)
            self.add_plates(foot + sign * w * along + h * up, d * across, h * up, 1.0, False)

    def add_gables(self, xy: Floats, yaw: Floats, size: Floats, base: Floats, rise: Floats) -> None:
        """Add houses with saddle roofs, ridges along their width.

        Args:
            xy: (n, 2) middles, metres.
            yaw: (n,) radians.
            size: (n, 3) width, depth and height of the eaves, metres.
            base: (n,) heights of their feet, metres.
            rise: (n,) of the ridge above the eaves, metres.

        """
        along, across = _axes(yaw)
        w, d, h = (size / 2).T[:, :, None]
        foot, up = np.c_[xy, base], np.array([0.0, 0.0, 1.0])
        half = 0.5 * rise[:, None]
        for sign in (-1.0, 1.0):
            middle = foot + (2 * h + half) * up + sign * 0.5 * d * across
            self.add_plates(middle, w * along, 0.5 * d * across * sign - half * up, 0.35)
            self.add_plates(foot + sign * d * across + h * up, w * along, h * up, 1.0, False)
            self.add_plates(foot + sign * w * along + h * up, d * across, h * up, 1.0, False)

    def add_crowns(self, centre: Floats, radii: Floats, yaw: Floats | None = None) -> None:
        """Add crowns, (n, 3) metres each."""
        self.crowns.append(Crowns(centre, radii, np.zeros(len(centre)) if yaw is None else yaw))

    def add_posts(self, xy: Floats, height: Floats, radius: float) -> None:
        """Add posts on the ground at (n, 2) places, (n,) metres high."""
        n = len(xy)
        self.posts.append(np.c_[xy, self.ground(xy), np.broadcast_to(height, n), np.full(n, radius)])

    def seen_from_air(self, part: Rectangle, density: float, rng: np.random.Generator) -> Floats:
        """Sample an airborne scan: (n, 3) metres.

        Args:
            part: what is flown over.
            density: pulses per square metre.
            rng: of everything drawn.

        """
        found = []
        hidden = _Cover(part)
        for plates in self.plates:
            near = part.contains(plates.centre, 60.0)
            plan = 4 * np.abs(np.cross(plates.u, plates.v)[:, 2])
            area = 4 * np.linalg.norm(np.cross(plates.u, plates.v), axis=1)
            rate = density * np.maximum(plan, WALL_FROM_AIR * area) * near
            found.append(_on_plates(plates, rng.poisson(rate), rng))
            below = _on_plates(plates, rng.poisson(COVER_DENSITY * plan * near * plates.solid), rng)
            hidden.mark(below, 1.0)
        for crowns in self.crowns:
            near = part.contains(crowns.centre, 10.0)
            plan = np.pi * crowns.radii[:, 0] * crowns.radii[:, 1] * near
            found.append(_on_tops(crowns, rng.poisson(CROWN_HIDES * density * plan), rng))
            hidden.mark(_on_tops(crowns, rng.poisson(COVER_DENSITY * plan), rng), CROWN_HIDES)
        for posts in self.posts:
            top = posts[part.contains(posts) & (rng.random(len(posts)) < 0.5)]
            found.append(np.c_[top[:, :2], top[:, 2] + top[:, 3]])
        xy = rng.uniform(part.low, part.high, (rng.poisson(density * part.area), 2))
        xy = xy[rng.random(len(xy)) >= hidden.at(xy)]
        found.append(np.c_[xy, self.ground(xy)])
        xyz = np.concatenate(found)
        xyz += rng.normal(0, NOISE_M, xyz.shape) * [2.0, 2.0, 1.0]
        return np.asarray(xyz[part.contains(xyz)])

    def seen_from_ground(
        self, part: Rectangle, path: Floats, density: float, rng: np.random.Generator
    ) -> Floats:
        """Sample the map of a scanner carried along a path: (n, 3) metres.

        Args:
            part: what is kept.
            path: (k, 2) metres, points some metres apart.
            density: points per square metre of ground on the way itself.
            rng: of everything drawn.

        """
        tree = cKDTree(path)
        found = []
        hidden = _Cover(part)
        for plates in self.plates:
            near = part.contains(plates.centre, 60.0)
            area = 4 * np.linalg.norm(np.cross(plates.u, plates.v), axis=1)
            found.append(
                _on_plates(plates, rng.poisson(1.5 * density * area * plates.from_ground * near), rng)
            )
            # what is hardly seen from the ground is a roof, and nobody scans below it
            roofs = plates.solid & (plates.from_ground < OPEN_BELOW) & near
            hidden.mark(_on_plates(plates, rng.poisson(COVER_DENSITY * area * roofs), rng), 1.0)
        for crowns in self.crowns:
            near = part.contains(crowns.centre, 10.0)
            mean = crowns.radii.mean(axis=1)
            found.append(_on_sides(crowns, rng.poisson(density * 4 * np.pi * mean**2 * near), rng))
        for posts in self.posts:
            count = rng.poisson(
                6 * density * 2 * np.pi * posts[:, 3] * posts[:, 4] * part.contains(posts, 1.0)
            )
            found.append(_on_posts(posts, count, rng))
        xy = rng.uniform(part.low, part.high, (rng.poisson(density * part.area), 2))
        xy = xy[rng.random(len(xy)) >= hidden.at(xy)]
        found.append(np.c_[xy, self.ground(xy)])
        xyz = np.concatenate(found)
        away, nearest = tree.query(xyz[:, :2])
        keep = rng.random(len(xyz)) < 1.0 / (1.0 + (away / NEAR_M) ** 2)
        xyz, nearest = xyz[keep], nearest[keep]
        xyz += rng.normal(0, NOISE_M, xyz.shape) + _drift(len(path), rng)[nearest]
        return np.asarray(xyz[part.contains(xyz)])


class _Cover:
    """How much of the ground is hidden from the air, in cells."""

    def __init__(self, part: Rectangle) -> None:
        self.low = part.low
        self.share = np.zeros(tuple(np.ceil((part.high - part.low) / COVER_CELL_M).astype(int)))

    def _cells(self, xy: Floats) -> tuple[Indices, Indices, Mask]:
        i, j = np.floor((xy[:, :2] - self.low) / COVER_CELL_M).astype(np.int64).T
        inside = (i >= 0) & (j >= 0) & (i < self.share.shape[0]) & (j < self.share.shape[1])
        return i, j, inside

    def mark(self, xyz: Floats, share: float) -> None:
        i, j, inside = self._cells(xyz)
        i, j = i[inside], j[inside]
        self.share[i, j] = np.maximum(self.share[i, j], share)

    def at(self, xy: Floats) -> Floats:
        i, j, inside = self._cells(xy)
        return np.where(inside, self.share[np.where(inside, i, 0), np.where(inside, j, 0)], 0.0)


def _axes(yaw: Floats) -> tuple[Floats, Floats]:
    """Return the unit vectors (n, 3) along and across things turned by `yaw` (n,)."""
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    return np.stack([c, s, zero], axis=1), np.stack([-s, c, zero], axis=1)


def _on_plates(plates: Plates, count: Indices, rng: np.random.Generator) -> Floats:
    which = np.repeat(np.arange(len(count)), count)
    a, b = rng.uniform(-1, 1, (2, len(which), 1))
    return np.asarray(plates.centre[which] + a * plates.u[which] + b * plates.v[which])


def _on_tops(crowns: Crowns, count: Indices, rng: np.random.Generator) -> Floats:
    """Sample crowns as seen from above: their upper halves, some of the pulses a little inside."""
    which = np.repeat(np.arange(len(count)), count)
    out, angle = np.sqrt(rng.random(len(which))), rng.uniform(0, 2 * np.pi, len(which))
    depth = np.minimum(rng.exponential(0.18, len(which)), 1.2)
    unit = np.stack([out * np.cos(angle), out * np.sin(angle), np.sqrt(1 - out**2) - depth], axis=1)
    return _placed(crowns, which, unit)


def _on_sides(crowns: Crowns, count: Indices, rng: np.random.Generator) -> Floats:
    """Sample crowns as seen from below and beside: their tops are rare."""
    which = np.repeat(np.arange(len(count)), count)
    unit = rng.normal(size=(len(which), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    keep = rng.random(len(which)) < np.where(unit[:, 2] > 0.5, 0.25, 1.0)
    which, unit = which[keep], unit[keep]
    unit *= 1.0 - np.minimum(rng.exponential(0.15, (len(which), 1)), 0.7)
    return _placed(crowns, which, unit)


def _placed(crowns: Crowns, which: Indices, unit: Floats) -> Floats:
    x, y, z = (unit * crowns.radii[which]).T
    c, s = np.cos(crowns.yaw[which]), np.sin(crowns.yaw[which])
    return np.asarray(crowns.centre[which] + np.stack([c * x - s * y, s * x + c * y, z], axis=1))


def _on_posts(posts: Floats, count: Indices, rng: np.random.Generator) -> Floats:
    which = np.repeat(np.arange(len(count)), count)
    angle, up = rng.uniform(0, 2 * np.pi, len(which)), rng.random(len(which))
    x, y, z, height, radius = posts[which].T
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), z + up * height], axis=1)


def _drift(count: int, rng: np.random.Generator) -> Floats:
    """Return a slow error of the scanner's own place, (count, 3) metres, at points of its way."""
    knots = max(4, count // 12)
    value = rng.normal(0, DRIFT_M, (knots, 3))
    at = np.linspace(0, knots - 1, count)
    return np.stack([np.interp(at, np.arange(knots), value[:, k]) for k in range(3)], axis=1)
