"""The search on small plots, on sites that repeat themselves, mirrored, and with both clouds exchanged."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_plots import planting, plot
from helpers_scene import town

import mtpcr_geo as mg
from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Bev, Hypothesis, Matches
from mtpcr_geo.match.candidates import Candidate, GroundWeights, Pool, same_pose
from mtpcr_geo.match.correlation import CorrelationSettings, match, mirror
from mtpcr_geo.match.exploration import Exploration, Step
from mtpcr_geo.match.nearby import _sums_by_shifts, _sums_by_spectra
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.match.terrain import GroundComparison
from mtpcr_geo.method.bev import grid_around, rasterise
from mtpcr_geo.method.scales import Scales, scales_of


def bev_of(xyz: np.ndarray, cell: float) -> Bev:
    return rasterise([xyz], grid_around(*transforms.bounds(xyz), cell))


def moved_by(yaw_deg: float) -> np.ndarray:
    return transforms.compose(transforms.yaw_matrix(np.radians(yaw_deg)), np.array([60.0, -25.0, 4.0]))


def transform_of(hypothesis: Hypothesis) -> np.ndarray:
    return transforms.compose(transforms.yaw_matrix(hypothesis.yaw), np.array([*hypothesis.shift, 0.0]))


def off(found: np.ndarray, T_moved: np.ndarray, at: np.ndarray) -> tuple[float, float]:
    """Yaw, degrees, and distance in plan, metres, by which a pose misses, where the (3,) point lies."""
    rest = found @ T_moved
    plan = (transforms.apply(rest, at[None]) - at)[0, :2]
    return abs(float(np.degrees(transforms.yaw_of(rest[:3, :3])))), float(np.hypot(*plan))


@pytest.mark.parametrize("yaw_deg", [0.0, 75.0, 163.0, 290.0])
def test_a_plot_of_25_m_is_found_at_any_yaw(yaw_deg: float) -> None:
    rng = np.random.default_rng(1)
    T_moved = moved_by(yaw_deg)
    source, target = plot(rng), plot(rng)
    found = match(bev_of(transforms.apply(T_moved, source), 0.25), bev_of(target, 0.25))
    yaw, plan = off(transform_of(found.hypotheses[0]), T_moved, np.zeros(3))
    assert yaw < 1.0
    assert plan < 0.1
    assert len(found.source_px) >= 20
    assert found.margin is not None
    assert found.margin > 2.0
    assert found.null_ratio is not None
    assert found.null_ratio > 2.0


@pytest.mark.parametrize("yaw_deg", [pytest.param(0.0, marks=pytest.mark.slow), 77.0])
def test_the_terrain_tells_one_period_of_a_planting_from_the_next(yaw_deg: float) -> None:
    rng = np.random.default_rng(2)
    T_moved = moved_by(yaw_deg)
    source = planting(rng, (16.0, -40.0), (86.0, 40.0))
    target = planting(rng, (-40.0, -40.0), (40.0, 40.0))
    found = match(bev_of(transforms.apply(T_moved, source), 1.0), bev_of(target, 1.0))
    yaw, plan = off(transform_of(found.hypotheses[0]), T_moved, np.array([28.0, 0.0, 0.0]))
    assert yaw < 1.0
    assert plan < 0.5
    assert found.margin is not None
    assert found.margin > 1.5
    # rows fit rows: what tells this pose from the next is the ground, seen by its spread
    spreads = found.report["ground_spread_m"]
    assert spreads[0] == min(one for one in spreads if one is not None)


@pytest.mark.slow
@pytest.mark.parametrize("yaw_deg", [0.0, 77.0])
def test_a_planting_that_is_not_the_same_is_never_accepted(yaw_deg: float) -> None:
    rng = np.random.default_rng(2)
    source = planting(rng, (50.0, -40.0), (110.0, 40.0), 4.0)
    target = planting(rng, (-40.0, -40.0), (40.0, 40.0), 4.0)
    found = mg.register(transforms.apply(moved_by(yaw_deg), source), target, cell=1.0)
    assert found.verdict.name != "accepted"
    assert found.verdict.reasons


@pytest.fixture(scope="module")
def towns() -> tuple[np.ndarray, np.ndarray]:
    """Two samples of one town of which the first shows a part."""
    rng = np.random.default_rng(0)
    source, target = town(rng, 90_000, 200.0), town(rng, 90_000, 200.0)
    return transforms.apply(moved_by(121.5), source[(source[:, 0] > -20) & (source[:, 1] < 40)]), target


@pytest.fixture(scope="module")
def found(towns: tuple[np.ndarray, np.ndarray]) -> Matches:
    return match(bev_of(towns[0], 1.0), bev_of(towns[1], 1.0))


def test_reflecting_twice_gives_the_raster_back(towns: tuple[np.ndarray, np.ndarray]) -> None:
    bev = bev_of(towns[0], 1.0)
    once, twice = mirror(bev), mirror(mirror(bev))
    assert twice.grid == bev.grid
    for a, b in ((twice.top, bev.top), (twice.low, bev.low), (twice.count, bev.count)):
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    assert not np.array_equal(once.count, bev.count)
    # what lies at x comes to lie at -x, at the same y and height
    of_points = rasterise([towns[0] * [-1.0, 1.0, 1.0]], once.grid)
    assert (of_points.count == once.count).mean() > 0.999


def test_a_mirrored_town_fits_nowhere_near_as_well(found: Matches) -> None:
    assert found.null_ratio is not None
    assert found.null_ratio > 2.0
    assert found.report["null_ratio"] == found.null_ratio
    assert max(found.report["mirrored_strengths"]) < found.report["strengths"][0] / 2


def test_the_mirrored_search_changes_no_match(towns: tuple[np.ndarray, np.ndarray], found: Matches) -> None:
    source, target = (bev_of(xyz, 1.0) for xyz in towns)
    without = match(source, target, CorrelationSettings(mirrored_null=False))
    assert without.null_ratio is None
    assert without.report["mirrored_strengths"] is None
    assert without.hypotheses == found.hypotheses
    assert np.array_equal(without.source_px, found.source_px)
    # under a prior the mirrored source is searched near the same place, at every yaw
    near = match(source, target, prior=Prior.around(found.hypotheses[0], (0.0, 0.0), 10.0, 0.1))
    assert near.null_ratio is not None
    assert near.null_ratio > 2.0


def test_exchanged_clouds_give_the_inverse(towns: tuple[np.ndarray, np.ndarray], found: Matches) -> None:
    exchanged = match(bev_of(towns[1], 1.0), bev_of(towns[0], 1.0))
    there, back = (transform_of(one.hypotheses[0]) for one in (found, exchanged))
    centre = towns[1].mean(axis=0)
    yaw, plan = off(there, back, centre)
    # the same raster is turned both ways round
    assert yaw < 1e-6
    assert plan < 1e-6
    assert np.array_equal(exchanged.source_px, found.target_px)
    assert (exchanged.null_ratio, exchanged.margin) == (found.null_ratio, found.margin)


def test_grounds_that_disagree_weigh_a_hypothesis_down() -> None:
    class Judged(Candidate):
        @property
        def strength(self) -> float:
            return self.pose.score

    def judged(score: float, east: float, spread_m: float, cells: int = 400) -> Candidate:
        return Judged(Pose(0.0, east, 0.0, score), ground=GroundComparison(cells, spread_m, 8, 0.9, 0.9))

    scales = Scales(
        cell_m=1.0, extent_m=40.0, patch_m=12.0, search_radius_m=3.0, least_overlap_m2=300.0,
        terrain_cell_m=5.0, same_pose_m=5.0,
    )  # fmt: skip
    right, wrong, same = judged(80.0, 0.0, 0.1), judged(100.0, 50.0, 0.9), judged(70.0, 1.0, 0.1)
    pool = Pool.of([wrong, same, right], scales)
    assert pool.candidates == (right, wrong)
    assert pool.margin > 5.0
    # ground that is not known counts for little and against little
    unknown = Pool.of([judged(80.0, 0.0, np.inf, 0), judged(50.0, 50.0, np.inf, 0)], scales)
    assert unknown.margin == pytest.approx(1.6)
    assert Pool.of([], scales).margin == 1.0
    # what was left unjudged may be as strong as its bound
    assert Pool.of([right], scales, bound=20.0).margin == pytest.approx(pool.strengths[0] / 20.0)


def test_flat_ground_that_fits_tells_less_than_steep_ground_that_fits() -> None:
    def judged(strength: float, spread_m: float, relief_m: float, cells: int = 400) -> Candidate:
        ground = GroundComparison(cells, spread_m, 8, relief_m, relief_m)
        return _Strong(Pose(0.0, strength, 0.0, strength, 100), ground=ground)

    steep, flat = judged(10.0, 0.09, 0.6), judged(14.0, 0.06, 0.06)
    far = judged(14.0, 0.6, 0.6)
    hidden = judged(14.0, np.inf, 0.0, cells=0)
    few = judged(10.0, 0.09, 0.6, cells=10)
    all_of_them = [steep, flat, far, hidden, few]
    weights = GroundWeights.of(all_of_them)
    ranked = sorted(all_of_them, key=weights.weighed, reverse=True)
    assert ranked[0] is steep
    assert ranked[-1] is far
    # few cells agree by luck, and ground that is not seen tells nothing
    assert weights.factor(hidden.ground) < weights.factor(few.ground) < weights.factor(steep.ground) / 2
    # a strength never exceeds what patches give, and where no ground is seen it is that
    assert all(0.0 < weights.weighed(one) <= one.strength for one in all_of_them)
    assert GroundWeights.of([hidden]).weighed(hidden) == hidden.strength
    # on a plain all poses differ by noise, and hardly one is preferred
    plain = [judged(10.0, spread, 0.02) for spread in (0.01, 0.02)]
    level = GroundWeights.of(plain)
    assert level.weighed(plain[0]) == pytest.approx(level.weighed(plain[1]), rel=0.25)


def test_poses_are_one_where_they_move_the_rim_alike() -> None:
    here = Pose(0.0, 0.0, 0.0)
    assert same_pose(here, Pose(2 * np.pi - 0.01, 1.0, 0.0), 5.0, np.inf)
    assert not same_pose(here, Pose(0.0, 6.0, 0.0), 5.0, 20.0)
    turned = Pose(np.radians(10.0), 1.0, 0.0)
    assert same_pose(here, turned, 5.0, 20.0)
    assert not same_pose(here, turned, 5.0, 200.0)


def test_the_best_is_judged_at_the_finest_cells_though_a_first_look_was_enough_for_others() -> None:
    rng = np.random.default_rng(5)
    T_moved = moved_by(40.0)
    source, target = town(rng, 60_000), town(rng, 60_000)
    search = Exploration(
        bev_of(transforms.apply(T_moved, source), 1.0), bev_of(target, 1.0),
        scales_of(bev_of(source, 1.0), bev_of(target, 1.0)), CorrelationSettings(), 0, lambda n: None,
    )  # fmt: skip
    search.explore(Step(4, 0))
    best = search.pool.candidates[0]
    # seen beside something far stronger it is left after the first look, on cells twice as large
    faint = search.judge.judge_one(best.pose, known=1e9)
    assert not faint.complete
    search.judged = [faint]
    search._rank()
    again = search.pool.candidates[0]
    assert again.complete
    assert again.patches is not None
    assert best.patches is not None
    assert np.ptp(again.patches.source_px, axis=0) == pytest.approx(
        np.ptp(best.patches.source_px, axis=0), abs=2.0
    )


def test_a_pose_that_wins_by_the_ground_alone_ends_no_search() -> None:
    rng = np.random.default_rng(6)
    source, target = bev_of(town(rng, 30_000), 1.0), bev_of(town(rng, 30_000), 1.0)
    search = Exploration(
        source, target, scales_of(source, target), CorrelationSettings(), 0, lambda n: None,
    )  # fmt: skip
    assert not search.may_end_search()
    fits, differs = GroundComparison(400, 0.05, 8, 0.9, 0.9), GroundComparison(400, 0.9, 8, 0.9, 0.9)
    for strength, among_the_strongest in ((10.0, False), (60.0, True)):
        search.judged = [
            _Strong(Pose(0.0, 0.0, 0.0, strength, 100), ground=fits),
            _Strong(Pose(0.0, 90.0, 0.0, 100.0, 100), ground=differs),
        ]
        search._rank()
        assert search.pool.candidates[0] is search.judged[0]
        assert search.may_end_search() == among_the_strongest


def test_tie_points_lie_where_the_best_hypothesis_puts_them() -> None:
    rng = np.random.default_rng(2)
    source = bev_of(planting(rng, (16.0, -40.0), (86.0, 40.0)), 1.0)
    target = bev_of(planting(rng, (-40.0, -40.0), (40.0, 40.0)), 1.0)
    found = match(source, target)
    placed = transforms.apply(
        transform_of(found.hypotheses[0]),
        np.column_stack([source.grid.to_metres(found.source_px), np.zeros(len(found.source_px))]),
    )[:, :2]
    assert found.search_radius_m is not None
    away = np.abs(placed - target.grid.to_metres(found.target_px)).max(axis=1)
    assert np.median(away) <= found.search_radius_m + 1.0


def test_the_ground_weighs_in_a_pose_and_in_its_mirror_image_alike() -> None:
    def pool(strength: float, spread: float, relief: float = 0.5) -> Pool:
        ground = GroundComparison(100, spread, 8, relief, relief)
        candidate = _Strong(Pose(0.0, 0.0, 0.0, strength, 100), ground=ground)
        return Pool((candidate,), (strength,))

    alike = pool(10.0, 0.02).over(pool(12.0, 0.02))
    assert alike == pytest.approx(10.0 / 12.0)
    assert pool(10.0, 0.02).over(pool(12.0, 0.5)) > 5.0
    assert pool(10.0, 0.5).over(pool(12.0, 0.02)) < 0.2
    # and of flat ground, which is alike everywhere, nothing is made, whatever others lie on
    assert pool(10.0, 0.0, 0.01).over(pool(12.0, 0.01, 0.01)) == pytest.approx(alike, rel=0.05)
    assert pool(10.0, 0.02, 0.02).over(pool(12.0, 2.0, 2.0)) == pytest.approx(alike, rel=0.05)


def test_a_slope_on_a_slope_tells_less_than_a_shape_that_fits() -> None:
    def judged(beyond_plane_m: float) -> Candidate:
        ground = GroundComparison(400, 0.09, 8, 0.9, beyond_plane_m)
        return _Strong(Pose(0.0, beyond_plane_m, 0.0, 10.0, 100), ground=ground)

    shaped, slope = judged(0.9), judged(0.09)
    weights = GroundWeights.of([shaped, slope])
    assert weights.ratio(shaped, slope) > 5.0
    # still more than ground that fits no better than anywhere
    flat = _Strong(Pose(0.0, 0.0, 0.0, 10.0, 100), ground=GroundComparison(400, 0.09, 8, 0.09, 0.09))
    assert weights.ratio(slope, flat) > 2.0


class _Strong(Candidate):
    """A candidate whose patches all agree, so that its strength is its score."""

    @property
    def strength(self) -> float:
        return self.pose.score


def test_sums_by_spectra_are_those_by_shifts() -> None:
    rng = np.random.default_rng(7)
    a, e = rng.normal(size=(2, 40, 33)).astype(np.float32)
    m = (rng.uniform(size=(40, 33)) < 0.8).astype(np.float32)
    A, E = rng.normal(size=(2, 56, 49)).astype(np.float32)
    M = (rng.uniform(size=(56, 49)) < 0.8).astype(np.float32)
    stack = np.stack([A * M, E * M, M])
    expected = _sums_by_shifts(a * m, e * m, m, stack, 8, 1)
    assert _sums_by_spectra(a * m, e * m, m, stack, 8) == pytest.approx(expected, abs=1e-2)
