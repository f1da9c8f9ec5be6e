"""Whether a local cloud stands upright: where its ground lies, whichever axis is up."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mtpcr_geo.check.findings import Finding, Role
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.transforms import angle_deg
from mtpcr_geo.method.levelling import evidence_of

TILTED_DEG, ON_ITS_SIDE_DEG, ON_ITS_HEAD_DEG = 15.0, 60.0, 120.0
_TURN = {
    "x": "(x, y, z) to (-z, y, x)",
    "-x": "(x, y, z) to (z, y, -x)",
    "y": "(x, y, z) to (x, -z, y)",
    "-y": "(x, y, z) to (x, z, -y)",
    "-z": "(x, y, z) to (x, -y, -z)",
}
_AXES = {"x": "x-up", "-x": "x-down", "y": "y-up", "-y": "y-down", "-z": "z-down"}
_ITSELF = "register levels it by itself where both clouds tell enough (--level auto)"


def upright_findings(xyz: Floats, role: Role) -> Iterator[Finding]:
    """Yield where the ground of a cloud, (n, 3) metres, stands upright, lies on top, or is steep."""
    found = evidence_of(xyz)
    up = found.floor.up
    tilt = angle_deg(up, np.array([0.0, 0.0, 1.0]))
    axis = int(np.argmax(np.abs(up)))
    name = ("" if up[axis] > 0 else "-") + "xyz"[axis]
    if tilt > ON_ITS_HEAD_DEG:
        what = "its ground lies on top of everything else: is it upside down?"
    elif tilt > ON_ITS_SIDE_DEG:
        what = f"its ground stands upright: is {name} up?"
    elif tilt > TILTED_DEG:
        what = f"its ground is tilted by {tilt:.0f} degrees"
        yield Finding("note", "tilted", role, what, f"{_ITSELF}; nothing needs to be done")
        return
    else:
        return
    code = "upside-down" if tilt > ON_ITS_HEAD_DEG else "lies-on-its-side"
    fix = (
        f"give --{role}-axes {_AXES[name]}, which takes {_TURN[name]}; {_ITSELF}"
        if name in _TURN
        else _ITSELF
    )
    yield Finding("warning", code, role, what, fix)
