"""Where the overlap lies in each view of a recording: what the first camera looks at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.export import drawing

_MOST_POINTS = 50_000
_CELLS = 48
_LEAST_M = 2.0


@dataclass(frozen=True, eq=False)
class Look:
    """A region that a view shows in its middle.

    Attributes:
        middle: (3,) metres, or (2,) pixels.
        size: its diameter, in the same unit.
        sides: of the box around it, where it is made of several; else None.

    """

    middle: Floats
    size: float
    sides: Floats | None = None

    @property
    def box(self) -> Floats:
        """Corners of the box around it, (2, d)."""
        return np.stack([self.middle - self.size / 2.0, self.middle + self.size / 2.0])


def overlap_of(pair: Pair) -> Floats | None:
    """Return the (2, 3) box of the ground that both clouds cover, in the target's work coordinates, metres.

    Of the cells that both fill, the outermost 2 % do not count. None without a transform, or where the two
    clouds lie apart.
    """
    T = pair.T_target_source
    if T is None or len(pair.source.sample) == 0 or len(pair.target.sample) == 0:
        return None
    placed, target = transforms.apply(T, pair.source.sample), pair.target.sample
    of_placed, of_target = transforms.bounds(placed[:, :2]), transforms.bounds(target[:, :2])
    low, high = np.maximum(of_placed[0], of_target[0]), np.minimum(of_placed[1], of_target[1])
    if np.any(high <= low):
        return None
    cell = max(float((high - low).max()) / _CELLS, 1e-3)
    inside = [_within(xyz, low, high) for xyz in (placed, target)]
    columns = np.maximum(np.ceil((high - low) / cell).astype(np.int64), 1)
    filled = []
    for xyz in inside:
        place = np.minimum(((xyz[:, :2] - low) / cell).astype(np.int64), columns - 1)
        cells = np.zeros(columns, bool)
        cells[place[:, 0], place[:, 1]] = True
        filled.append(cells)
    shared = filled[0] & filled[1]
    if not shared.any():
        return None
    centres = low + (np.argwhere(shared) + 0.5) * cell
    bottom, top = np.percentile(inside[1][:, 2], [2.0, 98.0])
    west, south = np.percentile(centres, 2.0, axis=0) - cell / 2.0
    east, north = np.percentile(centres, 98.0, axis=0) + cell / 2.0
    return np.array([[west, south, bottom], [east, north, top]])


def overlap_boxes(pair: Pair) -> dict[str, Floats]:
    """Return a (2, 3) box that holds the overlap, in work coordinates of each side, metres, by role."""
    box = overlap_of(pair)
    if box is None or pair.T_target_source is None:
        return {}
    return {"target": box, "source": _moved(transforms.inverse(pair.T_target_source), box).box}


def looks_of(pair: Pair, images: Mapping[str, tuple[int, int]]) -> dict[str, Look]:
    """Return what each view shows in its middle, by the entity at which it begins.

    Args:
        pair: the last state of the run.
        images: (width, height) in pixels of what was recorded as pictures, by entity.

    Returns:
        nothing where there is no overlap.

    """
    box = overlap_of(pair)
    if box is None or pair.T_target_source is None:
        return {}
    to_source = transforms.inverse(pair.T_target_source)
    looks = {
        "aligned": _look(box),
        "input/target": _look(box),
        "input/source": _moved(to_source, box),
    }
    levelled = {
        "target": _moved(pair.target.T_level_work, box),
        "source": _moved(pair.source.T_level_work @ to_source, box),
    }
    looks["levelled"] = _around(list(levelled.values()))
    sides = {"source": pair.source, "target": pair.target}
    spots: dict[str, tuple[Look, Bev]] = {}
    for role, side in sides.items():
        if side.bev is not None:
            grid = side.bev.grid
            middle = grid.to_pixel(levelled[role].middle[None, :2])[0] + 0.5
            spots[role] = Look(middle, levelled[role].size / grid.cell), side.bev
    for entity, (width, height) in images.items():
        of_one = [name for name in sides if f"/{name}" in f"/{entity}"]
        if of_one and of_one[0] in spots:
            look, bev = spots[of_one[0]]
            looks[entity] = Look(
                look.middle * np.array([width / bev.grid.width, height / bev.grid.height]),
                look.size * width / bev.grid.width,
            )
        elif not of_one and len(spots) == 2:
            looks[entity] = _beside(spots["source"], spots["target"], width)
    return looks


def _beside(source: tuple[Look, Bev], target: tuple[Look, Bev], width: int) -> Look:
    """Return both overlaps in a picture of both rasters, the source's left."""
    side = drawing.MATCH_SIDE
    found, shapes = [], []
    for look, bev in (source, target):
        top, _, step = drawing.thinned(bev, side)
        found.append(Look(look.middle / step, look.size / step))
        shapes.append(top.shape)
    tall = max(shapes[0][0], shapes[1][0])
    starts = [(0, (tall - shapes[0][0]) // 2), (shapes[0][1] + drawing.MATCH_GAP, (tall - shapes[1][0]) // 2)]
    scale = width / (shapes[0][1] + drawing.MATCH_GAP + shapes[1][1])
    return _around(
        [
            Look((look.middle + np.array(start)) * scale, look.size * scale)
            for look, start in zip(found, starts, strict=True)
        ]
    )


def _within(xyz: Floats, low: Floats, high: Floats) -> Floats:
    inside = xyz[np.all((xyz[:, :2] >= low) & (xyz[:, :2] <= high), axis=1)]
    return inside[:: max(1, len(inside) // _MOST_POINTS)]


def _look(box: Floats) -> Look:
    return Look(box.mean(axis=0), max(float(np.linalg.norm(box[1, :2] - box[0, :2])), _LEAST_M))


def _moved(T: Floats, box: Floats) -> Look:
    """Return the region of a box that is moved; its size in plan stays."""
    look = _look(box)
    return Look(transforms.apply(T, look.middle[None])[0], look.size)


def _around(looks: list[Look]) -> Look:
    """Return the region that holds several."""
    boxes = np.array([look.box for look in looks])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    middle = (low + high) / 2.0
    size = max(float(np.max((high - low)[:2])), max(look.size for look in looks))
    return Look(middle, size, high - low)
