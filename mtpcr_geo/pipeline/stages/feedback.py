"""The refinement fed back once, where tie points and surfaces contradict each other: match and solve again.

Tie points matched under a wrong vertical agree with a wrong transform. Where a vertical is not known and ICP,
following the surfaces alone, tilts the source, those tie points cannot judge that; the ones found under the
new vertical can. And where cells are hardly filled, what matches may be the pattern of the points and not
what they lie on: tie points then agree a cell or two beside the truth, and those of coarser cells do not.
Where hardly any tie point agrees, the pose that the search had judged is refined too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.types import Bev, Levelling, Pair, Refinement, Side
from mtpcr_geo.match.registry import CorrelationMatcher
from mtpcr_geo.method.icp import Surfaces, rounds_for
from mtpcr_geo.method.inverse_mapping import tie_points_of
from mtpcr_geo.method.refine import FEW_TIE_POINTS, RefineSettings, target_moves
from mtpcr_geo.method.scales import tolerance_for
from mtpcr_geo.method.solve import solve_tie_points
from mtpcr_geo.method.upright import points_near
from mtpcr_geo.pipeline.stages.priors import prior_of
from mtpcr_geo.pipeline.stages.refining import refined_pair
from mtpcr_geo.pipeline.stages.views import shown, view_of
from mtpcr_geo.verdict.evidence import moved_in_plan, tie_points_agreeing

LEAST_TILT_DEG = 0.3
"""Tilt left between the levelled clouds from which on a new vertical is worth a second search."""
MOST_TILT_DEG = 30.0
COARSER = 1.5
"""Times the cell at which clouds are matched again where surfaces and tie points contradict each other: its
cells hold twice as many points, and small plots still have cells enough."""
SURE = 1.3
"""Strength over the next hypothesis, and over the mirrored source's best, below which the pose itself is in
doubt, and no second search about a cell or two is worth its time."""
BETTER = 0.95
"""Share of the surfaces' residual that is left at most under a place that neither the first tie points nor
the surfaces by themselves had led to."""
WEAKEST, CLOSER = 0.5, 0.8
"""Share of the first matches' strength that those under a new vertical have at least, and of the surfaces'
residual that is left at most where they are weaker: of a right one under 0.5 is left."""


def levelled_by(pair: Pair, T_target_source: Floats) -> Levelling:
    """Return the levelling of the source under which a transform is a yaw and a shift alone.

    Args:
        pair: levelled; the target's vertical is kept.
        T_target_source: 4x4 between work coordinates.

    """
    R = (pair.target.T_level_work @ T_target_source)[:3, :3]
    tilt = transforms.yaw_matrix(transforms.yaw_of(R)).T @ R
    centre = transforms.centroid(pair.source.sample)
    return replace(
        pair.source.levelling,
        T_level_work=transforms.about(centre, transforms.orthonormal(tilt)),
        method="refinement",
        tilt_deg=float(np.degrees(transforms.rotation_angle(tilt))),
        why=None,
    )


def tilt_between_deg(pair: Pair, T_target_source: Floats) -> float:
    """Return the tilt that a transform leaves between the levelled clouds, degrees."""
    R = pair.levelled(T_target_source)[:3, :3]
    return float(np.degrees(transforms.rotation_angle(transforms.yaw_matrix(transforms.yaw_of(R)).T @ R)))


def fed_back(
    pair: Pair, refined: Refinement, settings: RefineSettings, rasterise: Callable[[Side, float], Bev]
) -> Pair | None:
    """Level the source by what ICP finds without regard to the tie points, and register again from there.

    Args:
        pair: solved, with matches and rasters; not both verticals are known.
        refined: what the refinement came to.
        settings: of the refinement.
        rasterise: makes the raster of a side at a cell, metres.

    Returns:
        The pair matched, solved and refined anew, or None where the vertical was right, or the second search
        does not bear out the new one.

    """
    matches, source, target = pair.matches, pair.source.bev, pair.target.bev
    if pair.T_target_source is None or matches is None or source is None or target is None:
        return None
    if settings.method is None or settings.motion != "rigid" or settings.keep_tie_points == 0:
        return None
    # what the surfaces say without regard to the tie points
    icp = refined.icp
    free = None if icp is None else icp.T if icp.followed else icp.T_surfaces
    if free is None or not LEAST_TILT_DEG <= tilt_between_deg(pair, free) <= MOST_TILT_DEG:
        return None
    side = replace(pair.source, levelling=levelled_by(pair, free), bev=None, appearance=None)
    try:
        again = pair.with_(source=replace(side, bev=rasterise(side, source.grid.cell)), refinement=None)
        again = _solved(again, pair)
        found = again.matches
        assert found is not None
        strength, before = found.strength or 0.0, matches.strength or 0.0
        if strength < WEAKEST * before:
            return None
        if matches.strength is None and (found.margin or 0.0) < min(SURE, matches.margin or 0.0):
            return None  # of matchers whose strengths are not compared the best pose must stand out as well
        refinement = refined_pair(again, settings)
    except RegistrationError:
        return None  # a second search never costs the first
    if strength < before and not borne_out(refined, refinement):
        return None
    why = "levelled, matched and solved again by the vertical that ICP had found"
    return again.with_(T_target_source=refinement.T, refinement=replace(refinement, again=why))


def matched_coarser(
    pair: Pair, refined: Refinement, settings: RefineSettings, rasterise: Callable[[Side, float], Bev]
) -> Pair | None:
    """Register again at a coarser cell where ICP went, or would go, elsewhere than the tie points.

    Either the surfaces are right, which many more points have seen, or they slid along open ground or along
    rows. Tie points found anew, on rasters whose cells hold twice as many points, decide which: only where
    they match better, and agree with the place that the surfaces chose or lead to one where these meet
    clearly better still, is it taken.

    Args:
        pair: solved, with matches and rasters.
        refined: what the refinement came to; also one that was held to the tie points.
        settings: of the refinement.
        rasterise: makes the raster of a side at a cell, metres.

    Returns:
        The pair matched, solved and refined at the coarser cell, or None where nothing contradicts the tie
        points, the search was not sure of the pose, or the coarser cell matches no better or leads elsewhere.

    """
    matches, icp = pair.matches, refined.icp
    if matches is None or matches.matcher is None or matches.matcher.needs_image:
        return None
    if icp is None or icp.T_surfaces is None or settings.motion != "rigid":
        return None
    # among rows surfaces may slide, whether that is undone or not
    slid = refined.slid_m or (moved_in_plan(pair, refined.T_before, refined.T) if matches.repeats else 0.0)
    if not icp.contested and slid <= tolerance_for(pair.cell):
        return None
    if (matches.margin or 0.0) < SURE or (matches.null_ratio is not None and matches.null_ratio < SURE):
        return None
    cell = COARSER * pair.cell
    try:
        source, target = (
            replace(side, bev=rasterise(side, cell), appearance=None) for side in (pair.source, pair.target)
        )
        again = _solved(pair.with_(source=source, target=target, refinement=None), pair)
        assert again.matches is not None
        if cell * (again.matches.strength or 0.0) <= pair.cell * (matches.strength or 0.0):
            return None  # in metres the strength is the same at any cell that is filled well
        anew = again.T_target_source
        assert pair.T_target_source is not None
        assert anew is not None
        beside = _apart_m(pair, anew, icp.T_surfaces) >= _apart_m(pair, anew, pair.T_target_source)
        if beside and not icp.contested:
            return None  # along rows both are near, and the nearer counts
        refinement = refined_pair(again, settings)
    except RegistrationError:
        return None  # a second search never costs the first
    met = refinement.icp
    if met is None or not met.followed or met.contested:
        return None
    elsewhere = _apart_m(pair, refinement.T, icp.T_surfaces) > tolerance_for(pair.cell)
    if elsewhere and (matches.repeats or not _meet_better(pair, refined.T, refinement.T, settings)):
        return None
    why = f"matched and solved again in cells of {cell:g} m: surfaces met better beside the first tie points"
    return again.with_(T_target_source=refinement.T, refinement=replace(refinement, again=why))


def refined_from_search(pair: Pair, refined: Refinement, settings: RefineSettings) -> Refinement | None:
    """Refine from the pose that the search had judged, where the tie points led elsewhere.

    The search judges a pose by all patches and by both grounds. Where few patches agree, as in woods of two
    years, those that do may agree by chance, and the transform solved from them lies metres off. Where
    `FEW_TIE_POINTS` or more agree they know better, and so they do among rows, which meet as well a row away.

    Args:
        pair: solved, with matches of a matcher that judges patches.
        refined: what the refinement of the solved transform came to.
        settings: of the refinement.

    Returns:
        The refinement from there, or None where it is the same place, the surfaces do not meet clearly
        better, or the tie points are believed.

    """
    matches, tie_points, solved = pair.matches, pair.tie_points, pair.T_target_source
    if matches is None or matches.matcher is None or matches.matcher.needs_image or not matches.hypotheses:
        return None
    if tie_points is None or solved is None or not len(tie_points):
        return None
    if matches.repeats or tie_points_agreeing(pair, solved) >= FEW_TIE_POINTS:
        return None
    if settings.method is None or settings.motion != "rigid":
        return None
    if not settings.ground or settings.keep_tie_points == 0:
        return None
    judged = matches.hypotheses[0]
    T_level = transforms.compose(transforms.yaw_matrix(judged.yaw), np.array([*judged.shift, 0.0]))
    T = transforms.inverse(pair.target.T_level_work) @ T_level @ pair.source.T_level_work
    steps = _steps(pair, T, solved)
    if float(np.hypot(steps[:, 0], steps[:, 1]).mean()) <= tolerance_for(pair.cell):
        return None
    rise = transforms.translation((0.0, 0.0, float(steps[:, 2].mean())))
    T = transforms.inverse(pair.target.T_level_work) @ rise @ T_level @ pair.source.T_level_work
    try:
        refinement = refined_pair(pair.with_(T_target_source=T), settings)
    except RegistrationError:
        return None  # a second opinion never costs the first
    both = refined.T, refinement.T
    if _apart_m(pair, *both) <= tolerance_for(pair.cell):
        return None  # both led to one place
    if not all(_meet_better(pair, *both, settings, about=about) for about in both):
        return None
    why = "refined from the pose of the search: surfaces met better there than where the tie points led"
    return replace(refinement, again=why, T_solved=solved)


def _meet_better(
    pair: Pair, before: Floats, after: Floats, settings: RefineSettings, about: Floats | None = None
) -> bool:
    """Return whether the same surfaces, those of the overlap before or about another, meet clearly better."""
    first, later = _met(pair, before if about is None else about, (before, after), settings)
    return later <= BETTER * first


def _met(pair: Pair, about: Floats, those: Sequence[Floats], settings: RefineSettings) -> list[float]:
    """Return how far surfaces, those of the overlap under one transform, are from meeting under others.

    NaN where there are none.
    """
    distance = max(max(one.max_correspondence_distances_m) for one in rounds_for(pair.cell).values())
    clouds = points_near(pair.source), points_near(pair.target)
    if target_moves(*clouds):
        # the smaller cloud moves, as in the refinement, so that source and target exchanged say the same
        clouds, about, those = clouds[::-1], transforms.inverse(about), [*map(transforms.inverse, those)]
    try:
        surfaces = Surfaces(
            *clouds,
            about,
            voxel_m=settings.voxel_m,
            max_correspondence_distance_m=distance,
            max_points=settings.max_points,
        )
    except RegistrationError:
        return [np.nan] * len(those)
    return [surfaces.surface_residual(T) for T in those]


def _apart_m(pair: Pair, A: Floats, B: Floats) -> float:
    """Return how far two transforms put the tie points from each other, the mean in metres."""
    return float(np.linalg.norm(_steps(pair, A, B), axis=1).mean())


def _steps(pair: Pair, A: Floats, B: Floats) -> Floats:
    """Return the steps from where one transform puts the tie points to where another does.

    Args:
        pair: with tie points.
        A, B: 4x4 from source to target work coordinates.

    Returns:
        (2 n, 3) metres in the levelled target's axes: of the n source ends, and of the n target ends brought
        back and forth, so that source and target exchanged give steps of the same lengths.

    """
    assert pair.tie_points is not None
    source, target = (
        transforms.apply(transforms.inverse(side.T_level_work), ends)
        for side, ends in ((pair.source, pair.tie_points.source), (pair.target, pair.tie_points.target))
    )
    steps = [
        transforms.apply(B, ends) - transforms.apply(A, ends)
        for ends in (source, transforms.apply(transforms.inverse(A), target))
    ]
    return np.concatenate(steps) @ pair.target.T_level_work[:3, :3].T


def borne_out(before: Refinement, after: Refinement) -> bool:
    """Return whether surfaces and tie points, in contradiction before, meet under a new vertical.

    Seen from above a scene that leans by some degrees looks much the same: the matches of the right vertical
    may be a little weaker than those of a wrong one.
    """
    if before.icp is None or after.icp is None:
        return False
    if not (before.icp.lost_tie_points or before.icp.left_tie_points):
        return False
    first, last = (one.tried[one.chosen].surface_residual for one in (before.icp, after.icp))
    contradicted = after.icp.lost_tie_points or after.icp.left_tie_points
    return after.icp.followed and not contradicted and last <= CLOSER * first


def _solved(again: Pair, before: Pair) -> Pair:
    """Match and solve with the matcher and the settings of the first time.

    Raises:
        RegistrationError: if there is nothing to match, or too few tie points agree.

    """
    first, solution = before.matches, before.solution
    assert first is not None
    assert solution is not None
    matcher = first.matcher
    if again.known is not None and isinstance(matcher, CorrelationMatcher):
        # place and yaw known beforehand are others between clouds levelled otherwise
        matcher = replace(matcher, prior=prior_of(again.known, again))
    if matcher.needs_image:
        again = again.with_(source=shown(again.source), target=shown(again.target))
    views = [view_of(side, matcher.needs_image) for side in (again.source, again.target)]
    found = matcher.match(*views, seed=solution.settings.seed)
    kept = {name: first.report[name] for name in ("second_opinion",) if name in first.report}
    matches = replace(found, matcher=matcher, report={**found.report, **kept})
    assert again.source.bev is not None
    assert again.target.bev is not None
    tie_points = tie_points_of(matches, again.source.bev, again.target.bev, seed=solution.settings.seed)
    solved, inlier = solve_tie_points(tie_points, 1.5 * tolerance_for(again.cell), solution.settings)
    T = transforms.inverse(again.target.T_level_work) @ solved.T @ again.source.T_level_work
    return again.with_(
        matches=matches,
        tie_points=replace(tie_points, inlier=inlier),
        T_target_source=T,
        solution=solved,
    )
