"""A made-up box town as a registration pair at any state, cheap enough for every test."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pyproj import CRS

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import (
    Bev,
    Hypothesis,
    IcpResult,
    IcpRound,
    IcpTrial,
Levelling,
    Matches,
    Pair,
    Refinement,
    Side,
    Solution,
    TiePoints,
    Verdict,
)  # fmt: skip
from mtpcr_geo.crs import FrameLink, WorkFrame

ICP_RESULT = IcpResult(
    np.eye(4),
    "gicp",
    voxel_m=0.5,
    points_source=1000,
    points_target=3000,
    tried={"ground": IcpTrial(0.52, 14), "near": IcpTrial(0.31, 15)},
    chosen="near",
    followed=True,
    lost_tie_points=False,
    rounds=(IcpRound(1.0, 9, 800, True), IcpRound(0.5, 9, 800, True)),
    rotated_deg=0.1,
)
ORIGIN = np.array([367_000.0, 5_820_000.0, 30.0])
TOWN_TURNED = transforms.compose(transforms.yaw_matrix(np.deg2rad(-61.0)), np.array([14.0, -9.0, 2.5]))
"""How the source of the fixture town_files was moved, about `ORIGIN`."""
YAW = np.deg2rad(33.0)
SHIFT = np.array([12.5, -7.25, 1.5])


def town(rng: np.random.Generator, n: int, extent: float = 120.0) -> np.ndarray:
    """(n, 3) points on a gentle slope with boxes, metres around zero; the boxes are always the same."""
    boxes = np.random.default_rng(42)
    centre = boxes.uniform(-extent / 2, extent / 2, (25, 2))
    half = boxes.uniform(3.0, 9.0, (25, 2))
    height = boxes.uniform(3.0, 14.0, 25)
    xy = rng.uniform(-extent / 2, extent / 2, (n, 2))
    z = 0.03 * xy[:, 0] + 0.5 * np.sin(xy[:, 1] / 15.0)
    roof = np.zeros(n)
    for c, h, top in zip(centre, half, height, strict=True):
        inside = np.all(np.abs(xy - c) < h, axis=1)
        roof[inside] = np.maximum(roof[inside], top)
    wall = rng.uniform(size=n) < 0.15
    return np.column_stack([xy, z + np.where(wall, roof * rng.uniform(size=n), roof)])


def houses(rng: np.random.Generator, n: int, extent: float = 120.0, rough: float = 0.015) -> np.ndarray:
    """(n, 3) points as a scanner sees such a town: roofs, ground and facades, rough by 1.5 cm."""
    boxes = np.random.default_rng(42)
    centre = boxes.uniform(-extent / 2, extent / 2, (25, 2))
    half = boxes.uniform(3.0, 9.0, (25, 2))
    height = boxes.uniform(3.0, 14.0, 25)

    def ground(xy: np.ndarray) -> np.ndarray:
        return 0.03 * xy[:, 0] + 0.5 * np.sin(xy[:, 1] / 15.0)

    above = round(0.85 * n)
    xy = rng.uniform(-extent / 2, extent / 2, (above, 2))
    roof = np.zeros(above)
    for c, h, top in zip(centre, half, height, strict=True):
        inside = np.all(np.abs(xy - c) < h, axis=1)
        roof[inside] = np.maximum(roof[inside], top)
    house, side = rng.integers(0, 25, n - above), rng.integers(0, 4, n - above)
    along, sign = rng.uniform(-1.0, 1.0, n - above), np.where(side % 2, 1.0, -1.0)
    edge = np.where((side < 2)[:, None], np.column_stack([sign, along]), np.column_stack([along, sign]))
    foot = centre[house] + edge * half[house]
    wall = ground(foot) + rng.uniform(size=n - above) * height[house]
    xyz = np.concatenate([np.column_stack([xy, ground(xy) + roof]), np.column_stack([foot, wall])])
    return np.asarray(xyz + rng.normal(0.0, rough, xyz.shape))


def rasterise(xyz: np.ndarray, cell: float = 1.0) -> Bev:
    """A plain BEV of (n, 3) points."""
    west, south = np.floor(xyz[:, :2].min(axis=0) / cell) * cell
    east, north = np.ceil(xyz[:, :2].max(axis=0) / cell + 1e-9) * cell
    grid = Grid(west, north, cell, round((east - west) / cell), round((north - south) / cell))
    pixel = np.rint(grid.to_pixel(xyz[:, :2])).astype(int)
    pixel = np.clip(pixel, 0, [grid.width - 1, grid.height - 1])
    flat = pixel[:, 1] * grid.width + pixel[:, 0]
    top = np.full(grid.width * grid.height, -np.inf)
    low = np.full(grid.width * grid.height, np.inf)
    np.maximum.at(top, flat, xyz[:, 2])
    np.minimum.at(low, flat, xyz[:, 2])
    count = np.bincount(flat, minlength=len(top)).astype(np.uint32)
    top[count == 0] = np.nan
    low[count == 0] = np.nan
    shape = grid.shape
    return Bev(
        grid,
        top.reshape(shape).astype(np.float32),
        low.reshape(shape).astype(np.float32),
        count.reshape(shape),
    )


def true_transform() -> np.ndarray:
    """The 4x4 that takes the helper's source work coordinates to its target work coordinates."""
    return transforms.compose(transforms.yaw_matrix(YAW), SHIFT)


def make_sides(n: int = 20_000, crs: str | None = "EPSG:25833", tilt: float = 0.0, cell: float = 1.0):
    """(target, source) sides with BEVs; the source is turned by YAW, shifted and, if asked, tilted."""
    rng = np.random.default_rng(7)
    known = CRS(crs) if crs else None
    target_origin = ORIGIN if crs else np.zeros(3)
    target_xyz = town(rng, n)
    source_xyz = transforms.apply(transforms.inverse(true_transform()), town(rng, n))
    T_level = transforms.compose(transforms.tilt_matrix(0.4, tilt), np.zeros(3))
    source_xyz = transforms.apply(transforms.inverse(T_level), source_xyz)

    def side(role: Literal["source", "target"], xyz: np.ndarray, origin: np.ndarray, T: np.ndarray) -> Side:
        side_crs = known if role == "target" else None
        link = FrameLink(side_crs, origin, georeferenced=side_crs is not None)
        cloud = ArrayCloud(link.to_file(xyz), side_crs, f"{role}.laz")
        bev = rasterise(transforms.apply(T, xyz), cell)
        return Side(role, cloud, link, xyz, True, Levelling(T, "plane" if tilt else "none"), bev)

    target = side("target", target_xyz, target_origin, np.eye(4))
    return target, side("source", source_xyz, np.zeros(3), T_level)


def make_pair(
    n: int = 20_000,
    crs: str | None = "EPSG:25833",
    tilt: float = 0.0,
    state: str = "judged",
    verdict: Literal["accepted", "doubtful", "refused"] = "accepted",
    cell: float = 1.0,
) -> Pair:
    """A pair that has come as far as `state`: "levelled", "matched", "tied", "solved" or "judged"."""
    target, source = make_sides(n, crs, tilt, cell)
    frame = WorkFrame(target.link.file_crs, target.link.origin)
    pair = Pair(target, source, frame)
    if state == "levelled":
        return pair
    rng = np.random.default_rng(11)
    T = true_transform()
    m = 80
    target_xyz = town(rng, m, extent=100.0)
    noise = rng.normal(0.0, 0.08, (m, 3))
    noise[:12] += rng.uniform(3.0, 8.0, (12, 3)) * rng.choice([-1, 1], (12, 3))
    source_xyz = transforms.apply(transforms.inverse(T), target_xyz + noise)
    score = rng.uniform(0.3, 1.0, m)
    hypotheses = tuple(
        Hypothesis(float(YAW + k * 0.7), (float(SHIFT[0] + 3 * k), float(SHIFT[1])), s, 9000 - 500 * k)
        for k, s in enumerate((41.2, 17.9, 16.3, 15.8, 14.1))
    )
    matches = Matches(
        source.bev.grid.to_pixel(source_xyz[:, :2]),
        target.bev.grid.to_pixel(target_xyz[:, :2]),
        score,
        hypotheses,
        report={"matcher": "correlation"},
    )
    pair = pair.with_(matches=matches)
    if state == "matched":
        return pair
    inlier = np.arange(m) >= 12
    fold = np.arange(m) % 5
    if state == "tied":
        inlier = np.ones(m, bool)
    pair = pair.with_(tie_points=TiePoints(source_xyz, target_xyz, score, fold, fold == 0, inlier))
    if state == "tied":
        return pair
    T_work = T @ source.T_level_work
    pair = pair.with_(
        T_target_source=T_work,
        solution=Solution(T, inlier, 4, 0.5),
        refinement=Refinement(T_work, T_work, icp=ICP_RESULT),
    )
    if state == "solved":
        return pair
    reasons = {
        "accepted": ("16 held-out tie points agree to 0.11 m", "the best pose scores 2.3 times the next"),
        "doubtful": ("the best pose scores only 1.05 times the next",),
        "refused": (
            "only 3 of 16 held-out tie points agree within 1 m",
            "the clouds share 2 % of their cells",
        ),
    }[verdict]
    metrics = {
        "overlap_share": 0.83,
        "hypothesis_margin": 2.30,
        "held_out_tie_points": 16,
        "held_out_inlier_share": 0.81,
        "held_out_residual_median_m": 0.11,
        "sigma_plan_m": 0.04,
        "sigma_height_m": 0.03,
        "sigma_yaw_deg": 0.02,
    }
    return pair.with_(verdict=Verdict(verdict, reasons, metrics))
