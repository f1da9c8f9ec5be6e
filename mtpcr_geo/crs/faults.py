"""What PROJ finds wrong with a CRS only when it is to work with it, as an error of this package."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

from mtpcr_geo.core.errors import CrsError

_LONGEST = 200


@contextmanager
def crs_errors() -> Iterator[None]:
    """Turn what pyproj raises of a CRS that it has read, and cannot work with, into a CrsError.

    PROJ reads parameters that make no sense, such as a latitude of 1000 degrees, and refuses them when an
    operation is made of them. Where it exports such a CRS as JSON, that may be none, and where it looks for
    operations, pyproj may look behind the end of an empty list. Serves as a decorator too.

    Raises:
        CrsError: with the first line of what PROJ says.

    """
    from pyproj.exceptions import ProjError

    try:
        yield
    except (ProjError, json.JSONDecodeError, IndexError, UnicodeError) as error:
        said = (str(error).strip().splitlines() or [type(error).__name__])[0]
        # PROJ's own words stand at the end, behind the whole WKT
        said = said if len(said) <= _LONGEST else f"...{said[-_LONGEST:]}"
        raise CrsError(
            f"PROJ cannot work with the coordinate reference system ({said}); name it by its EPSG code"
        ) from error
