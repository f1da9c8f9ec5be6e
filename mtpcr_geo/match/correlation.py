"""The default matcher: a global search by correlation, judged at fine cells, then local patch matches.

The search works coarse to fine. A level proposes hypotheses, from height and step edges and from the terrain;
each is followed down to the finest cells and judged there, in one common way, before any is dropped. Where
the best stands clearly above the next distinct one and its patches agree with each other, the search ends;
else the next finer level is searched. The same search of the mirrored source, which has no right pose, tells
what chance and self-similarity score on this pair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import opencv_in_one_thread
from mtpcr_geo.core.types import Bev, Matches
from mtpcr_geo.match.exploration import (
    CLEAR_LEAD,
    CONVINCING_NULL_RATIO,
    MIRRORED_HYPOTHESES,
    CorrelationSettings,
    Exploration,
    steps_of,
)
from mtpcr_geo.match.pose import centre_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.pyramid import search_factors
from mtpcr_geo.match.reasons import nothing_to_compare
from mtpcr_geo.method.scales import scales_of

__all__ = ["CorrelationSettings", "exchanged", "match", "mirror"]

DEFAULTS = CorrelationSettings()


def match(
    source: Bev,
    target: Bev,
    settings: CorrelationSettings = DEFAULTS,
    seed: int = 0,
    advance: Callable[[int], object] = lambda n: None,
    prior: Prior | None = None,
) -> Matches:
    """Match two height rasters of unknown relative yaw and shift.

    Where nothing is known of the pose it is the raster of fewer filled cells that is turned and moved,
    whichever is the source: source and target exchanged give the inverse.

    Args:
        source, target: rasters of one cell size, in levelled coordinates.
        settings: what governs the search.
        seed: of the sampling when patches vote.
        advance: called with 1 after each yaw searched.
        prior: what is known of the pose; None to search everywhere.

    Returns:
        Local matches under the best hypothesis (possibly few), and all hypotheses, best first.

    Raises:
        RegistrationError: if the rasters are too small or too empty to overlap enough.

    """
    if prior is None and (source.count > 0).sum() > (target.count > 0).sum():
        return exchanged(match(target, source, settings, seed, advance))
    with opencv_in_one_thread():
        return _match(source, target, settings, seed, advance, prior)


def _match(
    source: Bev,
    target: Bev,
    settings: CorrelationSettings,
    seed: int,
    advance: Callable[[int], object],
    prior: Prior | None,
) -> Matches:
    scales = scales_of(source, target)
    search = Exploration(source, target, scales, settings, seed, advance, prior)
    twin = None
    if settings.mirrored_null:
        null = None if prior is None else prior.mirrored()
        mirrored = mirror(source)
        twin = Exploration(
            mirrored, target, scales, settings, seed, advance, null, search, MIRRORED_HYPOTHESES
        )
    proposals = settings.proposals is not None and prior is None
    for step in steps_of(search_factors(source, target), proposals):
        if not search.explore(step):
            continue
        settled = search.settles()
        if settled and (twin is None or search.asked_terrain):
            break
        if twin is None:
            continue
        if settled or (search.asked_terrain and search.promises()):
            twin.catch_up(search)
            if search.pool.over(twin.pool) >= CONVINCING_NULL_RATIO:
                break
        elif search.leads():
            twin.catch_up(search)
            if search.pool.over(twin.pool) >= CLEAR_LEAD:
                break
    pool = search.pool
    if not pool.candidates:
        raise RegistrationError(nothing_to_compare(source, target, search.fewest(1), prior is not None))
    null_ratio = None
    if twin is not None:
        twin.catch_up(search)
        null_ratio = search.pool.over(twin.pool)
    best = pool.candidates[0]
    patches = search.judge.tie_points(best)
    pivot = centre_of(source.grid)
    radius = search.judge.radius_cells * source.grid.cell - source.grid.cell / 2
    report = {
        "cell_m": source.grid.cell,
        "extent_m": scales.extent_m,
        "patch_m": scales.patch_m if settings.patch_m is None else settings.patch_m,
        "search_radius_m": radius,
        "searched": [{"cell_m": level.cell_m, "scores": list(level.scores)} for level in search.levels],
        "margin": pool.margin,
        "support": best.support,
        "neg_log10_p": best.neg_log10_p,
        "support_next": max((c.support for c in pool.candidates[1:]), default=0.0),
        "patches": patches.patches,
        "scores": [round(c.pose.score, 3) for c in pool.candidates],
        "strengths": [round(strength, 3) for strength in pool.strengths],
        "ground_spread_m": [
            round(c.ground.spread_m, 3) if c.ground is not None and c.ground.known else None
            for c in pool.candidates
        ],
        "mirrored_strengths": None if twin is None else [round(c.strength, 3) for c in twin.pool.candidates],
        "null_ratio": null_ratio,
        "self_likeness": search.likeness,
        "by_proposals": search.proposed,
    }
    return Matches(
        source_px=patches.source_px,
        target_px=patches.target_px,
        score=np.clip(patches.score, 0.0, 1.0),
        hypotheses=tuple(
            replace(c.pose.hypothesis(pivot), strength=strength)
            for c, strength in zip(pool.candidates, pool.strengths, strict=True)
        ),
        search_radius_m=radius,
        margin=pool.margin,
        support=best.support,
        null_ratio=null_ratio,
        strength=best.strength,
        mirrored_strengths=None if twin is None else tuple(c.strength for c in twin.pool.candidates),
        repeats=search.repeats(),
        report=report,
    )


def exchanged(matches: Matches) -> Matches:
    """Return the matches of the target to the source as those of the source to the target."""
    hypotheses = []
    for one in matches.hypotheses:
        c, s = np.cos(one.yaw), np.sin(one.yaw)
        east, north = one.shift
        back = (float(-(c * east + s * north)), float(s * east - c * north))
        hypotheses.append(replace(one, yaw=-one.yaw, shift=back))
    return replace(
        matches,
        source_px=matches.target_px,
        target_px=matches.source_px,
        hypotheses=tuple(hypotheses),
    )


def mirror(bev: Bev) -> Bev:
    """Reflect a raster east to west (x to -x): a scene of the same texture that has no right pose."""
    grid = bev.grid
    reflected = Grid(-(grid.west + grid.width * grid.cell), grid.north, grid.cell, grid.width, grid.height)
    return Bev(
        reflected,
        np.ascontiguousarray(bev.top[:, ::-1]),
        np.ascontiguousarray(bev.low[:, ::-1]),
        np.ascontiguousarray(bev.count[:, ::-1]),
    )
