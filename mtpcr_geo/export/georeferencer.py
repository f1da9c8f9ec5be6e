"""The tie points as QGIS's Georeferencer keeps them: a raster's own coordinates beside those of the map."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export.tie_points import tie_positions

_HEADER = "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"


def write_points(path: str | os.PathLike[str], pair: Pair) -> None:
    """Write the tie points for the Georeferencer, in the order of the layer ``tie_points``.

    ``sourceX, sourceY`` are coordinates of the source's raster, ``mapX, mapY`` those of the target's CRS,
    both metres; points that do not agree with the transform are there and not enabled. The Georeferencer
    reads the file by itself when it opens a raster of the same name without ``.points``.

    Raises:
        ValueError: if the pair has no tie points yet.
        OutputError: if the file cannot be written.

    """
    target, registered = tie_positions(pair)
    assert pair.tie_points is not None
    source = pair.tie_points.source[:, :2] + pair.source.link.origin[:2]
    places = target[:, :2] + pair.frame.origin[:2]
    residual = np.zeros((len(target), 2)) if registered is None else (registered - target)[:, :2]
    lines = [_HEADER]
    for xy, from_xy, enable, apart in zip(places, source, pair.tie_points.inlier, residual, strict=True):
        numbers = [*(f"{value:.4f}" for value in (*xy, *from_xy)), f"{int(enable)}"]
        numbers += [f"{value:.4f}" for value in (*apart, np.hypot(*apart))]
        lines.append(",".join(numbers))
    if pair.frame.crs is not None:
        lines.insert(0, f"#CRS: {pair.frame.crs.to_wkt()}")
    try:
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {Path(path)}: {error}") from error
