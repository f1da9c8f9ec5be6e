"""What several stages ask of a pair: its rasters, and the transform that its georeference claims."""

from __future__ import annotations

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.pipeline.stage import Stage


def georeference(pair: Pair, label: str) -> Floats:
    """Return the 4x4 from source to target work coordinates that both CRSs claim.

    Raises:
        OptionError: if a cloud has no CRS to claim it by.

    """
    if not (pair.target.link.georeferenced and pair.source.link.georeferenced):
        raise OptionError(
            f"{label}: a prior from the georeference needs a CRS on both clouds; name it by --source-crs and "
            "--target-crs, or search without a prior"
        )
    return transforms.translation(pair.source.link.origin - pair.target.link.origin)


def bevs_of(stage: Stage, pair: Pair) -> tuple[Bev, Bev]:
    """Return both rasters, source first.

    Raises:
        OptionError: if the pair has none, or is one cloud.

    """
    if pair.source is pair.target:
        raise OptionError(f"{stage.label} needs two clouds; give mtpcr.level a target and a source")
    if pair.source.bev is None or pair.target.bev is None:
        raise OptionError(f"{stage.label} needs height rasters; put mtpcr.bev before it")
    return pair.source.bev, pair.target.bev
