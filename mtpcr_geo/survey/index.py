"""What a survey is made of: its cells, and its tiles as a virtual point cloud (VPC), a STAC collection."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import InputError, OutputError
from mtpcr_geo.core.paths import read_whole, real, short
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.survey import SURVEY
from mtpcr_geo.survey.mosaic import FACTORS, Frame, Mosaic, Place

if TYPE_CHECKING:
    from mtpcr_geo.core.cloud import Cloud

INDEX = "index.vpc"
_FORMAT, _VERSION = "mtpcr-geo survey", 1
_LONGEST_M = 1e6
_OWN = "mtpcr:"

Dimension = tuple[str, str, int]
"""Name, type (floating, signed or unsigned) and bytes of a dimension of points, as PDAL has them."""
PLACE: tuple[Dimension, ...] = tuple((axis, "floating", 8) for axis in "XYZ")
_TYPES = {"f": "floating", "i": "signed", "u": "unsigned", "b": "unsigned"}


@dataclass(frozen=True)
class Tile:
    """A file of a survey, as it stood when it was rasterised.

    Attributes:
        path: the file, absolute.
        size: bytes.
        modified_ns: time of its last change, nanoseconds.
        points: in the file.
        used: points in the mosaic: all but noise, withheld ones and marks of no return.
        bounds: least and greatest coordinates of these in the survey's CRS, (x, y, z, x, y, z); six zeros
            where there are none.
        blocks: the blocks that it reaches.
        date: day on which the file was made, by its header, as YYYY-MM-DD; None where it says none.
        dimensions: of its points; those of the place alone where the format or an earlier build did not tell.

    """

    path: Path
    size: int
    modified_ns: int
    points: int = 0
    used: int = 0
    bounds: tuple[float, ...] = (0.0,) * 6
    blocks: tuple[Place, ...] = ()
    date: str | None = None
    dimensions: tuple[Dimension, ...] = PLACE

    @classmethod
    def at(cls, path: Path) -> Tile:
        """Look at a file, without reading it.

        Raises:
            InputError: if it is not there.

        """
        path = real(path)
        try:
            state = path.stat()
        except OSError as error:
            raise InputError(f"cannot read the tile {path}: {error.strerror}") from error
        return cls(path, state.st_size, state.st_mtime_ns)

    @property
    def id(self) -> str:
        """A name that no other file has."""
        return f"{self.path.stem}-{sha256(os.fsencode(self.path)).hexdigest()[:10]}"

    @property
    def state(self) -> str:
        """What changes when the file does."""
        return f"{self.id} {self.size} {self.modified_ns}"

    def unchanged(self) -> bool:
        """Return whether the file is as it was."""
        try:
            now = Tile.at(self.path)
        except InputError:
            return False
        return now.state == self.state

    def touches(self, bounds: Floats) -> bool:
        """Return whether its points' bounds meet others in plan, (2, 2) in units of the CRS."""
        if not self.used:
            return False
        low, high = np.array(self.bounds[:2]), np.array(self.bounds[3:5])
        return bool((low <= bounds[1]).all() and (high >= bounds[0]).all())


@dataclass(frozen=True)
class Survey:
    """A survey in a folder.

    Attributes:
        folder: where it is.
        frame: its cells and CRS.
        tiles: its files, in the order of their names.

    """

    folder: Path
    frame: Frame
    tiles: tuple[Tile, ...] = ()

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Survey:
        """Open a survey.

        Raises:
            InputError: if there is none, or it is damaged.

        """
        folder = Path(folder)
        frame = read_frame(folder)
        try:
            features = json.loads(read_whole(folder / INDEX))["features"]
            tiles = tuple(_tile_of(one, folder) for one in features)
        except FileNotFoundError as error:
            raise InputError(
                f"the survey {folder} was not built to its end: it has no {INDEX}; run survey build again"
            ) from error
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise InputError(
                f"the index of the survey {folder} is damaged ({type(error).__name__}: {error}); remove "
                f"{INDEX}, and run survey build with all tiles"
            ) from error
        return cls(folder, frame, tiles)

    @property
    def mosaic(self) -> Mosaic:
        """Its height rasters."""
        return Mosaic(self.folder, self.frame)

    @property
    def bounds(self) -> Floats:
        """(2, 3) least and greatest coordinates of all tiles, in units of the CRS.

        Raises:
            InputError: if no tile holds points.

        """
        held = np.array([tile.bounds for tile in self.tiles if tile.used]).reshape(-1, 2, 3)
        if not len(held):
            raise InputError(f"the survey {self.folder} holds no points; build it from other tiles")
        return np.stack([held[:, 0].min(axis=0), held[:, 1].max(axis=0)])

    def blocks(self) -> dict[Place, list[Tile]]:
        """Return the tiles that reach each block, both in order."""
        found: dict[Place, list[Tile]] = {}
        for tile in self.tiles:
            for place in tile.blocks:
                found.setdefault(place, []).append(tile)
        return {place: sorted(found[place], key=lambda tile: tile.id) for place in sorted(found)}

    def tiles_in(self, bounds: Floats) -> list[Tile]:
        """Return the tiles whose points' bounds meet others in plan, (2, 2) in units of the CRS."""
        return [tile for tile in self.tiles if tile.touches(bounds)]

    def write_index(self) -> None:
        """Write the tiles as a virtual point cloud, whole or not at all."""
        ordered = replace(self, tiles=tuple(sorted(self.tiles, key=lambda tile: (tile.path.name, tile.id))))
        features = [_feature_of(tile, ordered) for tile in ordered.tiles]
        # a line a tile: an index of a country is read whole
        lines = ",\n".join(json.dumps(one, separators=(",", ":")) for one in features)
        write_atomic(self.folder / INDEX, f'{{"type":"FeatureCollection","features":[\n{lines}\n]}}\n')

    def with_tiles(self, tiles: Iterable[Tile]) -> Survey:
        """Return the survey with other tiles."""
        return replace(self, tiles=tuple(sorted(tiles, key=lambda tile: (tile.path.name, tile.id))))


def read_frame(folder: Path) -> Frame:
    """Return the cells and the CRS of a survey.

    Raises:
        InputError: if there is none, or it is damaged.

    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        data = json.loads(read_whole(folder / SURVEY))
        if data["format"] != _FORMAT or data["version"] != _VERSION:
            raise ValueError(f"it is of format {data['format']} {data['version']}")
        lengths = [float(data[name]) for name in ("cell_m", "unit_m", "height_unit_m")]
        if not all(0 < length < _LONGEST_M for length in lengths):
            raise ValueError(f"its cell and units are {lengths} m")
        frame = Frame(str(data["crs_wkt"]), *lengths)
        if not frame.crs.is_projected:
            raise ValueError(f"{frame.crs.name} is no projected CRS")
        # a CRS may be read and yet be none that PROJ works with
        Transformer.from_crs(frame.crs, "EPSG:4326")
        return frame
    except FileNotFoundError as error:
        raise InputError(f"{folder} is no survey: it has no {SURVEY}; make one by survey build") from error
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, ProjError) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"{folder / SURVEY} cannot be used ({short(why)}); build the survey anew in another folder"
        ) from error


def write_frame(folder: Path, frame: Frame) -> None:
    """Write the cells and the CRS of a survey."""
    data = {
        "format": _FORMAT,
        "version": _VERSION,
        "cell_m": frame.cell_m,
        "factors": list(FACTORS),
        "unit_m": frame.unit_m,
        "height_unit_m": frame.height_unit_m,
        "crs_wkt": frame.wkt,
    }
    write_atomic(folder / SURVEY, json.dumps(data, indent=1))


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file, whole or not at all; one that holds the same already is left alone.

    Raises:
        OutputError: if it cannot be written.

    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    part = path.with_name(f".{path.name}.part-{os.getpid()}")
    try:
        if path.is_file() and path.read_bytes() == data:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def date_of(cloud: Cloud) -> str | None:
    """Return the day on which a file was made, by its header; None where it says none."""
    found = getattr(getattr(cloud, "header", None), "creation_date", None)
    return None if found is None else found.isoformat()


def dimensions_of(cloud: Cloud) -> tuple[Dimension, ...]:
    """Return the dimensions of the points of a LAS file; those of the place alone for other formats."""
    if not isinstance(cloud, LasCloud):
        return PLACE  # some are read whole before their first point is known
    table = next(iter(cloud.table_chunks(1)), None)
    found: list[Dimension] = []
    for name, values in (table or {}).items():
        # PDAL numbers the members of an array
        each = range(values.shape[1]) if values.ndim > 1 else ("",)
        found += [(f"{name}{one}", _TYPES[values.dtype.kind], values.dtype.itemsize) for one in each]
    return tuple(found) or PLACE


def _feature_of(tile: Tile, survey: Survey) -> dict[str, Any]:
    from pyproj import Transformer

    low, high = tile.bounds[:2], tile.bounds[3:5]
    ring = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]]
    to_degrees = Transformer.from_crs(survey.frame.crs, "EPSG:4326", always_xy=True)
    corners = [[round(value, 9) for value in to_degrees.transform(x, y)] for x, y in ring]
    box = [min(c[0] for c in corners), min(c[1] for c in corners), max(c[0] for c in corners),
           max(c[1] for c in corners)]  # fmt: skip
    # QGIS and pdal_wrench take a path for relative where it begins so, and in no other case
    href = f"./{Path(os.path.relpath(tile.path, real(survey.folder))).as_posix()}"
    schemas = [{"name": name, "type": kind, "size": size} for name, kind, size in tile.dimensions]
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": [
            "https://stac-extensions.github.io/pointcloud/v1.0.0/schema.json",
            "https://stac-extensions.github.io/projection/v1.1.0/schema.json",
        ],
        "id": tile.id,
        "geometry": {"type": "Polygon", "coordinates": [corners]},
        "bbox": box,
        "properties": {
            # where the header says none nothing true is known: STAC would have a range of time for it, and
            # the file's last change is no more than one end of that
            "datetime": None if tile.date is None else f"{tile.date}T00:00:00Z",
            "pc:count": tile.points,
            "pc:type": "lidar",
            "pc:encoding": tile.path.suffix.lstrip(".").lower(),
            "pc:schemas": schemas,
            "proj:wkt2": survey.frame.wkt,
            "proj:geometry": {"type": "Polygon", "coordinates": [ring]},
            "proj:bbox": list(tile.bounds),
            f"{_OWN}size": tile.size,
            f"{_OWN}modified_ns": tile.modified_ns,
            f"{_OWN}points_used": tile.used,
            f"{_OWN}blocks": [list(place) for place in tile.blocks],
        },
        "links": [],
        "assets": {"data": {"href": href, "roles": ["data"]}},
    }


def _dimensions_in(schemas: Iterable[Mapping[str, Any]]) -> tuple[Dimension, ...]:
    """Return dimensions as an index says them; those of the place, where it says none."""
    found = tuple((str(one["name"]), str(one["type"]), int(one["size"])) for one in schemas)
    return found or PLACE


def _tile_of(feature: dict[str, Any], folder: Path) -> Tile:
    about = feature["properties"]
    date = about["datetime"]
    return Tile(
        real(folder / feature["assets"]["data"]["href"]),
        int(about[f"{_OWN}size"]),
        int(about[f"{_OWN}modified_ns"]),
        int(about["pc:count"]),
        int(about[f"{_OWN}points_used"]),
        tuple(float(value) for value in about["proj:bbox"]),
        tuple((int(c), int(r)) for c, r in about[f"{_OWN}blocks"]),
        None if date is None else str(date)[:10],
        _dimensions_in(about.get("pc:schemas", ())),
    )
