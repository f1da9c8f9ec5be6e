"""The kinds of sites, as numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from mtpcr_geo.benchmark.simulator.mesh import Material
from mtpcr_geo.benchmark.simulator.roads import RoadStyle
from mtpcr_geo.benchmark.simulator.terrain import GroundStyle

Kind = Literal["town", "suburb", "campus", "forest", "farmland", "steep", "rows"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class SiteStyle:
    """What a kind of site is made of.

    Attributes:
        description: a short text.
        ground, roads: how the land lies and how the roads run.
        lots: how houses stand: "terraced", "detached", "halls", "identical", "farms" or "none".
        built: share of lots with a house on it.
        stems_per_ha: trees per hectare of wood.
        wooded: share of the open land under wood.
        lone_per_ha: single trees per hectare of open land.
        street_trees: share of roads lined with trees.
        cars_per_100m: parked cars per 100 m of road; a quarter as many drive, half as many people walk.
        poles: share of roads with poles; half of those carry wires.
        fields: whether open land is farmed, with crops that differ between the epochs.

    """

    description: str
    ground: GroundStyle
    roads: RoadStyle
    lots: Literal["terraced", "detached", "halls", "identical", "farms", "none"]
    built: float
    stems_per_ha: float
    wooded: float
    lone_per_ha: float
    street_trees: float
    cars_per_100m: float
    poles: float
    fields: bool = False


STYLES: dict[Kind, SiteStyle] = {
    "town": SiteStyle(
        "dense town: closed rows of houses round courtyards, street trees, parked cars",
        GroundStyle(2.0, 0.008, 0.10, 0.12, Material.GRASS),
        RoadStyle((105.0, 60.0), 4.0, 5.0, 0.08, 6.5),
        "terraced", 0.97, 120, 0.05, 6, 0.40, 9, 0.5,
    ),
    "suburb": SiteStyle(
        "suburb: detached houses in gardens with hedges, sheds and trees",
        GroundStyle(3.0, 0.012, 0.12, 0.10, Material.GRASS),
        RoadStyle((120.0, 72.0), 9.0, 16.0, 0.20, 5.5),
        "detached", 0.88, 220, 0.12, 9, 0.25, 3, 0.6,
    ),
    "campus": SiteStyle(
        "campus: large halls and blocks, car parks, lawns and avenues",
        GroundStyle(1.5, 0.006, 0.08, 0.12, Material.GRASS),
        RoadStyle((130.0, 105.0), 8.0, 8.0, 0.15, 6.5),
        "halls", 0.85, 150, 0.10, 7, 0.5, 4, 0.5,
    ),
    "forest": SiteStyle(
        "forest: mixed wood with tracks, clearings and undergrowth",
        GroundStyle(5.0, 0.03, 0.30, 0.0, Material.LITTER),
        RoadStyle((150.0, 110.0), 15.0, 24.0, 0.15, 3.2),
        "farms", 0.08, 380, 0.86, 8, 0.0, 0.2, 0.1,
    ),
    "farmland": SiteStyle(
        "open farmland: fields, hedgerows, few trees, scattered farmsteads",
        GroundStyle(3.5, 0.012, 0.14, 0.0, Material.CROP),
        RoadStyle((190.0, 140.0), 18.0, 22.0, 0.18, 4.0),
        "farms", 0.30, 220, 0.04, 1.2, 0.12, 0.3, 0.35, True,
    ),
    "steep": SiteStyle(
        "steep hillside: houses on terraces, winding roads, wood above",
        GroundStyle(9.0, 0.22, 0.45, 0.0, Material.GRASS),
        RoadStyle((140.0, 75.0), 10.0, 22.0, 0.18, 5.0),
        "detached", 0.50, 300, 0.35, 12, 0.05, 1.5, 0.4,
    ),
    "rows": SiteStyle(
        "repetitive rows: the same terraced house again and again on a regular grid",
        GroundStyle(1.0, 0.004, 0.08, 0.12, Material.GRASS),
        RoadStyle((125.0, 58.0), 0.8, 0.8, 0.06, 6.0),
        "identical", 0.96, 120, 0.02, 4, 0.25, 6, 0.5,
    ),
}  # fmt: skip
