"""The default matcher: a global search by correlation, judged at fine cells, then local patch matches.

The search works coarse to fine. A level proposes hypotheses, from height and step edges and from the terrain;
each is followed down to the finest cells and judged there, in one common way, before any is dropped. Where
the best stands clearly above the next distinct one and its patches agree with each other, the search ends;
else the next finer level is searched. The same search of the mirrored source, which has no right pose, tells
what chance and self-similarity score on this pair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.system import opencv_in_one_thread, usable_cores
from mtpcr_geo.core.types import Bev, Matches
from mtpcr_geo.match.exploration import (
    CLEAR_LEAD,
    CONVINCING_NULL_RATIO,
    MIRRORED_HYPOTHESES,
    CorrelationSettings,
    Exploration,
    Step,
    proposing,
    steps_of,
)
from mtpcr_geo.match.pose import centre_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.pyramid import search_factors
from mtpcr_geo.match.reasons import nothing_to_compare
from mtpcr_geo.method.ground import bare
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
    *,
    provisional: bool = False,
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
        provisional: of a search that does not settle, leave to `Matches.search_further` what is dear and
            tells nothing of which of several verticals is right: the network's proposals, and the mirrored
            source where the best pose does not stand out.

    Returns:
        Local matches under the best hypothesis (possibly few), and all hypotheses, best first.

    Raises:
        RegistrationError: if the rasters are too small or too empty to overlap enough.

    """
    if prior is None and (source.count > 0).sum() > (target.count > 0).sum():
        return exchanged(match(target, source, settings, seed, advance, provisional=provisional))
    with opencv_in_one_thread():
        search = _Search(source, target, settings, seed, advance, prior)
        search.search()
        if not provisional:
            search.propose()
        return search.matches(provisional=provisional)


class _Search:
    """The search of a source and, as far as that tells something, of its mirror image."""

    def __init__(
        self,
        source: Bev,
        target: Bev,
        settings: CorrelationSettings,
        seed: int,
        advance: Callable[[int], object],
        prior: Prior | None,
    ) -> None:
        self.source, self.target, self.settings, self.prior = source, target, settings, prior
        scales = scales_of(source, target)
        mirrored = mirror(source) if settings.mirrored_null else None
        wanted = [bev for bev in (target, source, mirrored) if bev is not None]
        with ThreadPoolExecutor(usable_cores()) as threads:
            ground, *grounds = threads.map(bare, wanted)
        self.found = Exploration(
            source, target, scales, settings, seed, advance, prior, grounds=(grounds[0], ground)
        )
        self.twin: Exploration | None = None
        self.settled = False
        if mirrored is not None:
            null = None if prior is None else prior.mirrored()
            self.twin = Exploration(
                mirrored,
                target,
                scales,
                settings,
                seed,
                advance,
                null,
                self.found,
                MIRRORED_HYPOTHESES,
                (grounds[1], ground),
            )

    def search(self) -> None:
        """Search level after level until it is settled."""
        self._take(steps_of(search_factors(self.source, self.target)))

    def propose(self) -> None:
        """Let others propose where the search did not settle; not where a prior says where to look."""
        if self.settings.proposals is not None and self.prior is None and not self.settled:
            self._take([proposing(search_factors(self.source, self.target))])

    def _take(self, steps: Iterable[Step]) -> None:
        search, twin = self.found, self.twin
        for step in steps:
            if not search.explore(step):
                continue
            self.settled = search.settles()
            if twin is None:
                if self.settled:
                    return
                continue
            # what chance gives on this pair is asked before a pose is believed: among rows a wrong one may
            # stand out from all that was judged so far
            needed = None
            if self.settled or (search.asked_terrain and search.promises()):
                needed = CONVINCING_NULL_RATIO
            elif search.leads():
                needed = CLEAR_LEAD
            if needed is not None:
                twin.catch_up(search)
                self.settled = search.pool.over(twin.pool) >= needed
                if self.settled:
                    return
        self.settled = False

    def matches(self, *, provisional: bool = False) -> Matches:
        """Return what was found.

        Raises:
            RegistrationError: if there is nothing to compare.

        """
        search, twin, source = self.found, self.twin, self.source
        pool = search.pool
        if not pool.candidates:
            raise RegistrationError(
                nothing_to_compare(source, self.target, search.fewest(1), self.prior is not None)
            )
        left_off = provisional and not self.settled
        if left_off and pool.margin < self.settings.convincing_margin:
            twin = None
        null_ratio = None
        if twin is not None:
            twin.catch_up(search)
            null_ratio = pool.over(twin.pool)
        best = pool.candidates[0]
        patches = search.judge.tie_points(best)
        pivot = centre_of(source.grid)
        radius = search.judge.radius_cells * source.grid.cell - source.grid.cell / 2
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
            self_likeness=search.likeness,
            report=self._report(patches.patches, radius, twin, null_ratio),
            search_further=self._further if left_off else None,
        )

    def _further(self, advance: Callable[[int], object]) -> Matches:
        for one in (self.found, self.twin):
            if one is not None:
                one.advance = advance
        with opencv_in_one_thread():
            self.propose()
            return self.matches()

    def _report(
        self, patches: int, radius_m: float, twin: Exploration | None, null_ratio: float | None
    ) -> dict[str, Any]:
        search, pool, settings = self.found, self.found.pool, self.settings
        best = pool.candidates[0]
        return {
            "cell_m": self.source.grid.cell,
            "extent_m": search.scales.extent_m,
            "patch_m": search.scales.patch_m if settings.patch_m is None else settings.patch_m,
            "search_radius_m": radius_m,
            "searched": [{"cell_m": level.cell_m, "scores": list(level.scores)} for level in search.levels],
            "margin": pool.margin,
            "support": best.support,
            "neg_log10_p": best.neg_log10_p,
            "support_next": max((c.support for c in pool.candidates[1:]), default=0.0),
            "patches": patches,
            "scores": [round(c.pose.score, 3) for c in pool.candidates],
            "strengths": [round(strength, 3) for strength in pool.strengths],
            **{
                f"ground_{name}": [
                    round(getattr(c.ground, name), 3) if c.ground is not None and c.ground.known else None
                    for c in pool.candidates
                ]
                for name in ("spread_m", "relief_m", "beyond_plane_m")
            },
            "mirrored_strengths": None
            if twin is None
            else [round(c.strength, 3) for c in twin.pool.candidates],
            "null_ratio": null_ratio,
            "self_likeness": search.likeness,
            "by_proposals": search.proposed,
        }


def exchanged(matches: Matches) -> Matches:
    """Return the matches of the target to the source as those of the source to the target."""
    hypotheses = []
    for one in matches.hypotheses:
        c, s = np.cos(one.yaw), np.sin(one.yaw)
        east, north = one.shift
        back = (float(-(c * east + s * north)), float(s * east - c * north))
        hypotheses.append(replace(one, yaw=-one.yaw, shift=back))
    further = matches.search_further
    return replace(
        matches,
        search_further=None if further is None else lambda advance: exchanged(further(advance)),
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
