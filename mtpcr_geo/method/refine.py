"""Refinement: height settled on the ground, ICP followed where surfaces and tie points agree."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import IcpMethod, IcpResult, IcpRound, IcpTrial, Refinement
from mtpcr_geo.method.downsample import own_axes
from mtpcr_geo.method.icp import Descent, Rounds, Surfaces, rounds_for
from mtpcr_geo.method.jackknife import equations_of_surfaces
from mtpcr_geo.method.overlap import overlap_of
from mtpcr_geo.method.scales import ground_cell_for
from mtpcr_geo.method.settle import beyond_scatter, settle_on_ground

Motion = Literal["rigid", "yaw", "translation"]

FINE_SPACINGS = 4.0
"""Voxel of the last round in mean distances between points of the sparser cloud."""
FINEST_VOXEL_M = 0.2
FINE_BELOW = 0.75
"""Share of the thinning before below which a last, finer round is worth its time."""
FINE_DISTANCE_VOXELS = 2.0
FINE_SLACK = 5.0
"""Times the usual step below which the fine round stands still: its many points trade partners for ever."""
SAME_FIT = 1.02
"""Times that the surface residual may grow where the height is taken from the ground after ICP."""
BETWEEN = "between"
"""Name of the pose halfway between what ICP came to from far and from near."""
UPRIGHT = 1e-9
"""Largest entry in which the rotation of both levellings differs from none where both clouds are upright."""
CLEARLY = 1.01
"""Times that the residual after ICP must exceed a start's for the start to be taken: on bare, sparse ground
they are equal but for chance, and results would jump with it."""
FEW_TIE_POINTS, FAR_BETTER = 20, 0.7
"""Tie points below which ICP is followed though it loses them, and the share of the starts' residual that it
leaves then at most. It left 0.55 to 0.61 on four small discs, where 2 to 9 tie points agreed 2.5 to 3.8 m
off, and was right to 0.1 to 0.6 m; among rows, where it may slide by a period, 0.85 to 1.00."""
MUCH = 0.9
"""Share of the residual of a run of ICP that kept the tie points, below which another that lost them is told:
along rows of trees or panels a far run ends a period away, and fits as well there or a little better."""


@dataclass(frozen=True)
class RefineSettings:
    """How a transform is refined.

    Attributes:
        method: ICP variant; None leaves ICP out.
        voxel_m: thinning of the points, metres.
        max_correspondence_distances_m: farthest correspondence of each round, metres; if None, far and near
            rounds are tried, and what the surfaces fit best is taken.
        max_points: points of the source after thinning, about; the target may have twice as many.
        iterations: iterations of each round at most.
        motion: degrees of freedom of the result: all six, yaw and shift, or the shift alone.
        ground: settle height and tilt on the ground before ICP, and the height after it.
        keep_tie_points: share of the agreeing tie points that must still agree after ICP for it to be
            followed; 0 to follow it always. Where fewer than `FEW_TIE_POINTS` agree it is followed without
            them too, if surfaces meet far better.

    """

    method: IcpMethod | None = "gicp"
    voxel_m: float = 0.5
    max_correspondence_distances_m: tuple[float, ...] | None = None
    max_points: int = 60_000
    iterations: int = 30
    motion: Motion = "rigid"
    ground: bool = True
    keep_tie_points: float = 0.5


def refine(
    source: Floats,
    target: Floats,
    T_start: Floats,
    settings: RefineSettings = RefineSettings(),
    *,
    cell: float = 1.0,
    agreeing: Callable[[Floats], int] = lambda T: 0,
    pivot: Floats | None = None,
    R_upright: Floats | None = None,
) -> Refinement:
    """Refine a transform by ICP on the overlap, with the height settled on the ground.

    Where both clouds are upright it is the smaller one that moves, whichever is the source, so that source
    and target exchanged give the inverse.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.
        T_start: 4x4 from source to target, a metre or two from the truth.
        settings: how to refine.
        cell: of the rasters the start was found on, metres: how exact it may be.
        agreeing: counts the tie points that a transform brings together.
        pivot: (3,) middle of the overlap, source coordinates, where fewer degrees of freedom are wanted;
            the source's centroid if None.
        R_upright: (3, 3) rotation that both levellings make; none if None.

    Raises:
        RegistrationError: if the clouds hardly overlap under the start.

    """
    upright = R_upright is None or bool(np.abs(R_upright - np.eye(3)).max() < UPRIGHT)
    if upright and target_moves(source, target):
        back = _refine(
            target,
            source,
            transforms.inverse(T_start),
            settings,
            cell,
            lambda T: agreeing(transforms.inverse(T)),
        )
        found = inverse_of(back)
    else:
        found = _refine(source, target, T_start, settings, cell, agreeing)
    if settings.motion == "rigid":
        return found
    middle = transforms.centroid(source) if pivot is None else pivot
    T = constrain(found.T, settings.motion, middle, np.eye(3) if R_upright is None else R_upright)
    return replace(found, T=T)


def target_moves(source: Floats, target: Floats) -> bool:
    """Return whether the target is the smaller of two upright clouds, and moves in the source's stead.

    Of two of one size it is the one that spreads less: exchanged or turned, the same cloud moves, unless they
    spread alike.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.

    """
    if len(source) != len(target):
        return len(source) > len(target)
    return float(source.var(axis=0).sum()) > float(target.var(axis=0).sum())


def inverse_of(refinement: Refinement) -> Refinement:
    """Return what a refinement says of the inverse transform."""
    ground = [
        None
        if fit is None
        else replace(fit, T=transforms.inverse(fit.T), rise_m=None if fit.rise_m is None else -fit.rise_m)
        for fit in (refinement.ground_before, refinement.ground_after)
    ]
    icp = refinement.icp
    if icp is not None:
        icp = replace(
            icp,
            T=transforms.inverse(icp.T),
            points_source=icp.points_target,
            points_target=icp.points_source,
            T_surfaces=None if icp.T_surfaces is None else transforms.inverse(icp.T_surfaces),
        )
    before = transforms.inverse(refinement.T_before)
    equations = None if refinement.equations is None else refinement.equations.inverse()
    return Refinement(transforms.inverse(refinement.T), before, ground[0], icp, ground[1], equations)


def _refine(
    source: Floats,
    target: Floats,
    T_start: Floats,
    settings: RefineSettings,
    cell: float,
    agreeing: Callable[[Floats], int],
) -> Refinement:
    """Refine with all six degrees of freedom, the smaller cloud as the source."""
    T, ground_before, icp, ground_after = T_start, None, None, None
    surfaces: Surfaces | None = None
    starts = {"tie_points": T}
    ground_cell = ground_cell_for(cell)
    axes: tuple[Floats | None, Floats | None] = (None, None)
    if settings.ground:
        ground_before = settle_on_ground(source, target, T, tilt=True, cell=ground_cell)
        T = starts["ground"] = ground_before.T
    if settings.method is not None:
        asked = settings.max_correspondence_distances_m
        rounds = {"asked": Rounds(tuple(asked))} if asked else rounds_for(cell)
        axes = own_axes(source), own_axes(target)
        surfaces = Surfaces(
            source,
            target,
            T,
            voxel_m=settings.voxel_m,
            max_correspondence_distance_m=max(
                max(one.max_correspondence_distances_m) for one in rounds.values()
            ),
            max_points=settings.max_points,
            T_axes=axes,
        )
        icp = follow_icp(
            surfaces,
            starts,
            rounds=rounds,
            agreeing=agreeing,
            keep_tie_points=settings.keep_tie_points,
            method=settings.method,
            iterations=settings.iterations,
        )
        T = icp.T
        fine = _refined_finely(source, target, T, settings, agreeing, axes) if icp.followed else None
        if fine is not None:
            icp = replace(icp, T=fine.T, fine=fine.round_, fine_voxel_m=fine.surfaces.voxel_m)
            T, surfaces = fine.T, fine.surfaces
    if settings.ground:
        ground_after = settle_on_ground(source, target, T, tilt=False, cell=ground_cell)
        followed = surfaces is None or (
            beyond_scatter(ground_after)
            and surfaces.surface_residual(ground_after.T) <= SAME_FIT * surfaces.surface_residual(T)
        )
        ground_after = replace(ground_after, followed=followed)
        T = ground_after.T if followed else T
    equations = None
    if surfaces is not None and icp is not None and icp.followed:
        last = icp.fine or icp.rounds[-1]
        equations = equations_of_surfaces(surfaces, T, last.max_correspondence_distance_m)
    return Refinement(T, T_start, ground_before, icp, ground_after, equations)


@dataclass(frozen=True)
class _Fine:
    T: Floats
    round_: IcpRound
    surfaces: Surfaces


def _refined_finely(
    source: Floats,
    target: Floats,
    T_start: Floats,
    settings: RefineSettings,
    agreeing: Callable[[Floats], int],
    T_axes: tuple[Floats | None, Floats | None] = (None, None),
) -> _Fine | None:
    """Run a last round of ICP as fine as the density allows; None where that brings nothing.

    It is taken only where surfaces seen at the fine thinning meet better by it, and the tie points are kept.
    """
    voxel = fine_voxel(source, target, T_start)
    if settings.method is None or voxel > FINE_BELOW * settings.voxel_m:
        return None
    distance = FINE_DISTANCE_VOXELS * voxel
    try:
        surfaces = Surfaces(
            source,
            target,
            T_start,
            voxel_m=voxel,
            max_correspondence_distance_m=distance,
            max_points=settings.max_points,
            T_axes=T_axes,
        )
    except RegistrationError:
        return None  # too few points lie so near each other: the rounds before stand
    run = surfaces.descend(
        T_start, Rounds((distance,), slack=FINE_SLACK), method=settings.method, iterations=settings.iterations
    )
    if surfaces.surface_residual(run.T) >= surfaces.surface_residual(T_start):
        return None
    if agreeing(run.T) < settings.keep_tie_points * agreeing(T_start):
        return None
    return _Fine(run.T, run.rounds[-1], surfaces)


def fine_voxel(source: Floats, target: Floats, T: Floats) -> float:
    """Return the thinning that the sparser cloud's density in the overlap bears, metres.

    Args:
        source, target: (n, 3) and (m, 3) work coordinates, metres.
        T: 4x4 from source to target.

    """
    overlap = overlap_of(transforms.apply(T, source), target)
    area = max(float(overlap.shared.sum()) * overlap.grid.cell**2, 1.0)
    counts = [float(bev.count[overlap.shared].sum()) for bev in (overlap.source, overlap.target)]
    return float(np.clip(FINE_SPACINGS / np.sqrt(max(min(counts), 1.0) / area), FINEST_VOXEL_M, np.inf))


def follow_icp(
    surfaces: Surfaces,
    starts: dict[str, Floats],
    *,
    rounds: dict[str, Rounds],
    agreeing: Callable[[Floats], int],
    keep_tie_points: float,
    method: IcpMethod = "gicp",
    iterations: int = 30,
) -> IcpResult:
    """Run ICP with several correspondence distances and take what the surfaces fit best, starts included.

    A far one catches starts that are off by metres, but on open ground it lets the clouds slide; a near
    one does not. Neither is right where crops or bushes grew between the surveys and hold the least squares
    off the ground, which `Surfaces.surface_residual` sees through. In plan only the tie points have seen
    anything on open ground: what loses them is not followed, unless few agreed and surfaces meet far better.

    Args:
        surfaces: of both clouds.
        starts: 4x4 from source to target work coordinates by name; ICP starts from the last.
        rounds: the runs of ICP to try, by name.
        agreeing: counts the tie points that a transform brings together.
        keep_tie_points: share of the tie points agreeing at the last start that must still agree, unless
            these are few and surfaces meet far better; 0 follows ICP always.
        method: of `Surfaces.descend`.
        iterations: at most, each round.

    """
    *_, last = starts
    with ThreadPoolExecutor(min(len(rounds), usable_cores()) or 1) as threads:
        begun = {
            name: threads.submit(surfaces.descend, starts[last], one, method=method, iterations=iterations)
            for name, one in rounds.items()
        }
        runs = {name: run.result() for name, run in begun.items()}
    tried = {name: T for name, T in starts.items() if keep_tie_points > 0} | {
        name: run.T for name, run in runs.items()
    }
    if len(runs) == 2:
        # sparse clouds leave ICP several places to end in, and which of them fits best is luck
        tried[BETWEEN] = surfaces.between(*(run.T for run in runs.values()))
    agreed = agreeing(starts[last])
    trials = {name: IcpTrial(surfaces.surface_residual(T), agreeing(T)) for name, T in tried.items()}
    before = min((trials[name].surface_residual for name in starts if name in trials), default=0.0)
    wanted, enough = keep_tie_points * agreed, FAR_BETTER * before if agreed < FEW_TIE_POINTS else 0.0
    kept = [
        name
        for name, trial in trials.items()
        if name == last or trial.tie_points >= wanted or trial.surface_residual <= enough
    ]
    best = min(
        (name for name in kept if name != BETWEEN),
        key=lambda name: trials[name].surface_residual * (1.0 if name in runs else CLEARLY),
    )
    better = [
        name
        for name in runs
        if name not in kept and trials[name].surface_residual < trials[best].surface_residual
    ]
    much = trials[best].surface_residual * (MUCH if best in runs else 1.0)
    lost = [name for name in better if trials[name].surface_residual < much]
    if (
        best in runs
        and BETWEEN in kept
        and (trials[BETWEEN].surface_residual <= CLEARLY * trials[best].surface_residual)
    ):
        run: Descent | None = runs[best]
        best = BETWEEN
    else:
        run = runs.get(best)
    left = run is not None and trials[best].tie_points < wanted
    rotated = None
    if run is not None:
        rotation = tried[best][:3, :3] @ starts[last][:3, :3].T
        rotated = float(np.degrees(transforms.rotation_angle(rotation)))
    return IcpResult(
        T=tried[best],
        method=method,
        voxel_m=surfaces.voxel_m,
        points_source=surfaces.sizes[0],
        points_target=surfaces.sizes[1],
        tried=trials,
        chosen=best,
        followed=run is not None,
        lost_tie_points=bool(lost),
        rounds=run.rounds if run is not None else (),
        rotated_deg=rotated,
        T_surfaces=min(runs.items(), key=lambda one: trials[one[0]].surface_residual)[1].T,
        contested=bool(better) or left,
        left_tie_points=left,
    )


def constrain(T: Floats, motion: Motion, pivot: Floats, R_upright: Floats) -> Floats:
    """Hold a transform to fewer degrees of freedom, keeping where it takes the overlap.

    Args:
        T: 4x4 from source to target, work coordinates.
        motion: "rigid" keeps all six, "yaw" drops the tilt, "translation" drops the yaw too.
        pivot: (3,) middle of the overlap, source coordinates: it goes where T takes it.
        R_upright: (3, 3) rotation that both levellings make; what yaw is counted from.

    """
    if motion == "rigid":
        return T
    R = R_upright
    if motion == "yaw":
        R = transforms.yaw_matrix(transforms.yaw_of(T[:3, :3] @ R_upright.T)) @ R_upright
    return transforms.compose(R, T[:3, :3] @ pivot + T[:3, 3] - R @ pivot)
