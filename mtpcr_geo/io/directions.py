"""Vectors that points carry, normals and directions of waveforms: they are turned with the points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.crs.chain import Motion

_NORMALS = (("normalx", "normaly", "normalz"), ("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
_WAVES = ("x_t", "y_t", "z_t")
"""Along the beam of a waveform, in units of the coordinates a picosecond."""


def turned_columns(
    columns: Mapping[str, Any] | NDArray[Any], move: Callable[[Floats], Floats] | None
) -> dict[str, NDArray[np.generic]]:
    """Return the columns of vectors as they are after a move of the points.

    Normals (NormalX, normal_x, nx and the like, in any case) are turned and keep their length; directions of
    waveforms (x_t, y_t, z_t) change their units too. Vectors of whole numbers are left as they are.

    Args:
        columns: a table by names, or a structured array.
        move: of the points; only a `Motion` tells how directions turn.

    Returns:
        The columns that change, by their names in `columns`, each of the type it has there.

    """
    if not isinstance(move, Motion):
        return {}
    names = (columns.dtype.names or ()) if isinstance(columns, np.ndarray) else tuple(columns)
    by_lower = {name.lower(): name for name in names}
    found: dict[str, NDArray[np.generic]] = {}
    for triple in (*_NORMALS, _WAVES):
        own = [by_lower[name] for name in triple if name in by_lower]
        vectors = [np.asarray(columns[name]) for name in own]
        if len(own) < 3 or any(one.dtype.kind != "f" or one.ndim != 1 for one in vectors):
            continue
        turn = move.linear if triple == _WAVES else move.rotation
        # values of a broken file may be of any size
        with np.errstate(over="ignore", invalid="ignore"):
            turned = np.column_stack(vectors).astype(np.float64) @ turn.T
            found |= {
                name: turned[:, i].astype(one.dtype)
                for i, (name, one) in enumerate(zip(own, vectors, strict=True))
            }
    return found
