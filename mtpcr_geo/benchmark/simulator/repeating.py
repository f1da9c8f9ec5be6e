"""Sites that repeat themselves: solar parks, orchards, vineyards, car parks, equal houses, warehouses.

    source, target = repeating_pair("orchard", seed=3)

Both clouds show one field, the source from the ground in one epoch, the target from the air in another, and
share a corner of it; with ``apart`` they show two parts of the field that share nothing. The land is
gentle and smooth. What really tells one place from another is there: gaps, young trees, extensions, sheds,
trees of other heights; so is what misleads: cars, lorries and leaves that differ between the epochs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from mtpcr_geo.benchmark.simulator.scanners import HeightAt
from mtpcr_geo.benchmark.simulator.surfaces import Rectangle, Scene
from mtpcr_geo.core.arrays import Floats, Mask

RepeatingKind = Literal["solar_park", "orchard", "vineyard", "car_park", "equal_houses", "warehouses"]
KINDS: tuple[RepeatingKind, ...] = get_args(RepeatingKind)
SOURCE_M, TARGET_M = np.array([220.0, 300.0]), np.array([290.0, 340.0])
OVERLAP = 0.27
"""Share of the source's rectangle that lies in the target's."""
LANE_M = 24.0
GROUND_DENSITY = 7.0
_MARGIN_M = 40.0


class _Field:
    """What a field is laid out with: its land, its extent, and random numbers of its own.

    Attributes:
        land: height of the ground.
        fixed: of what is the same in all epochs.
        epoch: of what differs.
        scene: what has been built.
        yaw: of the rows, radians.
        lanes: distance of the lanes on which one walks, and where the first lies across the rows, metres.

    """

    def __init__(
        self,
        around: Rectangle,
        land: HeightAt,
        yaw: float,
        fixed: np.random.Generator,
        epoch: np.random.Generator,
    ) -> None:
        self.around, self.land, self.yaw = around, land, yaw
        self.fixed, self.epoch = fixed, epoch
        self.scene = Scene(land)
        self.lanes = (LANE_M, 0.4 * LANE_M)
        self.middle = (around.low + around.high) / 2
        self.reach = float(np.linalg.norm(around.high - around.low)) / 2

    def place(self, uv: Floats) -> Floats:
        """Take (n, 2) places along and across the rows to the site, metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.asarray(uv @ np.array([[c, s], [-s, c]]) + self.middle)

    def lattice(self, along: float, across: float) -> tuple[Floats, Floats]:
        """Return the (n, 2) places of a lattice over the whole field along and across its rows, metres."""
        u, v = (
            np.arange(-np.ceil(self.reach / step), np.ceil(self.reach / step) + 1) * step
            for step in (along, across)
        )
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        return grid, self.place(grid)

    def yaws(self, count: int, spread: float = 0.0) -> Floats:
        """Return (n,) headings along the rows, radians, that scatter by `spread`."""
        return np.asarray(self.yaw + spread * self.fixed.normal(size=count))

    def service(self, per_hectare: float, size: tuple[float, float, float]) -> None:
        """Put up a few buildings anywhere."""
        count = self.fixed.poisson(per_hectare * self.around.area / 1e4)
        xy = self.fixed.uniform(self.around.low, self.around.high, (count, 2))
        sizes = np.array(size) * self.fixed.uniform(0.8, 1.3, (count, 3))
        self.scene.add_boxes(xy, self.yaws(count), sizes, self.land(xy))

    def trees(self, xy: Floats, height: Floats, breadth: Floats) -> None:
        """Plant trees at (n, 2) places, (n,) metres high and wide."""
        n = len(xy)
        crown = 0.36 * height
        foot = self.land(xy)
        self.scene.add_crowns(
            np.c_[xy, foot + height - crown],
            np.stack([breadth / 2, breadth / 2 * self.fixed.uniform(0.85, 1.15, n), crown], axis=1),
        )
        self.scene.add_posts(xy, np.maximum(height - crown, 0.3), 0.08)

    def cars(self, xy: Floats, yaw: Floats) -> None:
        """Park cars at (n, 2) places: other ones in each epoch."""
        n = len(xy)
        van = self.epoch.random(n) < 0.12
        length = np.where(van, 5.1, 4.4) + self.epoch.normal(0, 0.25, n)
        width = np.full(n, 1.8) + self.epoch.normal(0, 0.06, n)
        z = self.land(xy)
        body = np.where(van, 1.2, 0.95)
        self.scene.add_boxes(xy, yaw, np.stack([length, width, body], axis=1), z, roof_from_ground=0.7)
        top = np.where(van, 0.85, 0.52)
        cabin = np.stack([np.where(van, 0.8, 0.5) * length, 0.85 * width, top], axis=1)
        self.scene.add_boxes(xy, yaw, cabin, z + body, roof_from_ground=0.5)


def repeating_pair(
    kind: RepeatingKind, seed: int, *, apart: bool = False, size: float = 1.0
) -> tuple[Floats, Floats]:
    """Sample both clouds of a field that repeats itself.

    Args:
        kind: one of `KINDS`.
        seed: of everything.
        apart: whether they show two parts that share nothing; else they share `OVERLAP` of the source.
        size: of both clouds' edges over `SOURCE_M` and `TARGET_M`.

    Returns:
        (n, 3) source and (m, 3) target in the field's frame, metres: the truth between them is the identity.

    """
    words = [seed, *kind.encode()]
    rng = np.random.default_rng([51, *words])
    source, target = _rectangles(rng, apart, size)
    around = Rectangle(
        np.minimum(source.low, target.low) - _MARGIN_M, np.maximum(source.high, target.high) + _MARGIN_M
    )
    land = _land(around, rng)
    yaw = float(rng.uniform(0, np.pi))
    fields = []
    for epoch in (0, 1):
        # the same draws in both epochs, but for those of the epoch
        fixed = np.random.default_rng([52, *words])
        field = _Field(around, land, yaw, fixed, np.random.default_rng([53, epoch, *words]))
        _LAYOUTS[kind](field)
        fields.append(field)
    path = _walk(fields[0], source, rng)
    low = fields[0].scene.seen_from_ground(source, path, GROUND_DENSITY, rng)
    high = fields[1].scene.seen_from_air(target, float(rng.uniform(4.0, 10.0)), rng)
    return low, high


def _rectangles(rng: np.random.Generator, apart: bool, size: float) -> tuple[Rectangle, Rectangle]:
    """Place the target's rectangle at a corner of the source's, or beyond one of its sides."""
    edges, reach = size * SOURCE_M, size * TARGET_M
    source = Rectangle(np.zeros(2), edges)
    share = rng.uniform(0.38, 0.72)
    shared = edges * [share, OVERLAP / share]
    side = rng.integers(0, 2, 2)
    low = np.where(side == 1, edges - shared, shared - reach)
    if apart:
        axis, gap = rng.integers(0, 2), rng.uniform(10.0, 40.0)
        low[axis] = edges[axis] + gap if side[axis] else -reach[axis] - gap
    return source, Rectangle(low, low + reach)


def _land(around: Rectangle, rng: np.random.Generator) -> HeightAt:
    """Make smooth land from a few long sines, 2 to 4 m up and down from its middle height."""
    wave, turn, phase = rng.uniform(160, 600, 5), rng.uniform(0, 2 * np.pi, 5), rng.uniform(0, 2 * np.pi, 5)
    weight = (wave / 600.0) ** 1.2

    def raw(xy: Floats) -> Floats:
        way = np.outer(xy[:, 0], np.cos(turn)) + np.outer(xy[:, 1], np.sin(turn))
        return np.asarray(np.sin(2 * np.pi * way / wave + phase) @ weight)

    sample = raw(rng.uniform(around.low, around.high, (5000, 2)))
    scale = rng.uniform(2.0, 4.0) / (np.ptp(sample) / 2)

    def height(xy: Floats) -> Floats:
        return scale * raw(np.asarray(xy, np.float64))

    return height


def _walk(field: _Field, source: Rectangle, rng: np.random.Generator) -> Floats:
    """Return the scanner's way: lanes along the rows, some left out, points two metres apart."""
    apart, first = field.lanes
    count = np.ceil(field.reach / apart)
    lanes = apart * np.arange(-count, count + 1) + first
    lanes = lanes[rng.random(len(lanes)) < 0.9]
    along = np.arange(-field.reach, field.reach, 2.0)
    grid = np.stack(np.meshgrid(along, lanes), axis=-1).reshape(-1, 2)
    grid[:, 1] += 0.8 * np.sin(grid[:, 0] / 25.0 + grid[:, 1])
    way = field.place(grid)
    return np.asarray(way[source.contains(way)])


def _some(rng: np.random.Generator, count: int, share: float) -> Mask:
    return np.asarray(rng.random(count) < share)


def _solar_park(field: _Field) -> None:
    """Tables of panels in rows; service tracks, tables missing, transformer stations."""
    rng = field.fixed
    length, pitch = rng.uniform(12.0, 22.0), rng.uniform(5.5, 8.5)
    slant, tilt, foot = rng.uniform(3.2, 4.4), np.deg2rad(rng.uniform(15, 25)), rng.uniform(0.6, 0.9)
    grid, xy = field.lattice(length + 0.5, pitch)
    every = int(rng.integers(4, 8))
    column = np.rint(grid[:, 0] / (length + 0.5)).astype(int)
    keep = (column % every != 0) & _some(rng, len(xy), 0.975) & ~_some(field.epoch, len(xy), 0.01)
    xy = xy + rng.normal(0, 0.06, xy.shape)
    z = field.land(xy) + rng.normal(0, 0.05, len(xy))
    xy, z = xy[keep], z[keep]
    n = len(xy)
    yaw = field.yaws(n)
    along = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], axis=1)
    # tables follow the land along the row
    ends = [field.land(xy + sign * length / 2 * along[:, :2]) for sign in (-1.0, 1.0)]
    along[:, 2] = (ends[1] - ends[0]) / length
    up = np.stack([-np.sin(yaw) * np.cos(tilt), np.cos(yaw) * np.cos(tilt), np.full(n, np.sin(tilt))], axis=1)
    centre = np.c_[xy, z + foot + 0.5 * slant * np.sin(tilt)]
    field.scene.add_plates(centre, 0.5 * length * along, 0.5 * slant * up, 0.8)
    for offset in (-0.35, 0.0, 0.35):
        field.scene.add_posts(xy + offset * length * along[:, :2], foot + 0.5 * slant * np.sin(tilt), 0.06)
    field.service(0.35, (6.0, 3.0, 2.8))


def _orchard(field: _Field) -> None:
    """Fruit trees on a lattice: missing ones, young ones in their place, others taller."""
    rng = field.fixed
    along, across = rng.uniform(3.2, 4.8), rng.uniform(4.5, 6.5)
    _, xy = field.lattice(along, across)
    n = len(xy)
    xy = xy + rng.normal(0, 0.15, xy.shape)
    tall = rng.uniform(3.2, 4.6)
    height = tall * (1 + 0.09 * rng.normal(size=n))
    height = np.where(_some(rng, n, 0.05), rng.uniform(1.0, 2.2, n), height)
    breadth = np.minimum(0.72 * height, 0.95 * along) * rng.uniform(0.85, 1.1, n)
    there = ~_some(rng, n, 0.04) & ~_some(field.epoch, n, 0.006)
    height = height * (1 + 0.04 * field.epoch.normal(size=n)) + 0.15 * field.epoch.random()
    field.trees(xy[there], height[there], breadth[there])
    field.service(0.15, (9.0, 6.0, 3.6))


def _vineyard(field: _Field) -> None:
    """Vines on wires: gaps of single vines and of stretches, vigour that changes over the slope."""
    rng = field.fixed
    along, across = 1.1, rng.uniform(1.9, 2.8)
    grid, xy = field.lattice(along, across)
    n = len(xy)
    row = np.rint(grid[:, 1] / across).astype(int)
    there = ~_some(rng, n, 0.03)
    # stretches of 5 to 15 m without vines, about one on 150 m of row
    gap_row = rng.integers(row.min(), row.max() + 1, int(n * along / 150.0))
    gap_at, gap_long = rng.uniform(-field.reach, field.reach, len(gap_row)), rng.uniform(5, 15, len(gap_row))
    for number in np.unique(gap_row):
        mine = np.flatnonzero(row == number)
        for at, long in zip(gap_at[gap_row == number], gap_long[gap_row == number], strict=True):
            there[mine[np.abs(grid[mine, 0] - at) < long / 2]] = False
    vigour = np.zeros(n)
    for _ in range(4):
        wave, turn, phase = rng.uniform(40, 160), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        vigour += 0.5 * np.sin(2 * np.pi * (xy @ [np.cos(turn), np.sin(turn)]) / wave + phase)
    season = field.epoch.uniform(0.75, 1.1)
    size = season * (1 + 0.12 * vigour + 0.12 * field.epoch.normal(size=n))
    radii = np.stack([np.full(n, 0.62), 0.27 * size, 0.48 * size], axis=1)
    centre = np.c_[xy, field.land(xy) + 0.7 + 0.48 * size]
    field.scene.add_crowns(centre[there], radii[there], field.yaws(n)[there])
    posts = xy[np.rint(grid[:, 0] / along).astype(int) % 5 == 0]
    field.scene.add_posts(posts, np.full(len(posts), 1.9), 0.05)
    field.service(0.12, (5.0, 4.0, 2.8))


def _car_park(field: _Field) -> None:
    """Bays in double rows, two thirds taken by other cars each time; islands with trees, lamps, shelters."""
    rng = field.fixed
    bay, pitch = 2.5, rng.uniform(15.5, 17.5)
    grid, xy = field.lattice(bay, pitch)
    field.lanes = (2 * pitch, pitch / 2)
    every = int(rng.integers(9, 15))
    column = np.rint(grid[:, 0] / bay).astype(int)
    island = column % every == 0
    stays = _some(rng, 2 * len(xy), 0.06).reshape(2, -1)
    for side, sign in enumerate((-1.0, 1.0)):
        spots = field.place(grid + [0.0, sign * 2.6])
        taken = (stays[side] | _some(field.epoch, len(xy), 0.62)) & ~island
        place = spots[taken] + field.epoch.normal(0, 0.18, (int(taken.sum()), 2))
        field.cars(place, field.yaw + np.pi / 2 + field.epoch.normal(0, 0.03, len(place)))
    islands = xy[island]
    n = len(islands)
    height = rng.uniform(4.0, 8.0, n)
    tree = _some(rng, n, 0.72)
    grown = height * (1 + 0.04 * field.epoch.normal(size=n))
    field.trees(islands[tree], grown[tree], 0.55 * height[tree])
    field.scene.add_posts(islands[~tree], np.full(int((~tree).sum()), 7.0), 0.09)
    shelters = island & _some(rng, len(xy), 0.05)
    count = int(shelters.sum())
    spots = field.place(grid[shelters] + [0.0, 8.0])
    field.scene.add_boxes(spots, field.yaws(count), np.tile([4.0, 2.2, 2.4], (count, 1)), field.land(spots))


def _equal_houses(field: _Field) -> None:
    """One house again and again on both sides of parallel streets; extensions, sheds, trees, parked cars."""
    rng = field.fixed
    plot, pitch = rng.uniform(11.0, 15.0), rng.uniform(46.0, 58.0)
    width, depth, eaves, rise = rng.uniform(7.5, 9.5), rng.uniform(8.5, 10.5), rng.uniform(4.8, 6.0), 3.2
    field.lanes = (pitch, 0.0)
    grid, _ = field.lattice(plot, pitch)
    for sign in (-1.0, 1.0):
        front = grid + [0.0, sign * 12.5]
        n = len(front)
        xy = field.place(front)
        there = ~_some(rng, n, 0.05)
        base = field.land(xy)
        raised = np.where(_some(rng, n, 0.08), 0.5, 0.0)
        size = np.tile([width, depth, eaves], (n, 1)) + np.c_[np.zeros((n, 2)), raised]
        field.scene.add_gables(
            xy[there], field.yaws(n)[there], size[there], base[there], np.full(n, rise)[there]
        )
        back = _some(rng, n, 0.3) & there
        spots = field.place(front + [0.0, sign * (depth / 2 + 1.6)])[back]
        wide = np.stack([rng.uniform(3, 6, n), np.full(n, 3.2), np.full(n, 2.9)], axis=1)[back]
        field.scene.add_boxes(spots, field.yaws(len(spots)), wide, field.land(spots))
        shed = _some(rng, n, 0.5)
        aside = np.stack([rng.uniform(-4, 4, n), sign * rng.uniform(9.0, 11.0, n)], axis=1)
        spots = field.place(front + aside)[shed]
        huts = np.tile([2.6, 2.2, 2.2], (len(spots), 1))
        field.scene.add_boxes(spots, field.yaws(len(spots), 0.05), huts, field.land(spots))
        tree = _some(rng, n, 0.35)
        aside = np.stack([rng.uniform(-5, 5, n), sign * rng.uniform(6.5, 11.0, n)], axis=1)
        height = rng.uniform(3.0, 9.0, n)
        grown = height * (1 + 0.05 * field.epoch.normal(size=n))
        field.trees(field.place(front + aside)[tree], grown[tree], 0.6 * height[tree])
        parked = _some(field.epoch, n, 0.4)
        kerb = field.place(grid + np.c_[field.epoch.uniform(-4, 4, n), np.full(n, sign * 2.6)])[parked]
        field.cars(kerb, field.yaw + field.epoch.normal(0, 0.03, len(kerb)))
    field.service(0.08, (7.0, 5.0, 3.2))


def _warehouses(field: _Field) -> None:
    """One hall again and again; units on the roofs, offices at some, lorries in the yards."""
    rng = field.fixed
    width, depth, height = rng.uniform(48, 66), rng.uniform(24, 34), rng.uniform(7.5, 10.0)
    pitch = depth + rng.uniform(20, 28)
    field.lanes = (pitch, pitch / 2)
    grid, xy = field.lattice(width + rng.uniform(14, 22), pitch)
    n = len(xy)
    there = ~_some(rng, n, 0.06)
    tall = height + np.where(_some(rng, n, 0.15), rng.uniform(0.2, 0.8, n), 0.0)
    base, yaw = field.land(xy), field.yaws(n)
    size = np.stack([np.full(n, width), np.full(n, depth), tall], axis=1)
    field.scene.add_boxes(xy[there], yaw[there], size[there], base[there], roof_from_ground=0.01)
    for _ in range(4):
        unit = _some(rng, n, 0.6) & there
        at = field.place(grid + rng.uniform(-0.42, 0.42, (n, 2)) * [width, depth])[unit]
        small = rng.uniform([1.5, 1.5, 0.8], [4.0, 2.5, 1.8], (n, 3))[unit]
        field.scene.add_boxes(at, yaw[unit], small, (base + tall)[unit], roof_from_ground=0.0)
    office = _some(rng, n, 0.3) & there
    at = field.place(grid + [0.32 * width, depth / 2 + 3.0])[office]
    block = np.tile([10.0, 6.0, 4.0], (len(at), 1))
    field.scene.add_boxes(at, field.yaws(len(at)), block, field.land(at))
    for dock in (-0.35, -0.2, -0.05, 0.1):
        lorry = _some(field.epoch, n, 0.4) & there
        at = field.place(grid + [dock * width, -depth / 2 - 6.5])[lorry]
        box = np.tile([12.0, 2.5, 3.9], (len(at), 1))
        turned = field.yaw + np.pi / 2 + field.epoch.normal(0, 0.02, len(at))
        field.scene.add_boxes(at, turned, box, field.land(at), roof_from_ground=0.05)
    tree = _some(rng, n, 0.7)
    at = field.place(grid + np.c_[rng.uniform(-0.5, 0.5, n) * width, np.full(n, depth / 2 + 9.0)])[tree]
    height_of = rng.uniform(4.0, 10.0, n)[tree]
    field.trees(at, height_of, 0.6 * height_of)


_LAYOUTS: dict[RepeatingKind, Callable[[_Field], None]] = {
    "solar_park": _solar_park,
    "orchard": _orchard,
    "vineyard": _vineyard,
    "car_park": _car_park,
    "equal_houses": _equal_houses,
    "warehouses": _warehouses,
}
