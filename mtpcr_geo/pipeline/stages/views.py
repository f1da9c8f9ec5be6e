"""What matchers see of a side: its raster, and an image of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from mtpcr_geo.core.types import Appearance, Bev, Look, Side

if TYPE_CHECKING:
    from mtpcr_geo.match.base import View


def shown(side: Side) -> Side:
    """Return the side with an image of its raster, so that what was matched is on record."""
    from mtpcr_geo.method.images import grey, image_of

    assert side.bev is not None
    known = side.appearance
    if known is not None and known.image.shape == side.bev.grid.shape:
        return side
    look = look_of(side)
    return replace(side, appearance=Appearance(look, grey(side.bev), image_of(side.bev, look)))


def view_of(side: Side, with_image: bool) -> View:
    """Return what a matcher sees of a side: its raster, and its image where one is wanted."""
    from mtpcr_geo.match.base import View
    from mtpcr_geo.method.images import empty_grey

    assert side.bev is not None
    seen = shown(side).appearance if with_image else None
    return View(side.bev) if seen is None else View(side.bev, seen.image, empty_grey(seen.look))


def view_as(bev: Bev, look: Look | None) -> View:
    """Return what a matcher sees of a raster: it, and its image of a look where one is wanted."""
    from mtpcr_geo.match.base import View
    from mtpcr_geo.method.images import empty_grey, image_of

    return View(bev) if look is None else View(bev, image_of(bev, look), empty_grey(look))


def look_of(side: Side) -> Look:
    """Return the look of a side's image, or the one that it would have."""
    # a pipeline without mtpcr.enhance shows band-passed heights
    return side.appearance.look if side.appearance is not None else "band_pass"
