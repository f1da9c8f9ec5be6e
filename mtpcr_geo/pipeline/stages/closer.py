"""Points about the other cloud, of clouds too large to be held: what refinement and verdict look at.

The sample of such a cloud is uniform: of a country's tile only a few of its points lie where a plot does.
Once it is known where that is, the points there are read again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.ahead import ahead
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.io.sample import BUDGET, surface_chunks
from mtpcr_geo.method.downsample import between
from mtpcr_geo.pipeline.stage import RunContext
from mtpcr_geo.pipeline.stages.rasters import in_work_frame

ENOUGH = 240_000
"""Points of a sample about the other cloud that will do: twice what ICP takes of a target."""
GAIN = 2.0
"""Times as many points that are to be there at least for them to be read."""
MARGIN_CELLS, MARGIN_SHARE = 5.0, 0.1
"""By how much the box about the other cloud is wider: cells of the rasters, and a share of its extent."""
_FILE_MARGIN = 0.02
"""Share of its extent by which a box in file coordinates is wider, where the work frame bends it."""


def with_points_near(pair: Pair, context: RunContext) -> Pair:
    """Return a pair whose sides hold denser points about each other, where their samples are sparse there.

    Args:
        pair: with a transform; without one it is returned as it is.
        context: of the run, for its progress.

    Raises:
        InputError: if a file is damaged.

    """
    if pair.T_target_source is None:
        return pair
    # what is found is held against what was known beforehand
    poses = [T for T in (pair.T_target_source, pair.T_prior) if T is not None]
    back = [transforms.inverse(T) for T in poses]
    target = _denser(pair.target, pair.source, poses, pair.cell, context)
    source = _denser(pair.source, pair.target, back, pair.cell, context)
    if target is pair.target and source is pair.source:
        return pair
    return pair.with_(target=target, source=source)


def _denser(side: Side, other: Side, poses: list[Floats], cell: float, context: RunContext) -> Side:
    """Return a side with the points about the other one, which each 4x4 brings to its work coordinates."""
    if side.complete or side.near is not None:
        return side
    boxes = np.array([transforms.bounds(transforms.apply(T, other.sample)) for T in poses])
    box = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    margin = MARGIN_CELLS * cell + MARGIN_SHARE * np.ptp(box, axis=0).max()
    box = box + [[-margin], [margin]]
    if np.array_equal(side.T_level_work, np.eye(4)):
        # a scan from the ground sees no roofs, and what it does not see tells as well
        heights = side.sample[:, 2]
        box[:, 2] = min(box[0, 2], heights.min() - margin), max(box[1, 2], heights.max() + margin)
    held = int(between(side.sample, *box).sum())
    whole = side.cloud.count - side.no_returns - side.strays
    expected = held * whole / max(len(side.sample), 1)
    if held >= ENOUGH or expected < GAIN * held:
        return side
    share = min(1.0, BUDGET / max(expected, 1.0))
    rng = np.random.default_rng(0)
    found = [
        xyz if share == 1.0 else xyz[rng.random(len(xyz)) < share] for xyz in _chunks(side, box, context)
    ]
    return replace(side, near=np.concatenate(found)) if found else side


def _chunks(side: Side, box: Floats, context: RunContext) -> Iterator[Floats]:
    """Yield the points of a side within a box, (n, 3) work coordinates."""
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    in_file = np.stack(transforms.bounds(side.link.to_file(corners)))
    around = in_file + _FILE_MARGIN * np.ptp(in_file, axis=0) * [[-1.0], [1.0]]

    def near_by() -> Iterator[tuple[int, Floats]]:
        for xyz in surface_chunks(side.cloud, places=side.no_return_places, box=side.box):
            some = xyz[between(xyz, *around)]
            work = in_work_frame(side.link, some) if len(some) else some
            yield len(xyz), work[between(work, *box)]

    with context.progress.task(f"reading {side.cloud.name} about the overlap", side.cloud.count) as advance:
        for count, work in ahead(near_by()):
            if len(work):
                yield work
            advance(count)
