"""A small survey of box towns, in tiles that overlap at their borders."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from helpers_scene import ORIGIN, houses
from pyproj import CRS

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.io.write import write_cloud

ETRS = CRS.from_epsg(25833)
YAW_DEG = -61.0


def write_tile(path: Path, xyz: np.ndarray, crs: CRS | None = ETRS) -> Path:
    write_cloud(path, ArrayCloud(xyz, crs, path.stem, {}), None, crs)
    return path


def tiles_of(folder: Path, xyz: np.ndarray, border: float = 1.0) -> list[Path]:
    """Write a cloud as four tiles that share what lies within a border of their common edges."""
    folder.mkdir(parents=True, exist_ok=True)
    middle = (xyz[:, :2].min(axis=0) + xyz[:, :2].max(axis=0)) / 2
    files = []
    for number, sides in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        chosen = ((xyz[:, :2] - middle) * sides > -border).all(axis=1)
        files.append(write_tile(folder / f"tile{number}.laz", xyz[chosen]))
    return files


def town_target(seed: int = 7, points: int = 60_000) -> np.ndarray:
    return houses(np.random.default_rng(seed), points) + ORIGIN


def town_source() -> tuple[np.ndarray, np.ndarray]:
    """A scan of the town in a frame of its own, and the 4x4 from there to the target."""
    xyz = houses(np.random.default_rng(8), 40_000)
    xyz = xyz[xyz[:, 0] > -30.0]
    T_source_target = transforms.compose(
        transforms.yaw_matrix(np.deg2rad(YAW_DEG)), np.array([14.0, -9.0, 2.5])
    )
    back = transforms.inverse(T_source_target)
    back[:3, 3] += ORIGIN
    return transforms.apply(T_source_target, xyz), back


def digests(folder: Path) -> dict[str, str]:
    """Return the hash of every file below a folder, by its relative name."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
