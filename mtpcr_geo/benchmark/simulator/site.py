"""A whole site: land, roads, houses, plants and what moves, and its mesh in each epoch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from mtpcr_geo.benchmark.simulator.furniture import add_car, add_poles, add_traffic, add_walker
from mtpcr_geo.benchmark.simulator.kinds import STYLES, Kind, SiteStyle
from mtpcr_geo.benchmark.simulator.lots import Layout, Occupancy, fill_lots
from mtpcr_geo.benchmark.simulator.mesh import Frame, Mesh, MeshBuilder
from mtpcr_geo.benchmark.simulator.roads import Network, make_network
from mtpcr_geo.benchmark.simulator.terrain import Ground, make_ground, relief
from mtpcr_geo.benchmark.simulator.vegetation import Plants, Species, add_plants
from mtpcr_geo.core.arrays import Floats, Indices

MARGIN_M = 25.0
# shares of the buildings that are pulled down, and put up, after the first epoch
RAZED, RAISED = 0.02, 0.02


@dataclass(frozen=True)
class Site:
    """A place that can be scanned. Site frame: metres, east-north-up about its middle.

    Attributes:
        kind: what kind of place.
        style: its numbers.
        half: half the edge of the site, metres; geometry goes on for a margin beyond.
        ground: the land.
        roads: the network.
        layout: houses, hedges, gardens.
        plants: all trees and shrubs, as they stood in the first epoch.
        seed: what it was made from.

    """

    kind: Kind
    style: SiteStyle
    half: float
    ground: Ground
    roads: Network
    layout: Layout
    plants: Plants
    seed: int

    def mesh(self, epoch: int, leafiness: float = 1.0) -> Mesh:
        """Return the site's geometry in one epoch.

        Most houses and stems stay; leaves, hedges, crops, parked cars, who passes by, a few trees and a few
        buildings differ.

        Args:
            epoch: 0 or later.
            leafiness: share of leaves on the trees; about 0.25 in winter.

        """
        rng = np.random.default_rng([self.seed, 77, epoch])
        out = MeshBuilder()
        out.add_mesh(self.ground.mesh(_crop(self, rng)))
        out.add_mesh(self.layout.fixed.build())
        fate = np.random.default_rng([self.seed, 78]).random(len(self.layout.buildings))
        standing = fate > RAZED if epoch else fate < 1 - RAISED
        for number in np.flatnonzero(standing):
            out.add_mesh(self.layout.buildings[number])
        plants = self.plants.aged(rng, gone=0.02 * epoch, growth=0.02 * epoch)
        add_plants(out, plants, self.ground.height(plants.xy), rng, leafiness, self.seed)
        self.layout.grow_hedges(out, rng)
        _park_cars(self, out, rng)
        _pass_by(self, out, rng)
        return out.build()


def make_site(kind: Kind, seed: int, extent_m: float, *, style: SiteStyle | None = None) -> Site:
    """Make a site from its seed.

    Args:
        kind: one of `KINDS`.
        seed: same seed, same site.
        extent_m: edge of the square, metres.
        style: what it is made of; that of its kind if None.

    """
    style = style or STYLES[kind]
    rng = np.random.default_rng([seed, 11])
    half = extent_m / 2
    outer = half + MARGIN_M
    roads = make_network(outer, style.roads, rng)
    cell = 0.8 if extent_m <= 350 else 1.0 if extent_m <= 480 else 1.25
    ground = make_ground(outer, cell, style.ground, roads, rng)
    occupancy = Occupancy(outer)
    centre = np.arange(len(occupancy.taken)) - outer + 0.5
    x, y = np.meshgrid(centre, centre)
    near = ndimage.map_coordinates(
        ground.road_distance, np.stack([y + outer, x + outer]) / cell, order=1, mode="nearest"
    )
    occupancy.taken |= near < 0.5 * style.roads.width + 1.2
    layout = Layout(ground, occupancy)
    fill_lots(layout, roads, style, rng)
    _poles(layout, roads, style, rng)
    plants = layout.garden_stand().joined(_street_trees(occupancy, roads, style, rng))
    plants = plants.joined(_open_land(ground, occupancy, style, outer, rng))
    if style.fields:
        plants = plants.joined(_hedgerows(occupancy, roads, rng))
    return Site(kind, style, half, ground, roads, layout, plants, seed)


def _crop(site: Site, rng: np.random.Generator) -> Floats | None:
    """Heights of standing crop and rough grass in one epoch, (h, w) metres."""
    g = site.ground
    shape = g.z.shape
    tuft = np.abs(relief(shape, g.cell, 6.0, 2.0, rng)) * 0.05
    open_land = g.cover == int(site.style.ground.open_cover)
    if not site.style.fields:
        return np.where(open_land, tuft, 0.0)
    # parcels are strips between roads; each has its own crop this year
    which = np.random.default_rng([site.seed, 5])
    angle = which.uniform(0, np.pi)
    x, y = np.meshgrid(g.west + g.cell * np.arange(shape[1]), g.south + g.cell * np.arange(shape[0]))
    u, v = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    parcel = np.floor(u / 63.0).astype(int) * 31 + np.floor(v / 118.0).astype(int) * 17
    table = rng.choice([0.0, 0.05, 0.1, 0.25, 0.5, 0.8], 101) * rng.uniform(0.8, 1.2, 101)
    height = ndimage.uniform_filter(table[parcel % 101], 3)
    furrow = 0.04 * np.sin(2 * np.pi * u / 3.1)
    rim = np.clip((g.road_distance - 6.0) / 2.0, 0, 1)
    return np.where(open_land, rim * (height + furrow) + tuft, 0.0)


def _park_cars(site: Site, out: MeshBuilder, rng: np.random.Generator) -> None:
    per_metre = site.style.cars_per_100m / 100.0
    for line, width in zip(site.roads.lines, site.roads.widths, strict=True):
        for at in rng.integers(6, max(7, len(line) - 6), rng.poisson(per_metre * len(line))):
            step = line[min(at + 2, len(line) - 1)] - line[max(at - 2, 0)]
            yaw = float(np.arctan2(step[1], step[0])) + float(rng.choice([0.0, np.pi]))
            aside = 0.5 * width - 1.0 if rng.random() < 0.85 else 0.25 * width
            x, y = line[at] + aside * np.array([np.sin(yaw), -np.cos(yaw)])
            z = float(site.ground.height(np.array([[x, y]]))[0])
            add_car(out, Frame(float(x), float(y), z, yaw + rng.normal(0, 0.03)), rng)


def _pass_by(site: Site, out: MeshBuilder, rng: np.random.Generator) -> None:
    """People on the verges and cars on the lanes, each over a part of a road."""
    per_metre = site.style.cars_per_100m / 100.0
    for line, width in zip(site.roads.lines, site.roads.widths, strict=True):
        if len(line) < 8:
            continue
        step = np.gradient(line, axis=0)
        yaw = np.arctan2(step[:, 1], step[:, 0])
        right = np.stack([np.sin(yaw), -np.cos(yaw)], axis=1)
        for _ in range(rng.poisson(0.5 * per_metre * len(line))):
            at = _stretch(len(line), int(rng.integers(4, 25)), 1, rng)
            way = line[at] + float(rng.choice([-1.0, 1.0])) * (0.5 * width + 0.4) * right[at]
            add_walker(out, way, site.ground.height(way), rng)
        for _ in range(rng.poisson(0.25 * per_metre * len(line))):
            at = _stretch(len(line), int(rng.integers(25, 90)), 6, rng)
            way = line[at] + 0.2 * width * right[at]
            places = np.c_[way, site.ground.height(way), yaw[at]].tolist()
            add_traffic(out, [Frame(*place) for place in places], rng)


def _stretch(count: int, length: int, every: int, rng: np.random.Generator) -> Indices:
    """Draw a part of a road: numbers of its points."""
    start = int(rng.integers(0, max(1, count - length)))
    return np.arange(start, min(start + length, count), every)


def _poles(layout: Layout, roads: Network, style: SiteStyle, rng: np.random.Generator) -> None:
    for line, width in zip(roads.lines, roads.widths, strict=True):
        if rng.random() > style.poles or len(line) < 40:
            continue
        at = np.arange(int(rng.integers(5, 15)), len(line) - 2, int(rng.integers(24, 38)))
        step = line[np.minimum(at + 1, len(line) - 1)] - line[np.maximum(at - 1, 0)]
        side = np.stack([-step[:, 1], step[:, 0]], 1) / (np.linalg.norm(step, axis=1)[:, None] + 1e-9)
        xy = line[at] + side * (0.5 * width + 0.7)
        height = rng.uniform(5.0, 8.5)
        add_poles(layout.fixed, xy, layout.ground.height(xy), height, wires=bool(rng.random() < 0.5))


def _street_trees(occupancy: Occupancy, roads: Network, style: SiteStyle, rng: np.random.Generator) -> Plants:
    stand = Plants.empty()
    for line, width in zip(roads.lines, roads.widths, strict=True):
        if rng.random() > style.street_trees:
            continue
        species = int(rng.choice([Species.BROADLEAF, Species.BROADLEAF, Species.COLUMN]))
        height = rng.uniform(6.0, 15.0)
        for side in (-1.0, 1.0):
            if rng.random() < 0.3:
                continue
            at = np.arange(int(rng.integers(5, 14)), len(line) - 6, int(rng.integers(8, 16)))
            at = at[rng.random(len(at)) < 0.85]
            step = line[np.minimum(at + 1, len(line) - 1)] - line[np.maximum(at - 1, 0)]
            normal = np.stack([-step[:, 1], step[:, 0]], 1) / (np.linalg.norm(step, axis=1)[:, None] + 1e-9)
            xy = line[at] + side * normal * (0.5 * width + 1.3) + rng.normal(0, 0.2, (len(at), 2))
            beside = line[at] + side * normal * (0.5 * width + 3.2)
            xy = xy[~occupancy.is_taken(beside)]
            tall = height * rng.uniform(0.7, 1.15, len(xy))
            stand = stand.joined(Plants(xy, tall, np.full(len(xy), species)))
    return stand


def _open_land(
    ground: Ground, occupancy: Occupancy, style: SiteStyle, half: float, rng: np.random.Generator
) -> Plants:
    """Woods where a random field is high, undergrowth in them, single trees elsewhere."""
    spacing = 100.0 / np.sqrt(style.stems_per_ha)
    n = int(2 * half / spacing)
    axis = -half + spacing * (np.arange(n) + 0.5)
    x, y = np.meshgrid(axis, axis)
    xy = np.stack([x, y], -1).reshape(-1, 2) + rng.uniform(-0.42, 0.42, (n * n, 2)) * spacing
    shape = ground.z.shape
    density = relief(shape, ground.cell, 160.0, 25.0, rng)
    mixture = relief(shape, ground.cell, 120.0, 20.0, rng)
    limit = np.quantile(density, 1 - style.wooded)
    rc = np.stack([(xy[:, 1] - ground.south) / ground.cell, (xy[:, 0] - ground.west) / ground.cell])
    here = ndimage.map_coordinates(density, rc, order=1, mode="nearest")
    tone = ndimage.map_coordinates(mixture, rc, order=1, mode="nearest") + 0.6 * rng.normal(size=len(xy))
    chance = np.where(here > limit, 0.92, style.lone_per_ha / style.stems_per_ha)
    keep = (rng.random(len(xy)) < chance) & ~occupancy.is_taken(xy)
    age = ndimage.map_coordinates(relief(shape, ground.cell, 100.0, 15.0, rng), rc, order=1, mode="nearest")
    height = np.clip(15.0 + 4.5 * age + 2.5 * rng.normal(size=len(xy)), 4.0, 30.0)
    species = np.where(tone > 0.5, Species.CONIFER, np.where(tone < -1.6, Species.FRUIT, Species.BROADLEAF))
    height = np.where(species == Species.FRUIT, 0.35 * height, height)
    trees = Plants(xy[keep], height[keep], species[keep].astype(np.int64))
    many = int(0.02 * (2 * half) ** 2 * (0.3 + style.wooded))
    spot = rng.uniform(-half, half, (many, 2))
    rc = np.stack([(spot[:, 1] - ground.south) / ground.cell, (spot[:, 0] - ground.west) / ground.cell])
    under = ndimage.map_coordinates(density, rc, order=1, mode="nearest")
    chance = np.where(under > limit, 0.35, 0.02 * min(style.lone_per_ha, 8.0))
    spot = spot[(rng.random(many) < chance) & ~occupancy.is_taken(spot)]
    low = rng.gamma(3.0, 0.45, len(spot)) + 0.4
    return trees.joined(Plants(spot, low, np.full(len(spot), int(Species.SHRUB))))


def _hedgerows(occupancy: Occupancy, roads: Network, rng: np.random.Generator) -> Plants:
    """Bushes and trees along some field roads."""
    stand = Plants.empty()
    for line, width in zip(roads.lines, roads.widths, strict=True):
        if rng.random() > 0.35 or len(line) < 30:
            continue
        at = np.sort(rng.integers(4, len(line) - 4, int(len(line) * 0.45)))
        a, b = sorted(rng.integers(0, len(line), 2))
        at = at[(at < a) | (at > b)]
        step = line[at + 1] - line[at - 1]
        normal = np.stack([-step[:, 1], step[:, 0]], 1) / (np.linalg.norm(step, axis=1)[:, None] + 1e-9)
        offset = 0.5 * width + 4.5 + rng.normal(0, 0.6, len(at))
        xy = line[at] + float(rng.choice([-1.0, 1.0])) * normal * offset[:, None]
        xy = xy[~occupancy.is_taken(xy)]
        tree = rng.random(len(xy)) < 0.08
        height = np.where(tree, rng.uniform(6, 15, len(xy)), rng.gamma(6.0, 0.4, len(xy)))
        species = np.where(tree, int(Species.BROADLEAF), int(Species.SHRUB))
        stand = stand.joined(Plants(xy, height, species))
    return stand
