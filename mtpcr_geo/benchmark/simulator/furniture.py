"""What else stands about or goes by: cars, people, poles with wires, garden walls and fences."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mtpcr_geo.benchmark.simulator.mesh import Frame, Material, MeshBuilder
from mtpcr_geo.core.arrays import Floats


def add_car(out: MeshBuilder, frame: Frame, rng: np.random.Generator) -> None:
    """Add a car: body and cabin; one in eight is a van."""
    length, width = rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.9)
    x, y = length / 2, width / 2
    if rng.random() < 0.125:
        out.box(frame, (-x - 0.6, -y, 0.3), (x + 0.6, y, rng.uniform(1.9, 2.6)), Material.METAL)
        return
    bonnet, roof = rng.uniform(0.75, 0.95), rng.uniform(1.4, 1.65)
    out.box(frame, (-x, -y, 0.25), (x, y, bonnet), Material.METAL)
    low = np.array([[-0.42 * length, -y], [0.28 * length, -y], [0.28 * length, y], [-0.42 * length, y]])
    high = np.array([[-0.30 * length, -0.8 * y], [0.08 * length, -0.8 * y]])
    high = np.concatenate([high, high[::-1] * [1, -1]])
    a = np.c_[low, np.full(4, bonnet)]
    b = np.c_[high, np.full(4, roof)]
    sides = np.stack([np.stack([a[i], a[(i + 1) % 4], b[(i + 1) % 4], b[i]]) for i in range(4)])
    out.polygons(frame.place(sides), Material.GLASS)
    out.polygons(frame.place(b[None]), Material.METAL)


def add_walker(out: MeshBuilder, way: Floats, z: Floats, rng: np.random.Generator) -> None:
    """Add one who walks by: the same body again and again along a (k, 2) way with ground heights `z` (k,)."""
    tall, broad = rng.uniform(1.1, 1.9), rng.uniform(0.2, 0.27)
    for (x, y), g in zip(way, z, strict=True):
        frame = Frame(float(x), float(y), float(g), float(rng.uniform(0, np.pi)))
        out.box(frame, (-broad, -0.14, 0.0), (broad, 0.14, tall), Material.PASSING)


def add_traffic(out: MeshBuilder, frames: Sequence[Frame], rng: np.random.Generator) -> None:
    """Add a car that drives by: its outline at each of the places it is met at."""
    x, y, top = rng.uniform(1.9, 2.4), rng.uniform(0.8, 0.95), rng.uniform(1.4, 1.9)
    for frame in frames:
        out.box(frame, (-x, -y, 0.3), (x, y, top), Material.PASSING)


def add_wall(out: MeshBuilder, line: Floats, z: Floats, height: float, thick: float = 0.2) -> None:
    """Add a garden wall or fence along a (k, 2) line of metres with ground heights `z` (k,)."""
    for (p, q), (zp, zq) in zip(pairwise(line), pairwise(z), strict=True):
        length = float(np.linalg.norm(q - p))
        if length < 0.2:
            continue
        middle = 0.5 * (p + q)
        yaw = float(np.arctan2(*(q - p)[::-1]))
        frame = Frame(float(middle[0]), float(middle[1]), float(min(zp, zq)), yaw)
        out.box(
            frame,
            (-length / 2, -thick / 2, -0.5),
            (length / 2, thick / 2, height + abs(zq - zp)),
            Material.STONE,
        )


def add_poles(out: MeshBuilder, xy: Floats, z: Floats, height: float, wires: bool) -> None:
    """Add a row of poles at (k, 2) places with ground heights (k,), joined by sagging wires if asked.

    Args:
        out: where to.
        xy, z: places and ground, metres.
        height: of the poles, metres.
        wires: whether two wires hang between neighbours.

    """
    for (x, y), g in zip(xy, z, strict=True):
        frame = Frame(float(x), float(y), float(g), 0.0)
        out.box(frame, (-0.09, -0.09, -0.3), (0.09, 0.09, height), Material.METAL)
        if not wires:
            out.box(frame, (-0.1, -0.1, height - 0.15), (1.1, 0.1, height), Material.METAL)
    if not wires or len(xy) < 2:
        return
    t = np.linspace(0, 1, 13)
    for i in range(len(xy) - 1):
        along = xy[i + 1] - xy[i]
        gap = float(np.linalg.norm(along))
        if not 5.0 < gap < 80.0:
            continue
        side = np.array([-along[1], along[0]]) / gap
        for offset in (-0.4, 0.4):
            p = xy[i] + t[:, None] * along + offset * side
            h = (1 - t) * z[i] + t * z[i + 1] + height - 0.2 - 4 * 0.02 * gap * t * (1 - t)
            a = np.c_[p, h]
            up, out_ = np.array([0, 0, 0.03]), np.array([*side * 0.03, 0])
            for shift in (up, out_):
                quads = np.stack([a[:-1] - shift, a[1:] - shift, a[1:] + shift, a[:-1] + shift], 1)
                out.polygons(quads, Material.WIRE)
