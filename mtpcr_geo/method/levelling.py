"""Levelling: which way is up in a cloud that does not know.

The paper fits the ground plane by RANSAC and turns it horizontal. On a slope that plane is not level, so it
is checked against what people and nature build plumb, where that is seen, and against the floor: the sheet of
lowest points, which is found however the cloud is turned. Where the evidence does not decide, what remains
are hypotheses, most likely first, for the matching to tell apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.transforms import angle_deg
from mtpcr_geo.core.types import Levelling, LevellingMethod
from mtpcr_geo.method.floor import Floor, extent_of, floors_of
from mtpcr_geo.method.verticals import PlumbLine, ground_plane, plumb_line

Mode = Literal["auto", "ransac", "none"]

UP = np.array([0.0, 0.0, 1.0])
FEWEST_ON_PLANE = 0.2
"""Share of the points on the ground plane below which it is one field among many, and says nothing."""
FIRM_SPREAD_DEG = 1.2
"""Spread of walls and trunks up to which they decide: as a scanner on the ground sees them. Of the walls and
eaves that an airborne one sees, 1.4 to 2.1, they may be 1 to 3 degrees off where the ground is not."""
SAME_VERTICAL_DEG = 1.5
"""Verticals that are no farther apart are one: the refinement settles the rest."""
USUAL_SLOPE_DEG = 4.0
"""Slope of the ground up to which an upright cloud is likelier than a tilted one on level ground."""
WELL_TILTED_DEG = 40.0
PLAUSIBLE = 0.67
"""Quality of the floor under the vertical as given, over the best in any direction, from which on it is taken
for the ground. Turned upside down, nine real pairs had 0.1 to 0.55."""
WORTH_TRYING = 0.1
"""Quality of a floor over the best from which on it is worth trying."""
ENOUGH_POINTS = 400_000


@dataclass(frozen=True)
class Evidence:
    """What a cloud shows of its vertical.

    Attributes:
        floors: distinct floors in any direction, best first.
        floor: the one taken for the ground: about the vertical as given where that is plausible.
        upright: whether that is within 40 degrees of the vertical as given.
        plane: (3,) normal of the ground plane about it.
        plane_share: share of the points on that.
        plumb: what vertical structure says.

    """

    floors: tuple[Floor, ...]
    floor: Floor
    upright: bool
    plane: Floats
    plane_share: float
    plumb: PlumbLine


def level(xyz: Floats, mode: Mode, georeferenced: bool, seed: int = 0) -> Levelling:
    """Find the rotation that makes a cloud upright: the likeliest one, see `verticals`.

    Args:
        xyz: (n, 3) sample of the cloud, metres.
        mode: "none" keeps the cloud as it is; "ransac" turns the ground plane horizontal (the paper), for z
            within 25 degrees of up; "auto" keeps georeferenced clouds, whose vertical is known, and levels
            local ones by walls and trunks, the ground plane or the floor, where these show a tilt that
            sloping ground does not explain.
        georeferenced: whether the cloud's CRS defines its vertical.
        seed: of the random choices.

    """
    if mode == "none" or (mode == "auto" and georeferenced):
        why = "kept as it is" if mode == "none" else "the CRS defines the vertical"
        return Levelling(why=why, trusted=True)
    if mode == "ransac":
        up, share = ground_plane(xyz, UP, extent_of(xyz), np.random.default_rng(seed))
        return _levelled(
            xyz, up, Levelling(method="plane", plane_tilt_deg=_tilt_deg(up), plane_inlier_share=share)
        )
    first, *others = verticals(xyz, seed)
    return replace(first, others=tuple(others))


def verticals(xyz: Floats, seed: int = 0) -> list[Levelling]:
    """List the verticals that a cloud of unknown vertical may have, likeliest first.

    Walls and trunks decide where a scanner on the ground sees them. Else the cloud is kept as given where
    its floor slopes no more than ground usually does; then come the ground plane, if there is one, and the
    floor; at the end the floors in other directions, for clouds that lie on their side or on their head.
    Verticals closer than 1.5 degrees count once.

    Args:
        xyz: (n, 3) sample of the cloud, metres.
        seed: of the random choices.

    """
    found = evidence_of(xyz, seed)
    known = Levelling(
        plane_tilt_deg=_tilt_deg(found.plane),
        plane_inlier_share=found.plane_share,
        verticals=found.plumb.count,
        verticals_spread_deg=found.plumb.spread_deg,
        plane_to_verticals_deg=None if found.plumb.up is None else angle_deg(found.plane, found.plumb.up),
        floor_tilt_deg=_tilt_deg(found.floor.up),
        floor_share=found.floor.share,
    )
    kept: list[tuple[LevellingMethod, Floats]] = []
    for method, up in _in_order(found):
        if all(angle_deg(up, other) > SAME_VERTICAL_DEG for _, other in kept):
            kept.append((method, up))
    why = "what is seen of the ground does not slope more than ground does, and few walls or trunks are seen"
    return [
        replace(known, why=why if i == 0 else "as given")
        if method == "none"
        else _levelled(xyz, up, replace(known, method=method))
        for i, (method, up) in enumerate(kept)
    ]


def evidence_of(xyz: Floats, seed: int = 0) -> Evidence:
    """Gather what a cloud, (n, 3) metres, shows of its vertical."""
    rng = np.random.default_rng(seed)
    if len(xyz) > ENOUGH_POINTS:
        xyz = xyz[rng.choice(len(xyz), ENOUGH_POINTS, replace=False)]
    extent = extent_of(xyz)
    floors = floors_of(xyz, extent, rng)
    given = min(floors, key=lambda floor: angle_deg(floor.up, UP))
    best = floors[0]
    upright = angle_deg(given.up, UP) < WELL_TILTED_DEG and given.quality > PLAUSIBLE * best.quality
    floor = given if upright else best
    plane, share = ground_plane(xyz, floor.up, extent, rng)
    plumb = plumb_line(xyz, plane if share >= FEWEST_ON_PLANE else floor.up, extent, rng)
    return Evidence(floors, floor, upright or angle_deg(best.up, UP) < WELL_TILTED_DEG, plane, share, plumb)


def _in_order(found: Evidence) -> list[tuple[LevellingMethod, Floats]]:
    plumb, plane, floor = found.plumb, found.plane, found.floor
    clear = found.plane_share >= FEWEST_ON_PLANE
    order: list[tuple[LevellingMethod, Floats]] = []
    if plumb.up is not None and plumb.spread_deg is not None and plumb.spread_deg <= FIRM_SPREAD_DEG:
        order.append(("verticals", plumb.up))
    if _tilt_deg(plane if clear else floor.up) <= USUAL_SLOPE_DEG:
        order.append(("none", UP))
    if clear:
        order.append(("plane", plane))
    order.append(("floor", floor.up))
    if plumb.up is not None:
        order.append(("verticals", plumb.up))
    order.append(("none", UP))
    worth = WORTH_TRYING * found.floors[0].quality
    order += [("floor", other.up) for other in found.floors if other is not floor and other.quality > worth]
    return order


def _levelled(xyz: Floats, up: Floats, found: Levelling) -> Levelling:
    T = transforms.about(transforms.centroid(xyz), transforms.rotation_to_up(up))
    return replace(found, T_level_work=T, tilt_deg=_tilt_deg(up))


def _tilt_deg(up: Floats) -> float:
    return angle_deg(up, UP)
