"""One made-up site, written in many coordinate reference systems."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from helpers_scene import houses
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.crs import BoundCRS, CompoundCRS
from pyproj.crs.coordinate_operation import ToWGS84Transformation

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.types import Pair
from mtpcr_geo.crs import TransformChain
from mtpcr_geo.io.write import write_cloud

FOOT, US_FOOT = 0.3048, 1200 / 3937
UTM = CRS.from_epsg(25832)
PLACE = np.array([389_000.0, 5_373_000.0, 180.0])  # Alsace: UTM 32, near zone 31, within Lambert-93
LOCAL_ORIGIN = PLACE - [40.0, 25.0, 3.0]
STEP = 1e-4  # metres, or the like of it: what a file cannot hold must not decide
T_MOVED = transforms.compose(transforms.yaw_matrix(np.deg2rad(3.0)), np.array([4.0, -3.0, 1.5]))
CORNERS = PLACE + np.array([[-30.0, -60, 0], [60, -60, 10], [60, 60, 0], [-30, 60, 5], [0, 0, 0]])


def in_units(crs: CRS, unit: float, name: str) -> CRS:
    """The same projected or vertical CRS, its axes in another unit."""
    data = crs.to_json_dict()
    for axis in data["coordinate_system"]["axis"]:
        axis["unit"] = {"type": "LinearUnit", "name": name, "conversion_factor": unit}
    data.pop("id", None)
    data["name"] += f" in {name}"
    return CRS.from_json_dict(data)


def compound(horizontal: CRS, vertical: CRS) -> CRS:
    return CompoundCRS(f"{horizontal.name} + {vertical.name}", components=[horizontal, vertical])


@dataclass(frozen=True)
class Variant:
    """How a cloud is written.

    Attributes:
        crs: what the file states.
        place: the CRS that pyproj converts to; `crs` where None.
        up: metres a unit of height.
        start: the metric CRS to convert from; it decides what heights are.
        options: of `register`, by the side's role.
        origin: taken away from the metric coordinates where there is no CRS.

    """

    crs: CRS | None
    place: CRS | None = None
    up: float = 1.0
    start: CRS = UTM
    options: dict[str, str] = field(default_factory=dict)
    origin: np.ndarray | None = None

    def written(self, xyz: np.ndarray) -> np.ndarray:
        """(n, 3) metric coordinates as they stand in the file."""
        if self.crs is None:
            return xyz - (0.0 if self.origin is None else self.origin)
        result = np.column_stack(self._way().transform(*xyz.T))
        result[:, 2] /= self.up
        return result

    def read(self, xyz: np.ndarray) -> np.ndarray:
        """(n, 3) metric coordinates of what stands in the file."""
        if self.crs is None:
            return xyz + (0.0 if self.origin is None else self.origin)
        x, y, z = xyz.T
        return np.column_stack(self._way().transform(x, y, z * self.up, direction="INVERSE"))

    def _way(self) -> Transformer:
        return Transformer.from_crs(self.start, self.place or self.crs, always_xy=True)

    def write(self, path: Path, xyz: np.ndarray) -> Path:
        """Write a metric cloud."""
        degrees = self.crs is not None and self.crs.is_geographic
        scale = (1e-9, 1e-9, STEP) if degrees else STEP
        kinds: dict[str, NDArray[np.generic]] = {"Classification": np.full(len(xyz), 2, np.uint8)}
        cloud = ArrayCloud(self.written(xyz), self.crs, path.name, kinds)
        write_cloud(path, cloud, None, self.crs, scale=scale)
        return path


FEET = in_units(UTM, FOOT, "foot")
US_FEET = in_units(UTM, US_FOOT, "US survey foot")
LEVEL = CRS.from_epsg(5783)
UTM_3D = UTM.to_3d()

PLAIN = {
    "metres": Variant(UTM),
    "international feet": Variant(FEET, up=FOOT),
    "US survey feet": Variant(US_FEET, up=US_FOOT),
    "UTM zone 31": Variant(CRS.from_epsg(25831)),
    "WGS 84 UTM": Variant(CRS.from_epsg(32632)),
    "geographic": Variant(CRS.from_epsg(4258)),
    "Europe's Lambert": Variant(CRS.from_epsg(3034)),
    "Lambert-93": Variant(CRS.from_epsg(2154)),
    "bound": Variant(
        BoundCRS(UTM, CRS.from_epsg(4326), ToWGS84Transformation(UTM.geodetic_crs, *[0.0] * 7)), UTM
    ),
    "no CRS but an option": Variant(None, options={"crs": "EPSG:25832"}),
    "local": Variant(None, options={"crs": "local"}, origin=LOCAL_ORIGIN),
}
ELLIPSOIDAL = {
    "metres, 3D": Variant(UTM_3D, start=UTM_3D),
    "geographic 3D": Variant(CRS.from_epsg(4937), start=UTM_3D),
    "geocentric": Variant(CRS.from_epsg(4936), start=UTM_3D),
}
LEVELLED = {
    "compound": Variant(compound(UTM, LEVEL), UTM),
    "compound, feet up": Variant(compound(UTM, in_units(LEVEL, US_FOOT, "US survey foot")), UTM, US_FOOT),
    "compound, feet both": Variant(
        compound(US_FEET, in_units(LEVEL, US_FOOT, "US survey foot")), US_FEET, US_FOOT
    ),
    "compound, zone 31": Variant(compound(CRS.from_epsg(25831), LEVEL), CRS.from_epsg(25831)),
}
GROUPS = (PLAIN, ELLIPSOIDAL, LEVELLED)


def site(points: int = 60_000) -> tuple[np.ndarray, np.ndarray]:
    """Source and target of the site, metric coordinates; the source is moved from its place by T_MOVED."""
    rng = np.random.default_rng(7)
    target, source = houses(rng, points), houses(rng, 2 * points // 3)
    source = source[source[:, 0] > -30.0]
    return transforms.apply(T_MOVED, source) + PLACE, target + PLACE


def options_of(source: Variant, target: Variant) -> dict[str, str]:
    """Options of `register` for two sides."""
    sides = {"source": source, "target": target}
    return {f"{role}_{key}": value for role, side in sides.items() for key, value in side.options.items()}


def moved_corners() -> np.ndarray:
    """Metric coordinates of CORNERS as the source has them."""
    return transforms.apply(T_MOVED, CORNERS - PLACE) + PLACE


def placed(pair: Pair, source: Variant, target: Variant) -> np.ndarray:
    """Where a registration brings the source's corners, metric coordinates of the site: CORNERS if right."""
    return target.read(TransformChain.of(pair).forward(source.written(moved_corners())))
