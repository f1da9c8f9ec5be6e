"""Houses along the roads: terraced, detached, identical rows, halls and farmsteads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np

from mtpcr_geo.benchmark.simulator.buildings import Building, RoofForm, add_building
from mtpcr_geo.benchmark.simulator.furniture import add_wall
from mtpcr_geo.benchmark.simulator.kinds import SiteStyle
from mtpcr_geo.benchmark.simulator.mesh import Frame, Mesh, MeshBuilder
from mtpcr_geo.benchmark.simulator.roads import Network
from mtpcr_geo.benchmark.simulator.terrain import Ground
from mtpcr_geo.benchmark.simulator.vegetation import Plants, Species, add_hedge
from mtpcr_geo.core.arrays import Floats, Indices, Mask


class Occupancy:
    """Which square metres are taken.

    Args:
        half: half the edge of the site, metres.

    """

    def __init__(self, half: float) -> None:
        self.half = half
        n = int(np.ceil(2 * half))
        self.taken = np.zeros((n, n), bool)

    def _cells(self, xy: Floats) -> tuple[Indices, Indices, Mask]:
        cell = np.floor(xy + self.half).astype(np.int64)
        inside = np.asarray(((cell >= 0) & (cell < len(self.taken))).all(axis=-1))
        cell = np.clip(cell, 0, len(self.taken) - 1)
        return cell[..., 1], cell[..., 0], inside

    def is_taken(self, xy: Floats) -> Mask:
        """Say for (n, 2) places whether they are taken or off the site."""
        r, c, inside = self._cells(xy)
        return self.taken[r, c] | ~inside

    def claim(self, frame: Frame, width: float, depth: float) -> bool:
        """Take a footprint (metres, about the frame's origin) if it is free; say whether it was."""
        x = np.linspace(-width / 2, width / 2, int(width / 0.7) + 2)
        y = np.linspace(-depth / 2, depth / 2, int(depth / 0.7) + 2)
        u, v = np.meshgrid(x, y)
        xy = frame.place(np.stack([u, v, 0 * u], -1))[..., :2].reshape(-1, 2)
        if self.is_taken(xy).any():
            return False
        r, c, _ = self._cells(xy)
        self.taken[r, c] = True
        return True


@dataclass
class Layout:
    """What grows while lots are filled.

    Attributes:
        ground: the land.
        occupancy: what is taken.
        fixed: geometry that is the same in all epochs, but for buildings.
        buildings: one mesh each.
        hedges: (k, 2) lines in metres with their heights.
        plants: gardens' trees: x, y, height, species.
        yards: courts yet to be filled: the house's frame, width, depth and eaves height.

    """

    ground: Ground
    occupancy: Occupancy
    fixed: MeshBuilder = field(default_factory=MeshBuilder)
    buildings: list[Mesh] = field(default_factory=list)
    hedges: list[tuple[Floats, float]] = field(default_factory=list)
    plants: list[tuple[float, float, float, int]] = field(default_factory=list)
    yards: list[tuple[Frame, float, float, float]] = field(default_factory=list)

    def settle(self, frame: Frame, width: float, depth: float) -> Frame:
        """Return `frame` at the height at which a house would stand there."""
        corners = np.array([[x, y, 0] for x in (-0.5, 0, 0.5) for y in (-0.5, 0, 0.5)]) * [width, depth, 1]
        z = self.ground.height(frame.place(corners)[:, :2])
        return Frame(frame.x, frame.y, float(np.quantile(z, 0.6)) + 0.15, frame.yaw)

    def build(self, b: Building, rng: np.random.Generator, claim: bool = True) -> bool:
        """Put up a building where its footprint is free; say whether it was."""
        if claim and not self.occupancy.claim(b.frame, b.width, b.depth):
            return False
        house = MeshBuilder()
        add_building(house, b, rng)
        self.buildings.append(house.build())
        return True

    def plant(self, frame: Frame, x: float, y: float, species: Species, height: float) -> None:
        """Set a plant at local (x, y) metres where nothing stands."""
        place = frame.place(np.array([x, y, 0.0]))[:2]
        if not self.occupancy.is_taken(place[None])[0]:
            self.plants.append((float(place[0]), float(place[1]), height, int(species)))

    def garden_stand(self) -> Plants:
        """Return the gardens' plants as one stand."""
        if not self.plants:
            return Plants.empty()
        table = np.array(self.plants)
        return Plants(table[:, :2], table[:, 2], table[:, 3].astype(np.int64))

    def wall(self, frame: Frame, local: Floats, height: float) -> None:
        """Put up a wall along a (k, 2) local line."""
        line = frame.place(np.c_[local, np.zeros(len(local))])[:, :2]
        add_wall(self.fixed, line, self.ground.height(line), height)

    def grow_hedges(self, out: MeshBuilder, rng: np.random.Generator) -> None:
        """Add all hedges, as they are in one epoch."""
        for line, height in self.hedges:
            add_hedge(out, line, self.ground.height(line), height * rng.uniform(0.93, 1.07), rng)


def _slots(
    line: Floats, road_width: float, left: bool, pitch: Floats, start: float, setback: float
) -> list[Frame]:
    """Frames on one side of a road, `setback` metres behind the pavement, one per lot of `pitch` metres."""
    step = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.r_[0.0, np.cumsum(step)]
    middle = start + np.cumsum(pitch) - pitch / 2
    middle = middle[middle + pitch[: len(middle)] / 2 < along[-1] - start]
    frames = []
    for s in middle:
        p = [np.interp([s - 3, s, s + 3], along, line[:, k]) for k in (0, 1)]
        yaw = float(np.arctan2(p[1][2] - p[1][0], p[0][2] - p[0][0])) + (0.0 if left else np.pi)
        off = 0.5 * road_width + 2.2 + setback
        frames.append(Frame(p[0][1] - off * np.sin(yaw), p[1][1] + off * np.cos(yaw), 0.0, yaw))
    return frames


def fill_lots(layout: Layout, roads: Network, style: SiteStyle, rng: np.random.Generator) -> None:
    """Put houses, walls, hedges and gardens along all roads, in the manner of `style`."""
    for line, width in zip(roads.lines, roads.widths, strict=True):
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        for left in (True, False):
            if style.lots == "terraced":
                _terrace(layout, line, width, left, length, style, rng)
            elif style.lots == "identical":
                _identical(layout, line, width, left, style, rng)
            elif style.lots == "detached":
                _detached(layout, line, width, left, length, style, rng)
            elif style.lots == "halls":
                _halls(layout, line, width, left, length, style, rng)
            elif style.lots == "farms" and rng.random() < style.built:
                _farm(layout, line, width, left, length, rng)

    for yard in layout.yards:  # only now, so that no shed stands where a house should be
        _yard(layout, *yard, rng)


def _terrace(
    layout: Layout, line: Floats, road: float, left: bool, length: float, style: SiteStyle,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    pitch = rng.uniform(5.5, 12.0, int(length / 5.0) + 1)
    setback = float(rng.choice([0.0, 0.0, 1.5, 3.0]))
    storeys = int(rng.integers(2, 5))
    forms = list(rng.choice(["gable", "gable", "mansard", "flat", "hip"], 2))
    slope = rng.uniform(0.6, 1.15)
    for frame, w in zip(_slots(line, road, left, pitch, 9.0, setback), pitch, strict=False):
        if rng.random() > style.built:
            continue
        depth = rng.uniform(8.5, 12.5)
        frame = layout.settle(frame.moved(0, depth / 2), w, depth)
        wall = 3.0 * max(1, storeys + int(rng.choice([-1, 0, 0, 0, 1]))) + rng.uniform(-0.4, 0.8)
        form = cast(RoofForm, str(forms[int(rng.random() < 0.25)]))
        form = "gable" if form == "hip" and w < 8 else form
        house = Building(frame, w, depth, wall, form, slope + rng.uniform(-0.08, 0.08), 0.35)
        # the neighbours share a wall: only the middle of the footprint needs to be free
        if not layout.occupancy.claim(frame, 0.8 * w, depth):
            continue
        layout.build(house, rng, claim=False)
        layout.occupancy.claim(frame, w, depth)
        layout.yards.append((frame, w, depth, wall))


def _yard(
    layout: Layout, frame: Frame, w: float, depth: float, wall: float, rng: np.random.Generator
) -> None:
    """Fill the court behind a town house: a wing, sheds, walls, a tree, lumber."""
    reach = rng.uniform(7.0, 15.0)
    if rng.random() < 0.55:
        d, ww = rng.uniform(3.0, 7.5), rng.uniform(0.4, 0.7) * w
        x = float(rng.choice([-1, 1])) * 0.5 * (w - ww)
        form = cast(RoofForm, str(rng.choice(["flat", "shed", "gable"])))
        h = min(wall - 0.5, rng.uniform(2.8, 6.5))
        wing = frame.moved(x, depth / 2 + d / 2 + 0.3)
        layout.build(Building(wing, ww, d, h, form, 0.3, 0.2), rng)
    if rng.random() < 0.6:
        size = rng.uniform(2.0, 4.5, 2)
        shed = frame.moved(rng.uniform(-0.3, 0.3) * w, depth / 2 + reach - size[1] / 2)
        shed = layout.settle(shed, *size)
        form = cast(RoofForm, str(rng.choice(["flat", "shed", "gable"])))
        layout.build(Building(shed, size[0], size[1], rng.uniform(2.0, 2.8), form, 0.25, 0.15), rng)
    if rng.random() < 0.6:
        h = rng.uniform(1.0, 2.2)
        layout.wall(frame, np.array([[w / 2, depth / 2], [w / 2, depth / 2 + reach]]), h)
        if rng.random() < 0.6:
            layout.wall(frame, np.array([[-w / 2, depth / 2 + reach], [w / 2, depth / 2 + reach]]), h)
    for _ in range(int(rng.poisson(1.6))):
        x, y = rng.uniform(-0.45, 0.45) * w, depth / 2 + rng.uniform(2.0, reach)
        if rng.random() < 0.25:
            layout.plant(frame, x, y, Species.BROADLEAF, rng.uniform(5, 12))
        else:
            layout.plant(frame, x, y, Species.SHRUB, rng.uniform(0.6, 2.5))


def _identical(
    layout: Layout, line: Floats, road: float, left: bool, style: SiteStyle, rng: np.random.Generator
) -> None:
    pitch = np.full(40, 6.6)
    for i, frame in enumerate(_slots(line, road, left, pitch, 11.0, 3.0)):
        if i % 9 == 8 or rng.random() > style.built:
            continue
        frame = layout.settle(frame.moved(0, 4.5), 6.6, 9.0)
        if not layout.occupancy.claim(frame, 5.2, 9.0):
            continue
        layout.build(Building(frame, 6.6, 9.0, 5.6, "gable", 0.8, 0.4), rng, claim=False)
        layout.occupancy.claim(frame, 6.6, 9.0)
        layout.wall(frame, np.array([[3.3, 4.5], [3.3, 12.0]]), 1.8)
        if rng.random() < 0.6:
            shed = layout.settle(frame.moved(1.8, 11.0), 2.4, 2.4)
            layout.build(Building(shed, 2.4, 2.4, 2.2, "shed", 0.2, 0.1), rng)
        if rng.random() < 0.45:
            species = Species.SHRUB if rng.random() < 0.7 else Species.FRUIT
            layout.plant(frame, rng.uniform(-3, 3), rng.uniform(6, 12), species, rng.uniform(1.0, 4.0))


def _detached(
    layout: Layout, line: Floats, road: float, left: bool, length: float, style: SiteStyle,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    pitch = rng.uniform(15.0, 25.0, int(length / 14.0) + 1)
    for lot, plot in zip(_slots(line, road, left, pitch, 7.0, 0.0), pitch, strict=False):
        deep = rng.uniform(22.0, 30.0)
        if rng.random() < style.built:
            _villa(layout, lot, plot, deep, rng)
        if rng.random() < 0.45:
            front = np.array([[-plot / 2 + 0.5, 0.6], [plot / 2 - 3.5, 0.6]])
            if rng.random() < 0.6:
                world = lot.place(np.c_[front, np.zeros(2)])[:, :2]
                layout.hedges.append((world, rng.uniform(0.9, 2.0)))
            else:
                layout.wall(lot, front, rng.uniform(0.6, 1.3))
        if rng.random() < 0.45:
            layout.wall(lot, np.array([[plot / 2, 1.0], [plot / 2, deep]]), rng.uniform(1.0, 1.8))
        for _ in range(int(rng.poisson(3.2))):
            x, y = rng.uniform(-0.48, 0.48) * plot, rng.uniform(2.0, deep)
            species = Species(int(rng.choice([0, 1, 3, 3, 4, 4, 4])))
            low, high = {0: (5, 15), 1: (5, 16), 3: (3, 6)}.get(int(species), (0.7, 2.6))
            layout.plant(lot, x, y, species, rng.uniform(low, high))


def _villa(layout: Layout, lot: Frame, plot: float, deep: float, rng: np.random.Generator) -> None:
    w, d = min(rng.uniform(8.5, 14.0), plot - 4), rng.uniform(7.5, 11.0)
    wall = 2.7 * int(rng.choice([1, 2, 2])) + rng.uniform(0.2, 0.8)
    form = cast(RoofForm, str(rng.choice(["gable", "gable", "hip", "hip", "flat", "shed"])))
    slope = rng.uniform(0.35, 1.0) if form != "shed" else rng.uniform(0.1, 0.25)
    frame = lot.moved(
        rng.uniform(-0.5, 0.5) * (plot - w - 3), rng.uniform(4.0, 8.0) + d / 2, 0, rng.normal(0, 0.03)
    )
    if form == "gable" and rng.random() < 0.4 and d < plot - 4:
        frame, w, d = frame.moved(0, 0, 0, np.pi / 2), d, w
    frame = layout.settle(frame, w, d)
    if not layout.build(Building(frame, w, d, wall, form, slope, 0.5), rng):
        return
    if rng.random() < 0.4 and form in ("gable", "hip"):
        # a wing whose roof runs into the main one
        ww = rng.uniform(0.35, 0.5) * w
        x = float(rng.choice([-1, 1])) * 0.5 * (w - ww)
        depth = d / 2 + rng.uniform(2.0, 4.5)
        wing = frame.moved(x, depth / 2, 0, np.pi / 2)
        layout.build(Building(wing, depth, ww, wall, "gable", slope, 0.4), rng, claim=False)
        layout.occupancy.claim(frame.moved(x, 0.5 * d + 1.5), ww, 2.5)
    if rng.random() < 0.6:
        garage = layout.settle(
            lot.moved(rng.choice([-1, 1]) * (plot / 2 - 2.2), rng.uniform(6, 12)), 3.2, 6.0
        )
        form = cast(RoofForm, str(rng.choice(["flat", "gable"])))
        layout.build(Building(garage, 3.2, 6.0, 2.5, form, 0.4, 0.2), rng)
    if rng.random() < 0.5:
        shed = layout.settle(lot.moved(rng.uniform(-0.4, 0.4) * plot, deep - 2.5), 3.0, 2.4)
        layout.build(Building(shed, 3.0, 2.4, 2.1, "gable", 0.4, 0.2), rng)


def _halls(
    layout: Layout, line: Floats, road: float, left: bool, length: float, style: SiteStyle,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    pitch = rng.uniform(28.0, 75.0, int(length / 26.0) + 1)
    for frame, plot in zip(_slots(line, road, left, pitch, 10.0, 5.0), pitch, strict=False):
        if rng.random() > style.built:
            continue
        w, d = plot - rng.uniform(7, 16), rng.uniform(14.0, 38.0)
        form = cast(RoofForm, str(rng.choice(["flat", "flat", "gable", "sawtooth", "shed"])))
        wall = rng.uniform(5.0, 17.0) if form == "flat" else rng.uniform(5.0, 9.0)
        slope = {"gable": rng.uniform(0.12, 0.35), "shed": 0.06}.get(form, 0.3)
        place = layout.settle(frame.moved(0, d / 2 + rng.uniform(0, 10)), w, d)
        if not layout.build(Building(place, w, d, wall, form, slope, 0.3), rng):
            continue
        if form == "flat" and rng.random() < 0.6:  # a raised part
            part = place.moved(rng.uniform(-0.25, 0.25) * w, rng.uniform(-0.2, 0.2) * d)
            up = wall + rng.uniform(2.5, 7.0)
            layout.build(Building(part, rng.uniform(0.2, 0.45) * w, 0.5 * d, up, "flat"), rng, claim=False)
        for _ in range(int(rng.poisson(4))):
            layout.plant(frame, rng.uniform(-0.5, 0.5) * plot, rng.uniform(-4, -1), Species.SHRUB, 1.2)


def _farm(
    layout: Layout, line: Floats, road: float, left: bool, length: float, rng: np.random.Generator
) -> None:
    if length < 45:
        return
    lot = _slots(line, road, left, np.array([40.0]), rng.uniform(2, length - 42) / 2, 8.0)
    if not lot:
        return
    house = lot[0].moved(0, 6.0, 0, rng.normal(0, 0.1))
    w, d = rng.uniform(11, 16), rng.uniform(8, 11)
    place = layout.settle(house, w, d)
    if not layout.build(Building(place, w, d, 4.5, "gable", rng.uniform(0.7, 1.0), 0.5), rng):
        return
    for side in (-1, 1):
        if rng.random() < 0.8:
            w, d = rng.uniform(16, 32), rng.uniform(9, 16)
            barn = house.moved(
                side * rng.uniform(20, 26), rng.uniform(8, 18), 0, float(rng.choice([0, np.pi / 2]))
            )
            barn = layout.settle(barn, w, d)
            layout.build(Building(barn, w, d, rng.uniform(4, 6), "gable", rng.uniform(0.3, 0.6), 0.6), rng)
    for _ in range(int(rng.poisson(9))):
        species = Species(int(rng.choice([0, 0, 3, 3, 4])))
        height = {0: rng.uniform(7, 18), 3: rng.uniform(3, 6)}.get(int(species), 1.6)
        layout.plant(house, rng.uniform(-35, 35), rng.uniform(-8, 35), species, height)
