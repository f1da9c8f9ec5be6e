"""Sites that look alike when turned or reflected: a stadium, a roundabout, a courtyard, a row of tanks.

    source, target = symmetric_pair("stadium", seed=3)

Each half of what was built is the other half turned by 180 degrees. Trees stand anywhere, and cars differ
between the epochs.
The source shows one half from the ground, the target the other from the air, and both share a strip along the
middle; with ``apart`` they share nothing. The pose turned by half a turn brings all of the source onto the
target, and is wrong by the width of the site.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from mtpcr_geo.benchmark.simulator.scanners import HeightAt
from mtpcr_geo.benchmark.simulator.surfaces import Rectangle, Scene
from mtpcr_geo.core.arrays import Floats

SymmetricKind = Literal["stadium", "roundabout", "courtyard", "tanks"]
KINDS: tuple[SymmetricKind, ...] = get_args(SymmetricKind)
SITE_M = np.array([220.0, 170.0])
STRIP_M = (14.0, 30.0)
"""Width of the strip that both clouds show."""
APART_M = 5.0
GROUND_DENSITY = 12.0


def symmetric_pair(kind: SymmetricKind, seed: int, *, apart: bool = False) -> tuple[Floats, Floats]:
    """Sample both clouds of a site that looks the same when turned by 180 degrees.

    Args:
        kind: one of `KINDS`.
        seed: of everything.
        apart: whether both halves share nothing; else they share a strip.

    Returns:
        (n, 3) source and (m, 3) target in the site's frame, metres: the truth between them is the identity.

    """
    words = [seed, *kind.encode()]
    rng = np.random.default_rng([61, *words])
    half = SITE_M / 2
    strip = -APART_M if apart else float(rng.uniform(*STRIP_M))
    source = Rectangle(-half, np.array([strip / 2, half[1]]))
    target = Rectangle(np.array([-strip / 2, -half[1]]), half)
    scenes = []
    for epoch in (0, 1):
        scene = Scene(_land(rng=np.random.default_rng([62, *words])))
        _LAYOUTS[kind](scene, np.random.default_rng([63, *words]))
        _cars(scene, np.random.default_rng([64, epoch, *words]))
        scenes.append(scene)
    lanes = np.arange(-half[1] + 5, half[1], 22.0)
    along = np.arange(-half[0], strip / 2, 2.0)
    path = np.stack(np.meshgrid(along, lanes), axis=-1).reshape(-1, 2)
    low = scenes[0].seen_from_ground(source, path, GROUND_DENSITY, rng)
    high = scenes[1].seen_from_air(target, float(rng.uniform(4.0, 10.0)), rng)
    return low, high


def _land(rng: np.random.Generator) -> HeightAt:
    """Make a shallow bowl, the same when turned."""
    depth, wide = rng.uniform(0.0, 1.5), rng.uniform(0.5, 1.0)

    def height(xy: Floats) -> Floats:
        xy = np.asarray(xy, np.float64) / SITE_M
        return np.asarray(depth * 4 * (xy[:, 0] ** 2 + wide * xy[:, 1] ** 2))

    return height


def _both(xy: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Return places (n, 2) and headings (n,), and the same turned by half a turn."""
    return np.vstack([xy, -xy]), np.concatenate([yaw, yaw + np.pi])


def _boxes(scene: Scene, xy: Floats, yaw: Floats, size: Floats) -> None:
    at, turned = _both(xy, yaw)
    scene.add_boxes(at, turned, np.vstack([size, size]), scene.ground(at))


def _trees(scene: Scene, xy: Floats, height: Floats) -> None:
    crown = 0.36 * height
    scene.add_crowns(
        np.c_[xy, scene.ground(xy) + height - crown], np.stack([0.3 * height, 0.3 * height, crown], axis=1)
    )
    scene.add_posts(xy, np.maximum(height - crown, 0.3), 0.12)


def _houses(scene: Scene, xy: Floats, yaw: Floats, size: Floats, rise: Floats) -> None:
    at, turned = _both(xy, yaw)
    scene.add_gables(at, turned, np.vstack([size, size]), scene.ground(at), np.concatenate([rise, rise]))


def _cars(scene: Scene, epoch: np.random.Generator) -> None:
    """Park other cars in each epoch, anywhere."""
    count = int(epoch.integers(15, 40))
    xy = epoch.uniform(-SITE_M / 2, SITE_M / 2, (count, 2))
    size = np.tile([4.4, 1.8, 1.5], (count, 1))
    scene.add_boxes(xy, epoch.uniform(0, np.pi, count), size, scene.ground(xy), roof_from_ground=0.7)


def _stadium(scene: Scene, rng: np.random.Generator) -> None:
    """Stands in rising rings about a pitch, with a roof over the upper one; masts at the corners."""
    a, b = rng.uniform(58.0, 66.0), rng.uniform(44.0, 52.0)
    sectors = 2 * int(rng.integers(20, 28))
    for ring, height in enumerate((3.0, 6.5, 10.0, 13.0)):
        at = np.pi * (np.arange(sectors // 2) + 0.5) / (sectors // 2)
        wide, deep = a + 5.0 * ring, b + 5.0 * ring
        xy = np.stack([wide * np.cos(at), deep * np.sin(at)], axis=1)
        yaw = np.arctan2(deep * np.cos(at), -wide * np.sin(at))
        length = 2 * np.pi * np.hypot(wide, deep) / np.sqrt(2.0) / sectors
        _boxes(scene, xy, yaw, np.tile([length, 4.8, height], (len(xy), 1)))
    _boxes(scene, np.array([[a + 26.0, 0.0]]), np.zeros(1), np.array([[10.0, 30.0, 8.0]]))
    corners = np.array([[a + 22.0, b + 18.0], [a + 22.0, -b - 18.0]])
    scene.add_posts(np.vstack([corners, -corners]), np.full(4, 32.0), 0.4)


def _roundabout(scene: Scene, rng: np.random.Generator) -> None:
    """Lay out a round place with trees, four streets, and the same houses in each quarter."""
    radius = rng.uniform(22.0, 30.0)
    at = 2 * np.pi * np.arange(6) / 12 + rng.uniform(0, 0.5)
    ring, _ = _both(radius * np.stack([np.cos(at), np.sin(at)], axis=1), at)
    _trees(scene, ring, np.full(12, rng.uniform(5.0, 8.0)))
    count = 14
    xy = np.stack([rng.uniform(-100, 100, count), rng.uniform(40.0, 80.0, count)], axis=1)
    size = rng.uniform([8, 8, 4], [14, 11, 8], (count, 3))
    _houses(scene, xy, rng.choice([0.0, np.pi / 2], count), size, rng.uniform(2.0, 4.0, count))
    lamps = np.stack([np.arange(35.0, 110.0, 18.0), np.full(5, 6.0)], axis=1)
    scene.add_posts(np.vstack([lamps, -lamps]), np.full(2 * len(lamps), 8.0), 0.1)
    _trees(scene, rng.uniform(-SITE_M / 2, SITE_M / 2, (50, 2)), rng.uniform(3.0, 10.0, 50))


def _courtyard(scene: Scene, rng: np.random.Generator) -> None:
    """Wings about courts, point by point the same when turned."""
    for wide, deep in ((150.0, 110.0), (80.0, 50.0)):
        tall = rng.uniform(8.0, 16.0)
        size = np.array([[wide, 12.0, tall], [12.0, deep, tall]])
        _boxes(scene, np.array([[0.0, deep / 2], [wide / 2, 0.0]]), np.zeros(2), size)
    stairs = rng.uniform([-70, 20], [70, 50], (6, 2))
    _boxes(scene, stairs, np.zeros(6), np.tile([5.0, 4.0, 3.0], (6, 1)))
    _trees(scene, rng.uniform(-SITE_M / 2, SITE_M / 2, (40, 2)), rng.uniform(3.0, 9.0, 40))


def _tanks(scene: Scene, rng: np.random.Generator) -> None:
    """Round tanks (drums of many sides) in two rows, with a wall about them."""
    tall, radius = rng.uniform(7.0, 12.0), rng.uniform(11.0, 15.0)
    pitch = 2 * radius + rng.uniform(8.0, 14.0)
    x = pitch * (np.arange(-2, 3))
    for at in np.stack([x, np.full(5, pitch / 2)], axis=1):
        turns = np.pi * np.arange(4) / 4
        size = np.tile([2 * radius, 0.83 * radius, tall], (4, 1))
        _boxes(scene, np.tile(at, (4, 1)), turns, size)
    _boxes(scene, np.array([[0.0, pitch + radius]]), np.zeros(1), np.array([[5 * pitch, 0.6, 1.8]]))
    _boxes(scene, rng.uniform([-90, 60], [90, 80], (4, 2)), np.zeros(4), np.tile([9.0, 6.0, 4.0], (4, 1)))


_LAYOUTS: dict[SymmetricKind, Callable[[Scene, np.random.Generator], None]] = {
    "stadium": _stadium,
    "roundabout": _roundabout,
    "courtyard": _courtyard,
    "tanks": _tanks,
}
