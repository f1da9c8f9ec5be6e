"""The ground: rolling relief, roads laid into it with cuttings, embankments, kerbs and ditches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from mtpcr_geo.benchmark.simulator.mesh import Material, Mesh
from mtpcr_geo.benchmark.simulator.roads import Network
from mtpcr_geo.core.arrays import Floats


def relief(
    shape: tuple[int, int], cell: float, longest: float, shortest: float, rng: np.random.Generator
) -> Floats:
    """Make smooth random relief with standard deviation 1.

    Its power falls with the third power of frequency, as that of real land does.

    Args:
        shape: (rows, columns) of the raster.
        cell: its cell in metres.
        longest: longest wavelength kept, metres.
        shortest: shortest wavelength kept, metres.
        rng: source of chance.

    """
    h, w = (2 * s for s in shape)  # twice as large, so that opposite edges are not alike
    fy, fx = np.fft.fftfreq(h, cell)[:, None], np.fft.rfftfreq(w, cell)[None]
    f = np.hypot(fy, fx)
    gain = np.zeros_like(f)
    band = (f >= 1.0 / longest) & (f <= 1.0 / shortest)
    gain[band] = f[band] ** -1.5
    noise = rng.normal(size=f.shape) + 1j * rng.normal(size=f.shape)
    field = np.fft.irfft2(noise * gain, s=(h, w))[: shape[0], : shape[1]]
    return np.asarray((field - field.mean()) / (field.std() + 1e-12))


@dataclass(frozen=True)
class Ground:
    """A height raster with a cover, nodes at the corners of a regular grid.

    Attributes:
        west, south: position of node (0, 0), metres.
        cell: distance of nodes, metres.
        z: (h, w) heights in metres, row 0 in the south.
        cover: (h, w) uint8 `Material`.
        road_distance: (h, w) metres to the nearest road's centre line.

    """

    west: float
    south: float
    cell: float
    z: Floats
    cover: NDArray[np.uint8]
    road_distance: Floats

    def _rc(self, xy: Floats) -> Floats:
        return np.stack([(xy[..., 1] - self.south) / self.cell, (xy[..., 0] - self.west) / self.cell])

    def height(self, xy: Floats) -> Floats:
        """Return the ground's height in metres at (n, 2) positions, bilinear, clamped at the rim."""
        return np.asarray(ndimage.map_coordinates(self.z, self._rc(xy), order=1, mode="nearest"))

    def cover_at(self, xy: Floats) -> NDArray[np.uint8]:
        """Return the `Material` at (n, 2) positions."""
        r, c = np.rint(self._rc(xy)).astype(int)
        top, right = np.array(self.z.shape) - 1
        return np.asarray(self.cover[np.clip(r, 0, top), np.clip(c, 0, right)], np.uint8)

    def mesh(self, lift: Floats | None = None) -> Mesh:
        """Triangulate; `lift` (h, w) metres (standing crop, say) is added to the heights."""
        h, w = self.z.shape
        x, y = np.meshgrid(self.west + self.cell * np.arange(w), self.south + self.cell * np.arange(h))
        z = self.z if lift is None else self.z + lift
        number = np.arange(h * w).reshape(h, w)
        a, b, c, d = (q.ravel() for q in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        material = np.tile(self.cover[:-1, :-1].ravel(), 2)
        return Mesh(np.stack([x, y, z], -1).reshape(-1, 3), triangles, material)


@dataclass(frozen=True)
class GroundStyle:
    """How the land lies.

    Attributes:
        hills_m: standard deviation of the long relief (80-700 m wavelength).
        slope: even slope, metres per metre.
        bumps_m: standard deviation of the short relief (3-40 m).
        kerb_m: height of the pavement above the carriageway; 0 gives ditches beside the road instead.
        open_cover: cover away from roads.

    """

    hills_m: float
    slope: float
    bumps_m: float
    kerb_m: float
    open_cover: Material


def make_ground(
    half: float, cell: float, style: GroundStyle, roads: Network, rng: np.random.Generator
) -> Ground:
    """Lay out the ground with its roads.

    Args:
        half: half the edge of the square, metres.
        cell: distance of nodes, metres.
        style: how the land lies.
        roads: centre lines and widths.
        rng: source of chance.

    """
    n = int(np.ceil(2 * half / cell)) + 1
    axis = -half + cell * np.arange(n)
    x, y = np.meshgrid(axis, axis)
    z = style.hills_m * relief((n, n), cell, 700.0, 80.0, rng)
    fall = rng.uniform(0, 2 * np.pi)
    z += style.slope * (np.cos(fall) * x + np.sin(fall) * y)
    smooth = ndimage.gaussian_filter(z, 10.0 / cell)
    bumps = style.bumps_m * relief((n, n), cell, 40.0, 3.0, rng)

    points, width = roads.points()
    distance, nearest = cKDTree(points).query(np.stack([x, y], -1).reshape(-1, 2))
    distance, half_width = distance.reshape(n, n), 0.5 * width[nearest].reshape(n, n)
    profile = _road_heights(points, smooth, -half, cell, roads)[nearest].reshape(n, n)
    beyond = distance - half_width  # metres past the kerb

    walk = 2.2 if style.kerb_m > 0 else 0.8
    bank = np.clip((beyond - walk) / 6.0, 0.0, 1.0)
    bank = bank * bank * (3 - 2 * bank)
    crown = -0.02 * np.minimum(distance, half_width)
    z = (1 - bank) * (profile + crown) + bank * (z + bumps)
    pavement = (beyond > 0) & (beyond < walk)
    if style.kerb_m > 0:
        z = np.where(beyond > 0, z + style.kerb_m * (1 - bank), z)
    else:
        z -= 0.55 * np.exp(-(((beyond - 2.2) / 0.9) ** 2))
    cover = np.full((n, n), int(style.open_cover), np.uint8)
    cover[pavement] = Material.PAVING if style.kerb_m > 0 else Material.GRASS
    cover[beyond <= 0] = Material.ASPHALT
    return Ground(-half, -half, cell, z, cover, distance)


def _road_heights(points: Floats, smooth: Floats, low: float, cell: float, roads: Network) -> Floats:
    """Heights of the carriageway: the smoothed land, smoothed again along each road."""
    z = ndimage.map_coordinates(smooth, (points[:, ::-1] - low).T / cell, order=1, mode="nearest")
    start = 0
    for line in roads.lines:
        part = slice(start, start + len(line))
        ends = z[part][[0, -1]]
        flat = ndimage.gaussian_filter1d(z[part], 8.0, mode="nearest")
        # junctions keep their height, so that roads meet
        t = np.linspace(0.0, 1.0, len(line))
        z[part] = flat + (1 - t) * (ends[0] - flat[0]) + t * (ends[1] - flat[-1])
        start += len(line)
    return np.asarray(z)
