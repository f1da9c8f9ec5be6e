"""Made-up plots and plantings, cheap enough for every test: the same site at every call, sampled anew."""

from __future__ import annotations

import numpy as np

SITE = 91


def terrain(xy: np.ndarray, amplitude: float = 0.6, slope: float = 0.0) -> np.ndarray:
    """Heights of gently rolling ground at (n, 2) places, metres; ``slope`` is its rise to the east."""
    rng = np.random.default_rng(SITE)
    z = slope * xy[:, 0]
    for length in (23.0, 31.0, 47.0, 71.0, 103.0):
        direction, phase = rng.uniform(0.0, 2 * np.pi, 2)
        along = xy @ np.array([np.cos(direction), np.sin(direction)])
        z = z + amplitude * length / 60.0 * np.sin(2 * np.pi * along / length + phase)
    return z


def with_trees(
    rng: np.random.Generator,
    low: np.ndarray,
    high: np.ndarray,
    density: float,
    trees: np.ndarray,
    *,
    slope: float = 0.0,
    rough: float = 0.02,
) -> np.ndarray:
    """(n, 3) points on the ground, on crowns shaped like cones and on trunks, within a box.

    Args:
        rng: of the sampling.
        low, high: (2,) corners, metres.
        density: points per square metre.
        trees: (k, 4) x, y, radius of the crown and height, metres.
        slope: rise of the ground to the east.
        rough: noise of each coordinate, metres.

    """
    n = round(density * float(np.prod(high - low)))
    xy = rng.uniform(low, high, (n, 2))
    z = terrain(xy, slope=slope)
    foot = terrain(trees[:, :2], slope=slope)
    # half of the points get through to the ground
    stopped = rng.uniform(size=n) < 0.5
    for (x, y, radius, height), base in zip(trees, foot, strict=True):
        away = np.hypot(xy[:, 0] - x, xy[:, 1] - y)
        crown = base + height * (1.0 - 0.6 * away / radius)
        z = np.where((away < radius) & stopped & (crown > z), crown, z)
    inside = ((trees[:, :2] > low) & (trees[:, :2] < high)).all(axis=1)
    trunks = []
    for (x, y, _, height), base in zip(trees[inside], foot[inside], strict=True):
        m = max(round(density / 4), 4)
        turn, up = rng.uniform(0.0, 2 * np.pi, m), rng.uniform(0.0, 0.6 * height, m)
        trunks.append(np.column_stack([x + 0.15 * np.cos(turn), y + 0.15 * np.sin(turn), base + up]))
    xyz = np.concatenate([np.column_stack([xy, z]), *trunks])
    return np.asarray(xyz + rng.normal(0.0, rough, xyz.shape))


def plot(
    rng: np.random.Generator, extent: float = 25.0, density: float = 100.0, rough: float = 0.02
) -> np.ndarray:
    """(n, 3) points of a forest plot around zero, metres; the trees are always the same."""
    site = np.random.default_rng(SITE)
    k = round(extent**2 / 16.0)
    trees = np.column_stack(
        [site.uniform(-extent / 2, extent / 2, (k, 2)), site.uniform(0.7, 2.2, k), site.uniform(4.0, 14.0, k)]
    )
    half = np.full(2, extent / 2)
    return with_trees(rng, -half, half, density, trees, rough=rough)


def planting(
    rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float], density: float = 6.0
) -> np.ndarray:
    """(n, 3) points of a planting: like trees 5 m apart, one in twelve missing, on rolling ground."""
    site = np.random.default_rng(SITE)
    x, y = (one.ravel() for one in np.meshgrid(np.arange(-200.0, 201.0, 5.0), np.arange(-200.0, 201.0, 5.0)))
    there = site.uniform(size=len(x)) > 1 / 12
    trees = np.column_stack([x, y, np.full(len(x), 1.8), np.full(len(x), 4.0)])[there]
    corners = np.array(low), np.array(high)
    near = ((trees[:, :2] > corners[0] - 2.0) & (trees[:, :2] < corners[1] + 2.0)).all(axis=1)
    return with_trees(rng, *corners, density, trees[near])
