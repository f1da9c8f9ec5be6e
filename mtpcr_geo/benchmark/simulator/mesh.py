"""Triangles with a material each: what a simulated site is built from.

All coordinates are site coordinates: metres, east-north-up about the middle of the site.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats, Indices


class Material(IntEnum):
    """What a surface is made of; it decides class, reflectance and how a beam meets it."""

    SOIL = 0
    GRASS = 1
    ASPHALT = 2
    PAVING = 3
    CROP = 4
    LITTER = 5
    WATER = 6
    FACADE = 7
    ROOF = 8
    GLASS = 9
    LEAF = 10
    WOOD = 11
    METAL = 12
    WIRE = 13
    STONE = 14
    PASSING = 15


# by material: ASPRS class, share of light sent back, standard deviation of the surface's own relief (m)
_TRAITS = {
    Material.SOIL: (2, 0.30, 0.03),
    Material.GRASS: (2, 0.45, 0.03),
    Material.ASPHALT: (2, 0.15, 0.006),
    Material.PAVING: (2, 0.25, 0.008),
    Material.CROP: (2, 0.50, 0.07),
    Material.LITTER: (2, 0.35, 0.07),
    Material.WATER: (9, 0.02, 0.01),
    Material.FACADE: (6, 0.40, 0.01),
    Material.ROOF: (6, 0.25, 0.015),
    Material.GLASS: (6, 0.03, 0.01),
    Material.LEAF: (5, 0.45, 0.08),
    Material.WOOD: (5, 0.35, 0.02),
    Material.METAL: (1, 0.30, 0.01),
    Material.WIRE: (14, 0.20, 0.01),
    Material.STONE: (1, 0.35, 0.015),
    Material.PASSING: (1, 0.30, 0.02),
}
LAS_CLASS = np.array([_TRAITS[m][0] for m in Material], np.uint8)
REFLECTANCE = np.array([_TRAITS[m][1] for m in Material])
RELIEF_M = np.array([_TRAITS[m][2] for m in Material])


@dataclass(frozen=True)
class Mesh:
    """A triangle soup.

    Attributes:
        vertices: (v, 3) float64 metres.
        triangles: (t, 3) int64 vertex numbers.
        material: (t,) uint8 `Material` of each triangle.

    """

    vertices: Floats
    triangles: Indices
    material: NDArray[np.uint8]


class MeshBuilder:
    """Gathers pieces of geometry and joins them once."""

    def __init__(self) -> None:
        self._vertices: list[Floats] = []
        self._triangles: list[Indices] = []
        self._material: list[NDArray[np.uint8]] = []
        self._count = 0

    def add(
        self, vertices: Floats, triangles: NDArray[np.integer], material: int | NDArray[np.uint8]
    ) -> None:
        """Add (v, 3) vertices and (t, 3) triangles, of one material or of (t,) materials."""
        self._vertices.append(np.asarray(vertices, np.float64))
        self._triangles.append(np.asarray(triangles, np.int64) + self._count)
        self._material.append(np.broadcast_to(np.asarray(material, np.uint8), len(triangles)))
        self._count += len(vertices)

    def add_mesh(self, mesh: Mesh) -> None:
        """Add all of another mesh."""
        self.add(mesh.vertices, mesh.triangles, mesh.material)

    def polygons(self, corners: Floats, material: int) -> None:
        """Add (n, k, 3) convex polygons of k corners each."""
        n, k = corners.shape[:2]
        fan = np.array([[0, i, i + 1] for i in range(1, k - 1)])
        triangles = (np.arange(n) * k)[:, None, None] + fan[None]
        self.add(corners.reshape(-1, 3), triangles.reshape(-1, 3), material)

    def box(
        self, frame: Frame, low: tuple[float, float, float], high: tuple[float, float, float], material: int
    ) -> None:
        """Add a box without a floor, between two corners (metres) of a local frame."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        base = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]])
        top = base + np.array([0.0, 0.0, z1 - z0])
        faces = [np.stack([base[i], base[(i + 1) % 4], top[(i + 1) % 4], top[i]]) for i in range(4)]
        self.polygons(frame.place(np.stack([*faces, top])), material)

    def build(self) -> Mesh:
        """Join all pieces."""
        if not self._vertices:
            return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.uint8))
        return Mesh(
            np.concatenate(self._vertices), np.concatenate(self._triangles), np.concatenate(self._material)
        )


@dataclass(frozen=True)
class Frame:
    """A local frame standing upright in the site: x along the front, y to the back.

    Attributes:
        x, y, z: its origin in site metres.
        yaw: radians from site x to local x, counter-clockwise.

    """

    x: float
    y: float
    z: float
    yaw: float

    def place(self, local: Floats) -> Floats:
        """Take (..., 3) local metres to (..., 3) site metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        out = np.empty_like(np.asarray(local, np.float64))
        out[..., 0] = self.x + c * local[..., 0] - s * local[..., 1]
        out[..., 1] = self.y + s * local[..., 0] + c * local[..., 1]
        out[..., 2] = self.z + local[..., 2]
        return out

    def moved(self, dx: float, dy: float, dz: float = 0.0, turn: float = 0.0) -> Frame:
        """Return the frame whose origin lies at local (dx, dy, dz), turned by `turn` radians."""
        x, y, z = self.place(np.array([dx, dy, dz]))
        return Frame(float(x), float(y), float(z), self.yaw + turn)
