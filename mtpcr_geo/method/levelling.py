"""Levelling: which way is up in a cloud that does not know.

The paper fits the ground plane by RANSAC and turns it horizontal. On a slope that plane is not level, so it
is checked against what people and nature build plumb: walls, poles and trunks. Where enough of them are
seen, they decide and the plane only tells roughly where up is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import Levelling
from mtpcr_geo.method.downsample import one_per_voxel
from mtpcr_geo.method.neighbourhoods import local_shapes

Mode = Literal["auto", "ransac", "none"]

MAX_TILT_DEG = 25.0
PLANE_TOLERANCE_M = 0.4
FEWEST_ON_PLANE = 0.2
"""Share of the points on the ground plane below which it is one field among many, and says nothing."""
NEIGHBOURS = 14
SHAPE_POINTS = 25_000
FEWEST_VERTICALS = 60
PLUMB_WITHIN_DEG = 20.0
PLUMB_SIGMA_DEG = 1.5
WORST_SPREAD_DEG = 2.3
"""Robust spread about the vertical above which what leans that much is no evidence of it: crowns and branches
of sparse trees spread evenly over the 4.5 degrees that count as agreeing, walls and trunks by 0.8 to 2."""
WORST_CONDITION = 0.04
"""Share of the vertical evidence that must speak for the less well seen of the two tilt directions."""


def level(xyz: Floats, mode: Mode, georeferenced: bool, seed: int = 0) -> Levelling:
    """Find the rotation that makes a cloud upright.

    Args:
        xyz: (n, 3) sample of the cloud, metres, z within 25 degrees of up.
        mode: "none" keeps the cloud as it is; "ransac" turns the ground plane horizontal (the paper);
            "auto" keeps georeferenced clouds, whose vertical is known, and levels local ones by the ground
            plane checked against vertical structure; where neither says enough, they are kept.
        georeferenced: whether the cloud's CRS defines its vertical.
        seed: of the random choices.

    """
    if mode == "none" or (mode == "auto" and georeferenced):
        why = "kept as it is" if mode == "none" else "the CRS defines the vertical"
        return Levelling(why=why, trusted=True)
    rng = np.random.default_rng(seed)
    centre = xyz.mean(axis=0)
    up, share = ground_plane(one_per_voxel(xyz - centre, 1.0, rng, 30_000), rng)
    found = Levelling(method="plane", plane_tilt_deg=_tilt_deg(up), plane_inlier_share=share)
    if mode == "auto":
        plumb = plumb_line(one_per_voxel(xyz - centre, 0.4, rng, 200_000), up, rng)
        found = replace(found, verticals=plumb.count, verticals_spread_deg=plumb.spread_deg)
        if plumb.up is not None:
            apart = _between_deg(up, plumb.up)
            found = replace(found, method="verticals", plane_to_verticals_deg=apart)
            up = plumb.up
        elif share < FEWEST_ON_PLANE:
            why = "too little vertical structure, and no ground plane that holds"
            return replace(found, method="none", why=why)
    T = transforms.about(centre, rotation_to_up(up))
    return replace(found, T_level_work=T, tilt_deg=_tilt_deg(up))


def ground_plane(xyz: Floats, rng: np.random.Generator, iterations: int = 1500) -> tuple[Floats, float]:
    """Find the ground plane by RANSAC: many points on it, few below it.

    Args:
        xyz: (n, 3) thinned points about their centre, metres.
        rng: source of the samples.
        iterations: planes tried.

    Returns:
        The plane's upward unit normal (3,) and the share of points on it.

    """
    few = xyz if len(xyz) <= 4000 else xyz[rng.choice(len(xyz), 4000, replace=False)]
    three = few[rng.integers(0, len(few), (iterations, 3))]
    normal = np.cross(three[:, 1] - three[:, 0], three[:, 2] - three[:, 0])
    length = np.linalg.norm(normal, axis=1)
    steep = np.abs(normal[:, 2]) >= np.cos(np.radians(MAX_TILT_DEG)) * length
    usable = (length > 1.0) & steep
    if not usable.any():
        return np.array([0.0, 0.0, 1.0]), 0.0
    normal = normal[usable] / length[usable, None]
    normal *= np.sign(normal[:, 2])[:, None]
    height = few @ normal.T - np.einsum("ij,ij->i", normal, three[usable, 0])
    on = (np.abs(height) < PLANE_TOLERANCE_M).sum(axis=0)
    below = (height < -3 * PLANE_TOLERANCE_M).sum(axis=0)
    best = int(np.argmax(on - below))
    up, offset = normal[best], float(normal[best] @ three[usable, 0][best])
    near = np.zeros(len(xyz), bool)
    for _ in range(5):
        near = np.abs(xyz @ up - offset) < PLANE_TOLERANCE_M
        if near.sum() < 3:
            break
        centre = xyz[near].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov((xyz[near] - centre).T))
        up = vectors[:, 0] * (np.sign(vectors[2, 0]) or 1.0)
        offset = float(up @ centre)
    return up, float(near.mean())


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


def plumb_line(xyz: Floats, about: Floats, rng: np.random.Generator) -> PlumbLine:
    """Find up from walls (normals at right angles to it) and from poles and trunks (along it).

    Minimises the squared sines of their lean over unit vectors, with weights that fade beyond 1.5 degrees:
    the smallest eigenvector of a 3x3 matrix, repeated until it stands still.

    Args:
        xyz: (n, 3) points thinned to about 0.4 m, metres.
        about: (3,) rough up; only structure within 20 degrees of plumb by it is used.
        rng: chooses the points whose neighbourhoods are looked at.

    """
    import small_gicp

    nothing = PlumbLine(None, 0, None)
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


def rotation_to_up(up: Floats) -> Floats:
    """Smallest rotation (3, 3) that takes the unit vector ``up`` (3,) to +z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-15:
        return np.eye(3)
    return transforms.axis_angle_matrix(axis / sine, float(np.arctan2(sine, up[2])))


def _tilt_deg(up: Floats) -> float:
    return float(np.degrees(np.arctan2(np.hypot(up[0], up[1]), up[2])))


def _between_deg(a: Floats, b: Floats) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
