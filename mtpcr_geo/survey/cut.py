"""The points of a survey at one place, read from the tiles that hold them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.cloud import CHUNK_POINTS, ArrayCloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.survey.index import Survey, Tile

MOST_POINTS = 60_000_000
"""Points of a place that are held at most: 1.5 GB."""


class CutOut(ArrayCloud):
    """The points of a survey within a box, but for noise.

    Attributes:
        tiles: the tiles that were read.
        box: (2, 2) lowest and highest x and y, in units of the CRS.

    """

    def __init__(self, survey: Survey, tiles: list[Tile], box: Floats, xyz: Floats) -> None:
        self.tiles, self.box = tiles, box
        super().__init__(xyz, survey.frame.crs, str(survey.folder))


def cut_out(survey: Survey, box: Floats) -> CutOut:
    """Read the points of a survey within a box.

    Args:
        survey: the survey.
        box: (2, 2) lowest and highest x and y, in units of its CRS.

    Raises:
        InputError: if there are none, too many, or a tile cannot be read, is gone, or has changed since the
            survey was built.

    """
    tiles = survey.tiles_in(box)
    chunks: list[Floats] = []
    held = 0
    for tile in tiles:
        if not tile.unchanged():
            if tile.path.exists():
                raise InputError(
                    f"the tile {tile.path} has changed since the survey {survey.folder} was built; run "
                    "survey build again"
                )
            raise InputError(
                f"the tile {tile.path} of the survey {survey.folder} is no longer there; put it back, or run "
                "survey build --prune with all tiles that the survey shall have"
            )
        for xyz, noise in _chunks(tile.path, box):
            inside = (xyz[:, :2] >= box[0]).all(axis=1) & (xyz[:, :2] <= box[1]).all(axis=1)
            chunks.append(xyz[inside & ~noise])
            held += len(chunks[-1])
            if held > MOST_POINTS:
                raise InputError(
                    f"the survey has more than {MOST_POINTS:,} points where the source lies; cut the "
                    "source into parts, or thin the tiles"
                )
    if not held:
        raise InputError(f"the tiles of the survey {survey.folder} hold no points where the source lies")
    return CutOut(survey, tiles, np.asarray(box), np.concatenate(chunks))


def _chunks(path: Path, box: Floats) -> Iterator[tuple[Floats, Mask]]:
    """Yield the points of a tile that may lie in a box, and which of them are noise."""
    cloud = open_any(path)
    if isinstance(cloud, LasCloud) and path.name.lower().endswith(".copc.laz"):
        import laspy

        from mtpcr_geo.core.cloud import noise_of

        with laspy.CopcReader.open(str(path)) as reader:
            found = reader.query(laspy.copc.Bounds(mins=box[0], maxs=box[1]))
            for start in range(0, len(found), CHUNK_POINTS):
                some = found[start : start + CHUNK_POINTS]
                noise = noise_of(np.asarray(some.classification), np.asarray(some.withheld))
                yield np.asarray(some.xyz, np.float64), noise
        return
    yield from cloud.noise_chunks()
