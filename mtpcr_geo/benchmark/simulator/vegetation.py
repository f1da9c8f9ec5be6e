"""Trees, shrubs and hedges as leaves in clumps, so that beams pass partly through them.

A plant is a template (limbs, and a few hundred leaf triangles about them) set into the site with its
own height, breadth and turn. In another epoch a plant keeps its limbs, breadth, turn and lean, but has
other leaves and a slightly other size: no leaf is where it was, the crown's outline about is.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mtpcr_geo.benchmark.simulator.mesh import Material, MeshBuilder
from mtpcr_geo.core.arrays import Floats, Indices

VARIANTS = 6
_KEYS = 100_003


class Species(IntEnum):
    """Forms of plants."""

    BROADLEAF = 0
    CONIFER = 1
    COLUMN = 2
    FRUIT = 3
    SHRUB = 4


@dataclass(frozen=True)
class Form:
    """How a species looks.

    Attributes:
        crown_base: share of the height below the crown.
        breadth: crown diameter over height.
        clumps, leaves: number of clumps, and of leaves in each.
        clump: radius of a clump over the crown's radius.
        taper: 0 for a ball, 1 for a cone.

    """

    crown_base: float
    breadth: float
    clumps: int
    leaves: int
    clump: float
    taper: float


FORMS = {
    Species.BROADLEAF: Form(0.22, 0.68, 30, 10, 0.40, 0.0),
    Species.CONIFER: Form(0.10, 0.34, 24, 8, 0.42, 0.92),
    Species.COLUMN: Form(0.08, 0.22, 18, 9, 0.55, 0.25),
    Species.FRUIT: Form(0.28, 0.85, 12, 8, 0.45, 0.0),
    Species.SHRUB: Form(0.0, 1.1, 8, 8, 0.55, 0.0),
}


@dataclass(frozen=True)
class Plants:
    """A stand of plants.

    Attributes:
        xy: (n, 2) metres.
        height: (n,) metres.
        species: (n,) `Species`.

    """

    xy: Floats
    height: Floats
    species: Indices

    @classmethod
    def empty(cls) -> Plants:
        """No plants."""
        return cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))

    def joined(self, other: Plants) -> Plants:
        """Both stands as one."""
        return Plants(
            np.concatenate([self.xy, other.xy]),
            np.concatenate([self.height, other.height]),
            np.concatenate([self.species, other.species]),
        )

    def aged(self, rng: np.random.Generator, gone: float, growth: float) -> Plants:
        """Return the stand in another epoch: some felled (share `gone`), the rest grown by about `growth`."""
        stay = rng.random(len(self.xy)) >= gone
        n = int(stay.sum())
        return Plants(
            self.xy[stay],
            self.height[stay] * (1 + growth + 0.03 * rng.normal(size=n)),
            self.species[stay],
        )


def _template(form: Form, limbs: np.random.Generator, rng: np.random.Generator) -> Floats:
    """Leaves (m, 3, 6) of a unit crown: by corner, the leaf's place in the crown and the corner's offset."""
    k = form.clumps
    direction = limbs.normal(size=(k, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centre = direction * (limbs.uniform(0.35, 0.8, (k, 1)) * limbs.uniform(0.85, 1.1, (k, 1)))
    up = 0.5 * (centre[:, 2] + 1)  # 0 at the crown's foot, 1 at its top
    narrow = 1 - form.taper * np.clip(up, 0, 1)
    centre[:, :2] *= (narrow + 0.05)[:, None]
    radius = form.clump * limbs.uniform(0.6, 1.25, k) * (0.35 + 0.65 * narrow)
    shell = rng.normal(size=(k, form.leaves, 3))
    shell /= np.linalg.norm(shell, axis=2, keepdims=True)
    shell[..., 2] = np.abs(shell[..., 2]) * rng.choice([1, 1, -1], size=shell.shape[:2])
    leaf = centre[:, None] + radius[:, None, None] * shell * rng.uniform(0.5, 1.0, shell.shape[:2])[..., None]
    leaf = leaf.reshape(-1, 3)
    corner = rng.normal(size=(len(leaf), 3, 3))
    corner -= corner.mean(axis=1, keepdims=True)
    corner /= np.linalg.norm(corner, axis=2, keepdims=True) + 1e-9
    size = rng.uniform(0.6, 1.3, (len(leaf), 1, 1))
    triangles = np.concatenate([leaf[:, None].repeat(3, 1), corner * size], axis=2)
    return np.asarray(triangles)


def add_plants(
    out: MeshBuilder,
    plants: Plants,
    ground_z: Floats,
    rng: np.random.Generator,
    leafiness: float = 1.0,
    shape_seed: int = 0,
) -> None:
    """Add leaves and trunks.

    Args:
        out: where to.
        plants: what stands where.
        ground_z: (n,) metres, the ground at each plant.
        rng: chance of this epoch.
        leafiness: share of leaves present; about 0.25 for bare winter trees (twigs).
        shape_seed: seed of what is the same in all epochs: limbs, breadth, turn and lean.

    """
    # what a plant keeps is drawn by a key from its place, so that it stays when others are felled
    table = np.random.default_rng([shape_seed, 41]).uniform(0, 1, (_KEYS, 5))
    kept = table[(np.abs(plants.xy * [7919.0, 104729.0]).sum(axis=1)).astype(np.int64) % _KEYS]
    for species, form in FORMS.items():
        for v in range(VARIANTS):
            chosen = np.flatnonzero((plants.species == species) & (np.floor(kept[:, 0] * VARIANTS) == v))
            limbs = np.random.default_rng([shape_seed, int(species), v])
            template = _template(form, limbs, rng)
            if len(chosen):
                _place(out, template, form, plants, chosen, ground_z, kept[chosen], rng, leafiness)
    tall = np.flatnonzero(plants.species != Species.SHRUB)
    lean = 0.03 * (kept[tall, 3:5] - 0.5) * plants.height[tall, None]
    _trunks(out, plants.xy[tall], plants.height[tall], ground_z[tall], lean)


def _place(
    out: MeshBuilder,
    template: Floats,
    form: Form,
    plants: Plants,
    chosen: Indices,
    ground_z: Floats,
    kept: Floats,
    rng: np.random.Generator,
    leafiness: float,
) -> None:
    m = len(template)
    height = plants.height[chosen]
    radius = 0.5 * form.breadth * height * (0.8 + 0.45 * kept[:, 1])
    half = 0.5 * (1 - form.crown_base) * height
    turn = 2 * np.pi * kept[:, 2]
    c, s = np.cos(turn)[:, None, None], np.sin(turn)[:, None, None]
    centre = template[None, :, :, :3]
    x = radius[:, None, None] * (c * centre[..., 0] - s * centre[..., 1])
    y = radius[:, None, None] * (s * centre[..., 0] + c * centre[..., 1])
    z = half[:, None, None] * np.clip(centre[..., 2], -1.0, 1.05)
    # sprays of a size that lets about a quarter of the beams through a crown: leaf area over crown area 1.4
    spray = np.clip((1 - 0.3 * form.taper) * radius * np.sqrt(13.0 / m), 0.08, 0.9)
    corner = np.stack([x, y, z], -1) + spray[:, None, None, None] * template[None, :, :, 3:]
    middle = ground_z[chosen] + form.crown_base * height + half
    corner += np.concatenate([plants.xy[chosen], middle[:, None]], 1)[:, None, None]
    leaves = corner.reshape(-1, 3, 3)
    if leafiness < 1.0:
        leaves = leaves[rng.random(len(leaves)) < leafiness]
    out.polygons(leaves, Material.LEAF)


def _trunks(out: MeshBuilder, xy: Floats, height: Floats, ground_z: Floats, lean: Floats) -> None:
    n = len(xy)
    if not n:
        return
    r = 0.011 * height + 0.03
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    foot = np.empty((n, 5, 3))
    foot[..., :2] = xy[:, None] + r[:, None, None] * ring
    foot[..., 2] = (ground_z - 0.4)[:, None]
    head = np.empty((n, 5, 3))
    head[..., :2] = (xy + lean)[:, None] + 0.45 * r[:, None, None] * ring
    head[..., 2] = (ground_z + 0.7 * height)[:, None]
    nxt = (np.arange(5) + 1) % 5
    quads = np.stack([foot, foot[:, nxt], head[:, nxt], head], axis=2)
    out.polygons(quads.reshape(-1, 4, 3), Material.WOOD)


def add_hedge(out: MeshBuilder, line: Floats, z: Floats, height: float, rng: np.random.Generator) -> None:
    """Add a clipped hedge along a (k, 2) line of metres with ground heights `z` (k,)."""
    step = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.r_[0.0, np.cumsum(step)]
    n = int(along[-1] * height * 14)
    if n < 3:
        return
    at = rng.uniform(0, along[-1], n)
    middle = np.stack([np.interp(at, along, line[:, k]) for k in (0, 1)] + [np.interp(at, along, z)], 1)
    middle[:, :2] += rng.uniform(-0.35, 0.35, (n, 2))
    middle[:, 2] += height * np.sqrt(rng.uniform(0.0, 1.0, n))
    corner = rng.normal(0, 0.2, (n, 3, 3))
    out.polygons(middle[:, None] + corner, Material.LEAF)
