"""A second matcher, where the search by heights cannot be believed: the network's own tie points.

Where little is shared between the ground and the air, patches of heights agree under no pose, the right one
included. Descriptors of all places tell it still: under the right pose they say several times what they say
under any other. They are asked once the search has failed, and what they find is solved, refined and judged
as of any keypoint matcher.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError, RegistrationError
from mtpcr_geo.core.statistics import neg_log10_p
from mtpcr_geo.core.types import Bev, Matches, Pair
from mtpcr_geo.match.base import Advance
from mtpcr_geo.match.learned.proposals import COARSEST_CELL_M, LONGEST_PX
from mtpcr_geo.match.pose import centre_of, pose_of
from mtpcr_geo.match.pyramid import Pyramid
from mtpcr_geo.match.registry import Network
from mtpcr_geo.match.repetition import REPEATS, self_likeness
from mtpcr_geo.method.bev import coarsen
from mtpcr_geo.method.scales import FINEST_OF_LEARNED_M
from mtpcr_geo.pipeline.stages.views import shown, view_of
from mtpcr_geo.verdict.evidence import chance_of
from mtpcr_geo.verdict.limits import Limits

FEW_AGREE = 0.25
"""Share of the patches that agree, less two, below which they are few."""


def is_doubted(matches: Matches) -> bool:
    """Return whether matches of the search by heights cannot be accepted, whatever is made of them.

    Not where the scene repeats itself: one row looks like the next to the network too.
    """
    limits = Limits()
    if matches.repeats:
        return False
    if matches.margin is None or matches.margin < limits.margin:
        return True
    return matches.null_ratio is not None and matches.null_ratio < limits.null_ratio


def is_weak(matches: Matches) -> bool:
    """Return whether few patches agree with the best pose of the search, hardly more than by chance.

    A small site has few patches, and most of them agree: that is not significant, and no reason to doubt.
    """
    significance = matches.report.get("neg_log10_p")
    if matches.repeats or significance is None or matches.support is None:
        return False
    return significance < Limits().neg_log10_p and matches.support < FEW_AGREE


def matched_by_network(
    pair: Pair, seed: int, network: Network, advance: Advance
) -> tuple[Pair | None, float | None]:
    """Match a pair by the network in the package.

    Args:
        pair: matched by heights, with rasters of one cell.
        seed: of the matcher.
        network: which has described the rasters already, if it proposed poses to the search.
        advance: called with 1 after each orientation.

    Returns:
        The pair with rasters of cells that the network knows and matches of it, or None where its best pose
        does not stand out from the next and from the mirrored source's, the scene repeats itself under it,
        there is nothing to match, or hardly more of its matches agree than by chance where the margins of the
        search by heights are enough; and how many times stronger that pose is, None if there is none.

    """
    source, target, first = pair.source.bev, pair.target.bev, pair.matches
    assert source is not None
    assert target is not None
    assert first is not None
    cell, longest = target.grid.cell, max(*source.grid.shape, *target.grid.shape)
    factor = int(max(-(-FINEST_OF_LEARNED_M // cell), -(-longest // LONGEST_PX), 1))
    if factor * cell > COARSEST_CELL_M:
        return None, None
    sides = [
        shown(replace(side, bev=coarsen(bev, factor), appearance=None))
        for side, bev in ((pair.source, source), (pair.target, target))
    ]
    views = [view_of(side, True) for side in sides]
    try:
        found = network.matcher().match(*views, seed=seed, advance=advance)
    except (RegistrationError, InputError):
        return None, None  # a second opinion never costs the first
    limits = Limits()
    if found.margin is None or found.margin < limits.margin:
        return None, found.margin
    if not is_doubted(first) and _significance(found, views[0].bev, views[1].bev) < limits.neg_log10_p:
        return None, found.margin
    layers = Pyramid(views[0].bev, views[1].bev).at(1)
    likeness = self_likeness(*layers, pose_of(found.hypotheses[0], centre_of(layers[0].grid)))
    if likeness >= REPEATS:
        return None, found.margin
    report = {**found.report, "second_opinion": {"margin": found.margin, "taken": True}}
    matches = replace(
        found, self_likeness=likeness, matcher=network.matcher(remembering=False), report=report
    )
    return pair.with_(source=sides[0], target=sides[1], matches=matches), found.margin


def _significance(matches: Matches, source: Bev, target: Bev) -> float:
    """Return minus log10 of the probability that so many matches agree with the best pose by chance."""
    if matches.by_chance is None:
        return 0.0
    tolerance = matches.by_chance[1]
    best = matches.hypotheses[0]
    moved = source.grid.to_metres(matches.source_px) @ transforms.yaw_matrix(best.yaw)[:2, :2].T + best.shift
    gap = np.hypot(*(moved - target.grid.to_metres(matches.target_px)).T)
    return neg_log10_p(int((gap < tolerance).sum()), len(gap), chance_of(matches, tolerance) or 1.0)
