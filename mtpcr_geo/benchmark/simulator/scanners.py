"""Scanners on their ways: where their beams start and point.

Four kinds: a spinning lidar on a ground robot, a scanner on a tripod, a spinning lidar under a UAV,
and an airborne line scanner. Beams are a random, seeded share of the instrument's (a robot's 300 000 a
second would be far too many), so a cloud stands for the thinned map that such an instrument gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mtpcr_geo.benchmark.simulator.instruments import Beams
from mtpcr_geo.core.arrays import Floats, Mask


class HeightAt(Protocol):
    """A function that gives the ground's height in metres at (n, 2) positions."""

    def __call__(self, xy: Floats) -> Floats:
        """Return (n,) metres."""


def _drift(time: Floats, size: float, period: float, rng: np.random.Generator) -> Floats:
    """Draw a smooth position error, (n, 3) metres with standard deviation `size`, about 0 on the whole."""
    if not len(time) or size <= 0:
        return np.zeros((len(time), 3))
    knots = max(4, int(np.ceil(np.ptp(time) / period)) + 3)
    value = rng.normal(0, size, (knots, 3)) * [1.0, 1.0, 0.6]
    value -= value.mean(axis=0)
    at = time.min() + np.linspace(0, 1, knots) * max(float(np.ptp(time)), 1e-9)
    return np.stack([np.interp(time, at, value[:, k]) for k in range(3)], axis=1)


def _along(path: Floats, s: Floats) -> tuple[Floats, Floats]:
    """Return places (n, 2) at path lengths `s` metres, and headings (n,) in radians."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    xy = np.stack([np.interp(s, length, path[:, k]) for k in (0, 1)], axis=1)
    before = np.stack([np.interp(s - 1.0, length, path[:, k]) for k in (0, 1)], axis=1)
    after = np.stack([np.interp(s + 1.0, length, path[:, k]) for k in (0, 1)], axis=1)
    step = after - before
    return xy, np.arctan2(step[:, 1], step[:, 0])


def path_length(path: Floats) -> float:
    """Measure a (k, 2) path in metres."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def robot_beams(
    path: Floats,
    ground: HeightAt,
    count: int,
    rng: np.random.Generator,
    *,
    mast_m: float = 1.3,
    speed: float = 1.3,
    low_deg: float = -15.0,
    high_deg: float = 15.0,
    rings: int = 16,
    drift_m: float = 0.04,
) -> Beams:
    """Beams of a spinning lidar on a robot that follows a path.

    Args:
        path: (k, 2) metres.
        ground: height of the ground.
        count: number of beams.
        rng: source of chance.
        mast_m: height of the lidar above ground, metres.
        speed: metres per second.
        low_deg: elevation of the lowest ring, degrees.
        high_deg: elevation of the highest ring, degrees.
        rings: number of rings.
        drift_m: standard deviation of the robot's position error, metres.

    """
    s = np.sort(rng.uniform(0, path_length(path), count))
    xy, heading = _along(path, s)
    z = ground(xy) + mast_m
    ahead, _ = _along(path, s + 0.6)
    behind, _ = _along(path, s - 0.6)
    pitch = np.arctan2(ground(ahead) - ground(behind), np.linalg.norm(ahead - behind, axis=1) + 1e-9)
    pitch += 0.01 * np.sin(s * 1.7)
    elevation = np.deg2rad(np.linspace(low_deg, high_deg, rings))[rng.integers(0, rings, count)]
    azimuth = rng.uniform(0, 2 * np.pi, count)
    forward = np.cos(elevation) * np.cos(azimuth)
    left = np.cos(elevation) * np.sin(azimuth)
    up = np.sin(elevation)
    level = np.cos(pitch) * forward - np.sin(pitch) * up
    rise = np.sin(pitch) * forward + np.cos(pitch) * up
    c, n = np.cos(heading), np.sin(heading)
    direction = np.stack([c * level - n * left, n * level + c * left, rise], axis=1)
    time = s / speed
    return Beams(np.c_[xy, z], direction, time, _drift(time, drift_m, 40.0, rng))


def tripod_beams(
    places: Floats, ground: HeightAt, count: int, rng: np.random.Generator, *, mast_m: float = 1.7
) -> Beams:
    """Beams of a scanner set up on a tripod at several places.

    Args:
        places: (k, 2) metres.
        ground: height of the ground.
        count: number of beams in all.
        rng: source of chance.
        mast_m: height of the scanner above ground, metres.

    """
    which = np.sort(rng.integers(0, len(places), count))
    low, high = np.deg2rad([-55.0, 88.0])
    elevation = rng.uniform(low, high, count)
    azimuth = rng.uniform(0, 2 * np.pi, count)
    origin = np.c_[places, ground(places) + mast_m][which]
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    drift = rng.normal(0, 0.01, (len(places), 3))[which]
    return Beams(origin, direction, which * 240.0 + rng.uniform(0, 200, count), drift)


@dataclass(frozen=True)
class Block:
    """A rectangle to be covered from the air, turned by `yaw` about the site's origin.

    Attributes:
        low, high: (2,) metres in turned coordinates.
        yaw: radians from site x to the block's x, counter-clockwise.

    """

    low: Floats
    high: Floats
    yaw: float

    def to_block(self, xy: Floats) -> Floats:
        """Take (n, 2) site metres to block metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.asarray(xy @ np.array([[c, -s], [s, c]]))

    def to_site(self, xy: Floats) -> Floats:
        """Take (n, 2) block metres to site metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.asarray(xy @ np.array([[c, s], [-s, c]]))

    def contains(self, xy: Floats) -> Mask:
        """Return which (n, 2) site positions lie in the block."""
        uv = self.to_block(xy)
        return np.asarray(((uv >= self.low) & (uv < self.high)).all(axis=1))

    @property
    def area(self) -> float:
        """Return the area, square metres."""
        return float(np.prod(self.high - self.low))


def airborne_beams(
    block: Block,
    ground: HeightAt,
    density: float,
    rng: np.random.Generator,
    *,
    height_m: float = 700.0,
    swath_m: float = 320.0,
    lines: int = 2,
) -> Beams:
    """Pulses of a line scanner on parallel flight lines along the block's y axis.

    Args:
        block: what to cover.
        ground: height of the ground.
        density: pulses per square metre in all.
        rng: source of chance.
        height_m: flying height above ground, metres.
        swath_m: distance of neighbouring lines, metres.
        lines: number of lines that see each place.

    """
    step = np.sqrt(lines / density)
    columns, rows = np.meshgrid(*(np.arange(a, b, step) for a, b in zip(block.low, block.high, strict=True)))
    even = np.stack([columns.ravel(), rows.ravel()], axis=1)
    base = float(np.median(ground(block.to_site(rng.uniform(block.low, block.high, (200, 2))))))
    origin, aim, time = [], [], []
    for line in range(lines):
        # scan lines across the flight, a little uneven, each line with a lattice of its own
        spot = even + step * (rng.uniform(0, 1, 2) + rng.normal(0, 0.22, even.shape))
        # each line flies beside the block, the other on its other side: facades are seen from both
        centre = (
            0.5 * (block.low[0] + block.high[0]) + swath_m * (line - 0.5 * (lines - 1)) + rng.normal(0, 20)
        )
        u = centre + 3.0 * np.sin(spot[:, 1] / 300.0 + line)
        start = block.to_site(np.stack([u, spot[:, 1]], 1))
        site = block.to_site(spot)
        origin.append(np.c_[start, np.full(len(start), base + height_m)])
        aim.append(np.c_[site, ground(site)])
        time.append(line * 600.0 + (spot[:, 1] - block.low[1]) / 65.0)
    start_xyz, end_xyz, when = np.concatenate(origin), np.concatenate(aim), np.concatenate(time)
    direction = end_xyz - start_xyz
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    drift = np.concatenate([_drift(t, 0.03, 3.0, rng) for t in time])
    return Beams(start_xyz, direction, when, drift)


def uav_beams(
    block: Block,
    ground: HeightAt,
    density: float,
    rng: np.random.Generator,
    *,
    height_m: float = 70.0,
    spacing_m: float = 45.0,
    speed: float = 6.0,
) -> Beams:
    """Beams of a spinning lidar under a UAV, its axis along the flight, on lines along the block's y.

    Args:
        block: what to cover.
        ground: height of the ground.
        density: beams per square metre of level ground, about.
        rng: source of chance.
        height_m: flying height above the median ground, metres.
        spacing_m: distance of neighbouring lines, metres.
        speed: metres per second.

    """
    width, length = block.high - block.low
    # many beams fall beside the block; a fringe of this width stands for them
    fringe = 0.4 * height_m * np.tan(np.deg2rad(55.0))
    count = int(density * (width + 2 * fringe) * (length + 40.0))
    lines = max(1, int(np.ceil(width / spacing_m)))
    which = rng.integers(0, lines, count)
    v = rng.uniform(block.low[1] - 20, block.high[1] + 20, count)
    u = block.low[0] + width * (which + 0.5) / lines + 1.0 * np.sin(v / 40.0 + which)
    xy = block.to_site(np.stack([u, v], 1))
    base = float(np.median(ground(xy[:500])))
    z = base + height_m + 1.5 * np.sin(v / 60.0)
    roll = rng.uniform(-np.deg2rad(55.0), np.deg2rad(55.0), count) + 0.03 * np.sin(v / 7.0)
    ring = np.deg2rad(np.linspace(-15, 15, 16))[rng.integers(0, 16, count)]
    local = np.stack([np.cos(ring) * np.sin(roll), np.sin(ring), -np.cos(ring) * np.cos(roll)], 1)
    side = block.to_site(local[:, :2])
    time = (which * (length + 60.0) + np.where(which % 2, block.high[1] - v, v - block.low[1])) / speed
    return Beams(np.c_[xy, z], np.c_[side, local[:, 2]], time, _drift(time, 0.03, 25.0, rng))
