"""Buildings: walls, roofs of several forms with eaves, chimneys, dormers, wings, plant on flat roofs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mtpcr_geo.benchmark.simulator.mesh import Frame, Material, MeshBuilder

RoofForm = Literal["gable", "hip", "shed", "flat", "mansard", "sawtooth"]
FOUNDATION_M = 3.0


@dataclass(frozen=True)
class Building:
    """One block under one roof.

    Attributes:
        frame: middle of the footprint at floor level, x along the front.
        width, depth: footprint, metres.
        wall: height of the eaves above the floor, metres.
        roof: its form.
        pitch: rise over run.
        eave: overhang, metres.

    """

    frame: Frame
    width: float
    depth: float
    wall: float
    roof: RoofForm
    pitch: float = 0.8
    eave: float = 0.4

    @property
    def ridge(self) -> float:
        """Height of the highest line above the floor, metres."""
        run = min(self.width, self.depth) if self.roof == "hip" else self.depth
        rise = {"flat": 0.0, "shed": self.depth * self.pitch, "mansard": 3.2, "sawtooth": 2.5}
        return self.wall + rise.get(self.roof, 0.5 * run * self.pitch)


def add_building(out: MeshBuilder, b: Building, rng: np.random.Generator) -> None:
    """Add walls and roof of `b`, with what stands on them."""
    _walls(out, b)
    if b.roof == "gable":
        _gable(out, b)
    elif b.roof == "hip":
        _hip(out, b, b.wall, b.width / 2 + b.eave, b.depth / 2 + b.eave, b.pitch)
    elif b.roof == "shed":
        _shed(out, b)
    elif b.roof == "mansard":
        _mansard(out, b)
    elif b.roof == "sawtooth":
        _sawtooth(out, b)
    else:
        _flat(out, b, rng)
    if b.roof in ("gable", "hip", "mansard") and b.wall > 2.6:
        _chimneys(out, b, rng)
    if b.roof == "gable" and b.pitch > 0.6 and b.wall > 2.6:
        _dormers(out, b, rng)


def _walls(out: MeshBuilder, b: Building) -> None:
    w, d = b.width / 2, b.depth / 2
    low, high = -FOUNDATION_M, b.wall
    ring = np.array([[-w, -d], [w, -d], [w, d], [-w, d]])
    quads = []
    for i in range(4):
        p, q = ring[i], ring[(i + 1) % 4]
        quads.append([[*p, low], [*q, low], [*q, high], [*p, high]])
    out.polygons(b.frame.place(np.array(quads)), Material.FACADE)


def _gable(out: MeshBuilder, b: Building) -> None:
    w, d, e = b.width / 2, b.depth / 2, b.eave
    top, drop = b.wall + d * b.pitch, b.wall - e * b.pitch
    x = w + 0.5 * e
    slopes = np.array(
        [
            [[-x, -d - e, drop], [x, -d - e, drop], [x, 0, top], [-x, 0, top]],
            [[-x, d + e, drop], [x, d + e, drop], [x, 0, top], [-x, 0, top]],
        ]
    )
    out.polygons(b.frame.place(slopes), Material.ROOF)
    ends = np.array([[[s * w, -d, b.wall], [s * w, d, b.wall], [s * w, 0, top]] for s in (-1, 1)])
    out.polygons(b.frame.place(ends), Material.FACADE)


def _hip(out: MeshBuilder, b: Building, base: float, w: float, d: float, pitch: float) -> None:
    turn = w < d
    if turn:
        w, d = d, w
    low, top = base - b.eave * pitch, base - b.eave * pitch + d * pitch
    r = w - d
    sides = np.array([[[-w, s * d, low], [w, s * d, low], [r, 0, top], [-r, 0, top]] for s in (-1, 1)])
    ends = np.array([[[s * w, -d, low], [s * w, d, low], [s * r, 0, top]] for s in (-1, 1)])
    frame = b.frame.moved(0, 0, 0, np.pi / 2) if turn else b.frame
    out.polygons(frame.place(sides), Material.ROOF)
    out.polygons(frame.place(ends), Material.ROOF)


def _shed(out: MeshBuilder, b: Building) -> None:
    w, d, e = b.width / 2, b.depth / 2, b.eave
    rise = b.depth * b.pitch
    low, high = b.wall - e * b.pitch, b.wall + rise + e * b.pitch
    plane = np.array(
        [[[-w - e, -d - e, low], [w + e, -d - e, low], [w + e, d + e, high], [-w - e, d + e, high]]]
    )
    out.polygons(b.frame.place(plane), Material.ROOF)
    top = b.wall + rise
    back = np.array([[[-w, d, b.wall], [w, d, b.wall], [w, d, top], [-w, d, top]]])
    out.polygons(b.frame.place(back), Material.FACADE)
    ends = np.array([[[s * w, -d, b.wall], [s * w, d, b.wall], [s * w, d, top]] for s in (-1, 1)])
    out.polygons(b.frame.place(ends), Material.FACADE)


def _flat(out: MeshBuilder, b: Building, rng: np.random.Generator) -> None:
    w, d, t = b.width / 2, b.depth / 2, 0.25
    z, up = b.wall, b.wall + rng.uniform(0.15, 0.7)
    out.polygons(b.frame.place(np.array([[[-w, -d, z], [w, -d, z], [w, d, z], [-w, d, z]]])), Material.ROOF)
    for low, high in (
        ((-w, -d, z), (w, -d + t, up)),
        ((-w, d - t, z), (w, d, up)),
        ((-w, -d, z), (-w + t, d, up)),
        ((w - t, -d, z), (w, d, up)),
    ):
        out.box(b.frame, low, high, Material.STONE)
    area = b.width * b.depth
    if area < 60:
        return
    for _ in range(int(rng.poisson(min(area / 120.0, 14.0)))):
        size = rng.uniform(0.6, 3.5, 2)
        at = rng.uniform(-1, 1, 2) * np.maximum([w - 2.5, d - 2.5], 0.5)
        h = rng.uniform(0.5, 2.8)
        out.box(
            b.frame,
            (at[0] - size[0] / 2, at[1] - size[1] / 2, z),
            (at[0] + size[0] / 2, at[1] + size[1] / 2, z + h),
            Material.METAL,
        )


def _mansard(out: MeshBuilder, b: Building) -> None:
    w, d = b.width / 2, b.depth / 2
    inset, rise = min(1.3, 0.2 * b.depth), 2.6
    outer = np.array([[-w, -d], [w, -d], [w, d], [-w, d]]) * (1 + 0.3 / np.array([w, d]))
    inner = np.array([[-w, -d + inset], [w, -d + inset], [w, d - inset], [-w, d - inset]])
    z0, z1 = b.wall, b.wall + rise
    quads = [
        [[*outer[i], z0], [*outer[(i + 1) % 4], z0], [*inner[(i + 1) % 4], z1], [*inner[i], z1]]
        for i in range(4)
    ]
    out.polygons(b.frame.place(np.array(quads)), Material.ROOF)
    top = z1 + 0.15 * (d - inset)
    slopes = [
        [[-w, s * (d - inset), z1], [w, s * (d - inset), z1], [w, 0, top], [-w, 0, top]] for s in (-1, 1)
    ]
    out.polygons(b.frame.place(np.array(slopes)), Material.ROOF)


def _sawtooth(out: MeshBuilder, b: Building) -> None:
    teeth = max(2, int(b.width / 9.0))
    step = b.width / teeth
    d, z, up = b.depth / 2, b.wall, b.wall + 2.5
    x = -b.width / 2 + step * np.arange(teeth)
    slopes = np.array([[[a, -d, z], [a, d, z], [a + step, d, up], [a + step, -d, up]] for a in x])
    glass = np.array(
        [[[a + step, -d, z], [a + step, d, z], [a + step, d, up], [a + step, -d, up]] for a in x]
    )
    ends = np.array(
        [[[a, s * d, z], [a + step, s * d, z], [a + step, s * d, up]] for a in x for s in (-1, 1)]
    )
    out.polygons(b.frame.place(slopes), Material.ROOF)
    out.polygons(b.frame.place(glass), Material.GLASS)
    out.polygons(b.frame.place(ends), Material.FACADE)


def _chimneys(out: MeshBuilder, b: Building, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(0, 3))):
        x = rng.uniform(-0.42, 0.42) * b.width
        y = rng.uniform(-0.2, 0.2) * b.depth
        s = rng.uniform(0.25, 0.5)
        top = b.ridge + rng.uniform(0.3, 1.2)
        out.box(b.frame, (x - s, y - s, b.wall), (x + s, y + s, top), Material.STONE)


def _dormers(out: MeshBuilder, b: Building, rng: np.random.Generator) -> None:
    if rng.random() < 0.5:
        return
    count = int(rng.integers(1, max(2, int(b.width / 3.5)) + 1))
    half = rng.uniform(0.6, min(1.6, 0.4 * b.width / count))
    side = float(rng.choice([-1.0, 1.0]))
    h = rng.uniform(1.3, 1.9)
    y = 0.72 * b.depth / 2
    base = b.wall + (b.depth / 2 - y) * b.pitch
    for x in (np.arange(count) + 0.5) / count * 0.9 * b.width - 0.45 * b.width:
        lo, hi = sorted((side * y, side * 0.15 * b.depth))
        out.box(b.frame, (x - half, lo, base - 0.3), (x + half, hi, base + h), Material.ROOF)
