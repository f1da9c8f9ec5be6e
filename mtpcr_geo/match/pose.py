"""Poses between two rasters: yaw and the place where the source raster's centre lands."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Hypothesis


@dataclass(frozen=True)
class Pose:
    """A candidate pose about the source raster's centre, where yaw and shift hardly interact.

    Attributes:
        yaw: radians, counter-clockwise seen from above.
        east, north: where the centre of the source raster comes to lie, metres in the target's frame.
        score: correlation score.
        overlap_cells: cells filled in both.

    """

    yaw: float
    east: float
    north: float
    score: float = 0.0
    overlap_cells: int = 0

    def hypothesis(self, pivot: Floats) -> Hypothesis:
        """Express it as ``target = Rz(yaw) source + shift``; pivot (2,) is the source raster's centre."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = pivot
        shift = (self.east - (c * x - s * y), self.north - (s * x + c * y))
        return Hypothesis(self.yaw, (float(shift[0]), float(shift[1])), self.score, self.overlap_cells)


def pose_of(hypothesis: Hypothesis, pivot: Floats) -> Pose:
    """Express a hypothesis about the source raster's centre ``pivot`` (2,)."""
    c, s = np.cos(hypothesis.yaw), np.sin(hypothesis.yaw)
    x, y = pivot
    east, north = c * x - s * y + hypothesis.shift[0], s * x + c * y + hypothesis.shift[1]
    return Pose(hypothesis.yaw, float(east), float(north), hypothesis.score, hypothesis.overlap_cells)


def centre_of(grid: Grid) -> Floats:
    """Centre of a raster, (2,) metres."""
    return np.array([grid.west + grid.width * grid.cell / 2, grid.north - grid.height * grid.cell / 2])


def warp_to(source: Image, source_grid: Grid, target_grid: Grid, pose: Pose) -> Image:
    """Bring source images onto the target's grid under a pose, bilinearly.

    Args:
        source: (k, h, w) images on ``source_grid``; 0 means empty.
        source_grid, target_grid: grids in metres of their own frames.
        pose: the pose.

    Returns:
        (k, H, W) float32 on ``target_grid``, 0 where the source does not reach.

    """
    M = source_from_target_pixels(source_grid, target_grid, pose)
    return warp(source, M, (target_grid.width, target_grid.height))


def warp(source: Image, M: Floats, size: tuple[int, int]) -> Image:
    """Sample (k, h, w) images bilinearly where a (2, 3) map puts the pixels of an image of a size."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    out = np.empty((len(source), size[1], size[0]), np.float32)
    for image, place in zip(source, out, strict=True):
        cv2.warpAffine(image, M, size, dst=place, flags=flags)
    return out


def source_from_target_pixels(source_grid: Grid, target_grid: Grid, pose: Pose) -> Floats:
    """Return the (2, 3) affine map from target pixels to source pixels under a pose."""
    # in plain numbers: it is asked for thousands of poses, and arrays of three points take longer
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    ratio, cell = target_grid.cell / source_grid.cell, source_grid.cell
    x = target_grid.west + 0.5 * target_grid.cell - pose.east
    y = target_grid.north - 0.5 * target_grid.cell - pose.north
    # about the source's centre, which is `width / 2` cells from its west
    column = (c * x + s * y) / cell + source_grid.width / 2 - 0.5
    row = (s * x - c * y) / cell + source_grid.height / 2 - 0.5
    return np.array([[ratio * c, -ratio * s, column], [ratio * s, ratio * c, row]])
