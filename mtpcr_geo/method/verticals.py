"""What a cloud shows of the vertical: its ground plane, and what people and nature build plumb.

Lengths follow from the cloud's extent, see `mtpcr_geo.method.floor.extent_of`:

==================  ====================  ============
length              rule                  limits
==================  ====================  ============
voxels, plane       1/100 of the extent   0.1 to 1 m
tolerance, plane    1/250 of the extent   0.1 to 0.6 m
voxels, plumb line  1/50 of the extent    0.1 to 0.4 m
==================  ====================  ============
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.transforms import centroid
from mtpcr_geo.method.downsample import one_per_voxel
from mtpcr_geo.method.neighbourhoods import local_shapes

MAX_TILT_DEG = 25.0
"""How far the ground plane may lean from where up is thought to be."""
NEIGHBOURS = 14
SHAPE_POINTS = 25_000
FEWEST_VERTICALS = 60
PLUMB_WITHIN_DEG = 20.0
PLUMB_SIGMA_DEG = 1.5
WORST_SPREAD_DEG = 2.3
"""Robust spread about the vertical above which what leans that much is no evidence of it: crowns and branches
of sparse trees spread evenly over the 4.5 degrees that count as agreeing, walls and trunks by 0.8 to 2."""
_PLANES_AT_ONCE = 16
WORST_CONDITION = 0.04
"""Share of the vertical evidence that must speak for the less well seen of the two tilt directions."""


def ground_plane(
    xyz: Floats, about: Floats, extent: float, rng: np.random.Generator, iterations: int = 1500
) -> tuple[Floats, float]:
    """Find the ground plane by RANSAC: many points on it, few below it.

    Args:
        xyz: (n, 3) points, metres.
        about: (3,) unit vector, up to 25 degrees or so.
        extent: of the cloud, metres.
        rng: source of the samples.
        iterations: planes tried.

    Returns:
        The plane's upward unit normal (3,) and the share of the thinned points on it.

    """
    tolerance = float(np.clip(extent / 250.0, 0.1, 0.6))
    xyz = one_per_voxel(xyz - centroid(xyz), float(np.clip(extent / 100.0, 0.1, 1.0)), rng, 30_000)
    few = xyz if len(xyz) <= 4000 else xyz[rng.choice(len(xyz), 4000, replace=False)]
    three = few[rng.integers(0, len(few), (iterations, 3))]
    normal = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    length = np.linalg.norm(normal, axis=1)
    along = normal @ about
    usable = (length > tolerance**2) & (np.abs(along) >= np.cos(np.radians(MAX_TILT_DEG)) * length)
    if not usable.any():
        return about, 0.0
    normal = normal[usable] / length[usable, None] * np.sign(along[usable])[:, None]
    at = np.einsum("ij,ij->i", normal, three[usable, 0])
    best = int(np.argmax(_points_for(few, normal, at, tolerance)))
    up, offset = normal[best], float(at[best])
    near = np.zeros(len(xyz), bool)
    for _ in range(5):
        near = np.abs(xyz @ up - offset) < tolerance
        if near.sum() < 3:
            break
        centre = xyz[near].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov((xyz[near] - centre).T))
        up = vectors[:, 0] * (np.sign(vectors[:, 0] @ about) or 1.0)
        offset = float(up @ centre)
    return up, float(near.mean())


def _points_for(xyz: Floats, normals: Floats, offsets: Floats, tolerance: float) -> Floats:
    """Return for each plane the points on it less those well below it, (m,)."""
    counts = np.empty(len(normals))
    # heights above so many planes stay in the processor's cache
    for start in range(0, len(normals), _PLANES_AT_ONCE):
        some = slice(start, start + _PLANES_AT_ONCE)
        height = normals[some] @ xyz.T
        height -= offsets[some, None]
        below = np.count_nonzero(height < -3 * tolerance, axis=1)
        counts[some] = np.count_nonzero(np.abs(height, out=height) < tolerance, axis=1) - below
    return counts


@dataclass(frozen=True)
class PlumbLine:
    """What vertical structure says about up.

    Attributes:
        up: (3,) unit vector, or None where there is too little to say.
        count: points on walls, poles and trunks that agree.
        spread_deg: their robust spread about it.

    """

    up: Floats | None
    count: int
    spread_deg: float | None


def plumb_line(xyz: Floats, about: Floats, extent: float, rng: np.random.Generator) -> PlumbLine:
    """Find up from walls (normals at right angles to it) and from poles and trunks (along it).

    Minimises the squared sines of their lean over unit vectors, with weights that fade beyond 1.5 degrees:
    the smallest eigenvector of a 3x3 matrix, repeated until it stands still.

    Args:
        xyz: (n, 3) points, metres.
        about: (3,) rough up; only structure within 20 degrees of plumb by it is used.
        extent: of the cloud, metres.
        rng: chooses the points whose neighbourhoods are looked at.

    """
    import small_gicp

    nothing = PlumbLine(None, 0, None)
    xyz = one_per_voxel(xyz - centroid(xyz), float(np.clip(extent / 50.0, 0.1, 0.4)), rng, 200_000)
    if len(xyz) < 10 * NEIGHBOURS:
        return nothing
    chosen = xyz if len(xyz) <= SHAPE_POINTS else xyz[rng.choice(len(xyz), SHAPE_POINTS, replace=False)]
    threads = usable_cores()
    tree = small_gicp.KdTree(xyz, threads)
    spread, vectors = local_shapes(tree, xyz, chosen, NEIGHBOURS, threads)
    flat = (spread[:, 1] > 4 * spread[:, 0]) & (spread[:, 1] > 0.3 * spread[:, 2])
    thin_ = spread[:, 2] > 5 * spread[:, 1]
    within = np.sin(np.radians(PLUMB_WITHIN_DEG))
    normal, along = vectors[flat, :, 0], vectors[thin_, :, 2]
    normal = normal[np.abs(normal @ about) < within]
    along = along[np.linalg.norm(np.cross(along, about), axis=1) < within]
    if len(normal) + len(along) < FEWEST_VERTICALS:
        return nothing
    up, sigma = about, np.sin(np.radians(PLUMB_SIGMA_DEG))
    scale = 4.0
    for _ in range(25):
        lean_n = np.abs(normal @ up)
        lean_a = np.linalg.norm(np.cross(along, up), axis=1)
        wn = 1.0 / (1.0 + (lean_n / (scale * sigma)) ** 2) ** 2
        wa = 1.0 / (1.0 + (lean_a / (scale * sigma)) ** 2) ** 2
        M = (normal * wn[:, None]).T @ normal + wa.sum() * np.eye(3) - (along * wa[:, None]).T @ along
        values, vectors = np.linalg.eigh(M)
        now = vectors[:, 0] * (np.sign(vectors[:, 0] @ about) or 1.0)
        still = np.linalg.norm(now - up) < 1e-7 and scale == 1.0
        up, scale = now, max(1.0, scale * 0.7)
        if still:
            break
    lean = np.degrees(
        np.arcsin(np.clip(np.concatenate([normal @ up, np.linalg.norm(np.cross(along, up), axis=1)]), -1, 1))
    )
    agree = np.abs(lean) < 3 * PLUMB_SIGMA_DEG
    count = int(agree.sum())
    evidence = wn.sum() + wa.sum()
    if (
        count < FEWEST_VERTICALS
        or (values[1] - values[0]) < WORST_CONDITION * evidence
        or count < 0.3 * len(lean)
    ):
        return PlumbLine(None, count, None)
    about_up = float(1.4826 * np.median(np.abs(lean[agree])))
    return PlumbLine(up if about_up <= WORST_SPREAD_DEG else None, count, about_up)
