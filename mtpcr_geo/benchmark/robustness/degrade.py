"""What another instrument, season or work flow makes of a cloud: real pairs, made worse one way at a time.

Each way takes a cloud (n, 3), metres, z up, and returns what is left of it in the same frame. A registration
should bear them: none moves a part of the nine sites by more than a metre.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from mtpcr_geo.core.arrays import Floats, Indices

THINNED_TO = 0.1
NOISE_M = 0.1
STRAY = 0.02
LOW_BELOW_M = 5.0
LEAFLESS_ABOVE_M = 3.0
LEAFLESS_SHARE = 0.1
GRID_M = 0.25
BOW_SHARE, BOW_M = 0.01, 0.5
SCALE = 1.002
TWICE_M = 0.2
EYE_M = 1.8
CORRIDOR_SHARE = 0.3
HOLES = 0.5
MULTIPATH = 0.05

_GROUND_CELL_M = 4.0
_BEAMS = 180
"""Directions around a scanner, 2 degrees apart: between aerial points it would see through walls."""
_BEHIND = 1.3
"""Times as far as the nearest point of a direction beyond which others are hidden."""

Way = Callable[[Floats, np.random.Generator], Floats]


def thinned(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Keep a tenth of the points: an older instrument, or a cloud that was thinned for sending."""
    return np.asarray(xyz[rng.random(len(xyz)) < THINNED_TO])


def noisy(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Add noise of 0.1 m to each coordinate: a handheld scanner or depth camera."""
    return np.asarray(xyz + rng.normal(0.0, NOISE_M, xyz.shape))


def stray(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Add 2 % of points anywhere, up to a third of the extent beyond: birds, dust, the sun."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    reach = (high - low) / 3.0
    count = max(1, int(STRAY * len(xyz)))
    return np.concatenate([xyz, rng.uniform(low - reach, high + reach, (count, 3))])


def multipath(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Mirror 5 % of the points below the ground, as wet ground and windows do."""
    which = rng.random(len(xyz)) < MULTIPATH
    above = heights(xyz)
    down = xyz[which] - [0.0, 0.0, 2.0] * above[which, None]
    return np.concatenate([xyz, down])


def low(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Keep what lies less than 5 m above the ground: a short-ranged scanner below the crowns."""
    return np.asarray(xyz[heights(xyz) < LOW_BELOW_M])


def leafless(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Keep a tenth of what lies higher than 3 m above the ground: winter, where there are trees."""
    return np.asarray(xyz[(heights(xyz) < LEAFLESS_ABOVE_M) | (rng.random(len(xyz)) < LEAFLESS_SHARE)])


def gridded(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Keep one point of each voxel of 0.25 m, at its middle: an exported occupancy grid."""
    return np.asarray((np.unique(np.floor(xyz / GRID_M), axis=0) + 0.5) * GRID_M)


def bent(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Bow the cloud along its length: its ends by 1 % of half its length, 0.5 m at most, aside and down."""
    away = xyz - xyz.mean(axis=0)
    axis = np.linalg.eigh(np.cov(away[:, :2].T))[1][:, 1]
    along = away[:, :2] @ axis
    half = float(np.abs(along).max())
    bow = min(BOW_SHARE * half, BOW_M) * (along / half) ** 2
    return np.asarray(xyz + bow[:, None] * [-axis[1], axis[0], -0.5])


def stretched(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Stretch the cloud by 0.2 % about its middle: a wrong ground scale factor, or clock of a scanner."""
    middle = xyz.mean(axis=0)
    return np.asarray((xyz - middle) * SCALE + middle)


def twice(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Show everything twice, 0.2 m apart: passes that were not adjusted to each other."""
    way = rng.normal(size=3) * [1.0, 1.0, 0.3]
    return np.concatenate([xyz, xyz + TWICE_M * way / np.linalg.norm(way)])


def holed(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Cut blocks out until half of the area is missing: occlusion, and water."""
    low_, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    size = (high - low_).max()
    cell = np.floor((xyz[:, :2] - low_) / size * 40.0).astype(np.int64).clip(0, 39)
    field = ndimage.gaussian_filter(rng.normal(size=(40, 40)), 1.5)
    here = field[cell[:, 0], cell[:, 1]]
    filled = np.unique(cell, axis=0)
    return np.asarray(xyz[here > np.quantile(field[filled[:, 0], filled[:, 1]], HOLES)])


def corridor(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Keep a winding strip of three tenths of the area: what is seen from a vehicle on its way."""
    middle = np.median(xyz, axis=0)
    yaw = rng.uniform(0.0, np.pi)
    east, north = (xyz - middle)[:, :2].T
    u, v = np.cos(yaw) * east + np.sin(yaw) * north, np.cos(yaw) * north - np.sin(yaw) * east
    length = np.abs(u).max()
    off = np.abs(v - 0.2 * length * np.sin(2.0 * np.pi * u / length + rng.uniform(0.0, 2.0 * np.pi)))
    return np.asarray(xyz[off <= np.quantile(off, CORRIDOR_SHARE)])


def one_station(xyz: Floats, rng: np.random.Generator) -> Floats:
    """Keep what is seen from one place 1.8 m above the ground, the nearer the denser: a tripod's scan."""
    near = np.argsort(((xyz - np.median(xyz, axis=0))[:, :2] ** 2).sum(axis=1))[: max(1, len(xyz) // 20)]
    on_ground = near[heights(xyz)[near] < 0.5]
    if not len(on_ground):
        on_ground = near
    eye = xyz[rng.choice(on_ground)] + [0.0, 0.0, EYE_M]
    away = xyz - eye
    plan = np.hypot(away[:, 0], away[:, 1])
    distance = np.maximum(np.linalg.norm(away, axis=1), 0.5)
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    up = np.arctan2(away[:, 2], plan)
    beam = np.floor((azimuth + np.pi) / (2.0 * np.pi) * _BEAMS).astype(np.int64)
    beam = beam * _BEAMS + np.floor((up + np.pi / 2.0) / np.pi * _BEAMS).astype(np.int64)
    nearest = np.full(int(beam.max()) + 1, np.inf)
    np.minimum.at(nearest, beam, distance)
    seen = distance < _BEHIND * nearest[beam]
    reach = np.quantile(distance, 0.25)
    return np.asarray(xyz[seen & (rng.random(len(xyz)) < (reach / distance) ** 2)])


def heights(xyz: Floats) -> Floats:
    """Return the height (n,) of each point above the lowest ones about it, metres.

    The ground is the lowest point of each cell of 4 m, opened over three cells.
    """
    cell: Indices = np.floor(xyz[:, :2] / _GROUND_CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    lowest = np.full(tuple(cell.max(axis=0) + 1), np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), xyz[:, 2])
    opened = ndimage.maximum_filter(ndimage.minimum_filter(lowest, 3), 3)
    ground = np.minimum(lowest, np.where(np.isfinite(opened), opened, lowest))
    return np.asarray(xyz[:, 2] - ground[cell[:, 0], cell[:, 1]])


WAYS: dict[str, Way] = {
    "thinned": thinned,
    "noisy": noisy,
    "stray": stray,
    "multipath": multipath,
    "low": low,
    "leafless": leafless,
    "gridded": gridded,
    "bent": bent,
    "stretched": stretched,
    "twice": twice,
    "holed": holed,
    "corridor": corridor,
    "one_station": one_station,
}
"""The ways in which a source is made worse, by name."""
