"""The shape of the ground as evidence: made-up terrains, smooth and unlike anywhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Bev, Hypothesis
from mtpcr_geo.match.exploration import CorrelationSettings, Exploration, Step
from mtpcr_geo.match.nearby import score_nearby
from mtpcr_geo.match.pose import Pose, centre_of, pose_of
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.match.terrain import (
    FEWEST_CELLS,
    Terrain,
    cell_to_compare,
    compare_ground,
    ground_spread,
)
from mtpcr_geo.match.terrain_search import Settling, TerrainSearch, closest, propose
from mtpcr_geo.method.bev import grid_around, rasterise
from mtpcr_geo.method.scales import scales_of

CELL = 4.0
YAW = np.radians(143.0)
SHIFT = np.array([420.0, -310.0, 55.0])
T_MOVED = transforms.compose(transforms.yaw_matrix(YAW), SHIFT)
BACK = transforms.inverse(T_MOVED)
TRUE = Hypothesis(transforms.yaw_of(BACK[:3, :3]), (float(BACK[0, 3]), float(BACK[1, 3])), 0.0, 0)
"""What takes the moved source back to the target."""


def relief(xy: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Heights of hills 40 to 120 m long at (n, 2) places, the same for every call, metres."""
    rng = np.random.default_rng(17)
    z = np.zeros(len(xy))
    for _ in range(24):
        direction, length = rng.uniform(0.0, 2 * np.pi), rng.uniform(40.0, 120.0)
        along = xy @ np.array([np.cos(direction), np.sin(direction)])
        z += length / 120.0 * np.sin(2 * np.pi * along / length + rng.uniform(0.0, 2 * np.pi))
    return scale * z


def ground(seed: int, low: tuple[float, float], high: tuple[float, float], scale: float = 1.0) -> np.ndarray:
    """(n, 3) points on the ground, 2 a square metre, rough by 2 cm."""
    rng = np.random.default_rng(seed)
    n = round(2 * np.prod(np.subtract(high, low)))
    xy = rng.uniform(low, high, (n, 2))
    return np.column_stack([xy, relief(xy, scale) + rng.normal(0.0, 0.02, n)])


def bev_of(xyz: np.ndarray) -> Bev:
    return rasterise([xyz], grid_around(*transforms.bounds(xyz), 1.0))


def terrain_of(xyz: np.ndarray) -> Terrain:
    return Terrain.of(bev_of(xyz), CELL)


def holed(xyz: np.ndarray) -> np.ndarray:
    """The cloud with holes of 18 m, and without a corner."""
    rng = np.random.default_rng(23)
    low, high = transforms.bounds(xyz)
    keep = (xyz[:, :2] - low[:2]).sum(axis=1) > 0.2 * (high[:2] - low[:2]).sum()
    for _ in range(8):
        keep &= np.hypot(*(xyz[:, :2] - rng.uniform(low[:2], high[:2])).T) > 9.0
    return xyz[keep]


@pytest.fixture(scope="module")
def target() -> np.ndarray:
    return ground(1, (-100.0, -100.0), (100.0, 100.0))


@pytest.fixture(scope="module")
def source() -> np.ndarray:
    """Another sample, which reaches over the target's eastern edge; turned and moved."""
    return transforms.apply(T_MOVED, ground(2, (20.0, -60.0), (140.0, 60.0)))


def best_of(source: Terrain, target: Terrain, step_deg: float = 4.0) -> tuple[Pose, list[Pose]]:
    found = TerrainSearch(source, target, 100).run(np.radians(np.arange(0.0, 360.0, step_deg)))
    return found[0], found


def assert_right(pose: Pose, source: Terrain, within_m: float = 1.5 * CELL) -> None:
    true = pose_of(TRUE, centre_of(source.grid))
    assert np.degrees(angle_between(pose.yaw, true.yaw)) <= 4.0
    assert np.hypot(pose.east - true.east, pose.north - true.north) <= within_m


def test_yaw_and_shift_are_found(source: np.ndarray, target: np.ndarray) -> None:
    s, t = terrain_of(source), terrain_of(target)
    best, found = best_of(s, t)
    assert_right(best, s)
    others = [p for p in found if angle_between(p.yaw, TRUE.yaw) > np.radians(12.0)]
    assert best.score > 1.5 * max(p.score for p in others)


def test_holes_do_no_harm(source: np.ndarray, target: np.ndarray) -> None:
    s, t = terrain_of(holed(source)), terrain_of(holed(target))
    for cloud, terrain in ((source, s), (target, t)):
        assert 0.6 < terrain.mask.sum() / terrain_of(cloud).mask.sum() < 0.96
    assert_right(best_of(s, t)[0], s)


def test_a_mountain_does_not_drown_in_round_off() -> None:
    s = terrain_of(transforms.apply(T_MOVED, ground(2, (20.0, -60.0), (140.0, 60.0), 60.0)))
    t = terrain_of(ground(1, (-100.0, -100.0), (100.0, 100.0), 60.0))
    assert np.ptp(t.low) > 400.0
    assert_right(best_of(s, t)[0], s)


def test_heights_of_another_datum_change_nothing(source: np.ndarray, target: np.ndarray) -> None:
    t = terrain_of(target)
    a, _ = best_of(terrain_of(source), t)
    b, _ = best_of(terrain_of(source + [0.0, 0.0, 700.0]), t)
    assert (b.yaw, b.east, b.north) == (a.yaw, a.east, a.north)
    assert b.score == pytest.approx(a.score, rel=1e-2)
    shape = compare_ground(terrain_of(source), t, TRUE)
    raised = compare_ground(terrain_of(source + [0.0, 0.0, 700.0]), t, TRUE)
    assert raised.spread_m == pytest.approx(shape.spread_m, abs=1e-3)


def test_a_pose_reads_the_same_about_another_centre(source: np.ndarray, target: np.ndarray) -> None:
    s, t = terrain_of(source), terrain_of(target)
    best, _ = best_of(s, t)
    grid = grid_around(np.array([400.0, -300.0]), np.array([433.0, -278.0]), 1.0)
    a, b = (
        best.hypothesis(centre_of(s.grid)),
        pose_of(best.hypothesis(centre_of(s.grid)), centre_of(grid)).hypothesis(centre_of(grid)),
    )
    assert np.allclose(a.shift, b.shift)
    assert a.yaw == b.yaw


def test_the_true_pose_has_the_least_spread(source: np.ndarray, target: np.ndarray) -> None:
    s, t = terrain_of(source), terrain_of(target)
    true = compare_ground(s, t, TRUE)
    assert true.known
    assert true.cells > 200
    pivot = centre_of(s.grid)
    at = pose_of(TRUE, pivot)
    for turn, east, north in ((0.0, 16.0, 0.0), (0.0, 0.0, -16.0), (20.0, 0.0, 0.0), (180.0, 0.0, 0.0)):
        wrong = Pose(at.yaw + np.radians(turn), at.east + east, at.north + north).hypothesis(pivot)
        found = compare_ground(s, t, wrong)
        assert found.spread_m > 2 * true.spread_m
        # grounds that have nothing to do with each other differ by as much as they vary
        assert 0.3 < found.spread_m / found.relief_m < 2.0
    assert true.relief_m > 8 * true.spread_m


def test_a_tilt_is_taken_out_where_the_vertical_is_not_trusted(
    source: np.ndarray, target: np.ndarray
) -> None:
    s, t = terrain_of(source), terrain_of(target)
    middle = source.mean(axis=0)
    leaning = source + np.column_stack(
        [np.zeros((len(source), 2)), (source[:, :2] - middle[:2]) @ np.array([0.12, -0.05])]
    )
    tilted = terrain_of(leaning)
    upright = compare_ground(s, t, TRUE).spread_m
    leant = compare_ground(tilted, t, TRUE).spread_m
    assert leant > 20 * upright
    # not quite as upright: on a tilted cloud another point of a cell is its lowest
    assert compare_ground(tilted, t, TRUE, plane=True).spread_m < leant / 8
    # and a plane does not hide a wrong pose
    pivot = centre_of(s.grid)
    at = pose_of(TRUE, pivot)
    wrong = replace(at, yaw=at.yaw + np.pi).hypothesis(pivot)
    assert compare_ground(tilted, t, wrong, plane=True).spread_m > leant / 3


def test_a_plane_is_not_led_off_by_what_stands_on_the_ground(source: np.ndarray, target: np.ndarray) -> None:
    s, t = terrain_of(source), terrain_of(target)
    plain = compare_ground(s, t, TRUE, plane=True).spread_m
    column = np.arange(t.grid.width)
    hedged = replace(t, low=t.low + np.where(column > 0.93 * t.grid.width, 6.0, 0.0).astype(np.float32))
    assert compare_ground(s, hedged, TRUE, plane=True).spread_m < 2 * plain


def test_flat_ground_knows_nothing() -> None:
    s, t = (terrain_of(ground(seed, (-80.0, -80.0), (80.0, 80.0), 0.0)) for seed in (1, 2))
    _, found = best_of(s, t, 20.0)
    # any pose is as good as another: less than chance of one in e for each cell
    assert all(abs(pose.score) < 0.05 * pose.overlap_cells for pose in found)
    spreads = [
        compare_ground(s, t, Hypothesis(yaw, shift, 0.0, 0)).spread_m
        for yaw in (0.0, 1.0, 3.0)
        for shift in ((0.0, 0.0), (30.0, -20.0))
    ]
    assert max(spreads) < 0.05


def test_too_little_ground_is_said_to_be_unknown(source: np.ndarray, target: np.ndarray) -> None:
    t = terrain_of(target)
    beside = replace(TRUE, shift=(TRUE.shift[0] + 900.0, TRUE.shift[1]))
    nothing = compare_ground(terrain_of(source), t, beside)
    assert not nothing.known
    assert nothing.cells == 0
    few = compare_ground(
        terrain_of(ground(3, (0.0, 0.0), (7.0, 7.0))), t, Hypothesis(0.0, (0.0, 0.0), 0.0, 0)
    )
    assert not few.known
    assert few.cells < FEWEST_CELLS
    assert few.spread_m == np.inf


def test_a_search_without_overlap_enough_finds_nothing(source: np.ndarray, target: np.ndarray) -> None:
    s, t = terrain_of(source), terrain_of(target)
    assert TerrainSearch(s, t, s.mask.sum() + 1).run([0.0, 1.0]) == []
    empty = replace(s, mask=np.zeros_like(s.mask), low=np.zeros_like(s.low))
    assert TerrainSearch(empty, t, 1).run([0.0, 1.0]) == []


@pytest.mark.parametrize(
    ("turn_deg", "east", "north"), [(0.0, 0.0, 0.0), (2.0, 5.0, -3.0), (-3.0, -6.0, 4.0)]
)
def test_a_pose_settles_where_the_grounds_agree(source, target, turn_deg, east, north) -> None:
    s, t = terrain_of(source), terrain_of(target)
    true = pose_of(TRUE, centre_of(s.grid))
    start = Pose(true.yaw + np.radians(turn_deg), true.east + east, true.north + north)
    found, _ = Settling(s, t).settle(start)
    # the lowest of a cell of 4 m lies anywhere in it
    assert np.hypot(found.east - true.east, found.north - true.north) < 1.0
    assert np.degrees(angle_between(found.yaw, true.yaw)) < 0.5
    centre = centre_of(s.grid)
    before, after = (compare_ground(s, t, pose.hypothesis(centre)).spread_m for pose in (start, found))
    assert after <= before


@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize("east", [0.0, 3.0, 5000.0])
def test_a_settled_pose_comes_with_its_comparison(source, target, east: float, plane: bool) -> None:
    s, t = terrain_of(source), terrain_of(target)
    true, centre = pose_of(TRUE, centre_of(s.grid)), centre_of(s.grid)
    pose, spread = Settling(s, t, plane=plane).settle(Pose(true.yaw, true.east + east, true.north))
    whole = compare_ground(s, t, pose.hypothesis(centre), plane=plane)
    assert (spread.cells, spread.spread_m, spread.known) == (whole.cells, whole.spread_m, whole.known)
    assert spread == ground_spread(s, t, pose.hypothesis(centre), plane=plane)


def test_a_tilted_ground_settles_where_a_plane_is_free(source, target) -> None:
    s, t = terrain_of(source), terrain_of(target)
    x = s.grid.to_metres(np.column_stack([np.arange(s.grid.width), np.zeros(s.grid.width)]))[:, 0]
    leaning = replace(s, low=(s.low + np.float32(0.05) * x[None, :].astype(np.float32)) * s.mask)
    true = pose_of(TRUE, centre_of(s.grid))
    start = Pose(true.yaw + 0.02, true.east + 4.0, true.north - 3.0)
    found, _ = Settling(leaning, t, plane=True).settle(start)
    assert np.hypot(found.east - true.east, found.north - true.north) < 1.5


def test_poses_far_from_any_ground_stay_where_they_are(source, target) -> None:
    s, t = terrain_of(source), terrain_of(target)
    away = Pose(0.3, 5000.0, 5000.0)
    assert Settling(s, t).settle(away)[0] == away
    assert closest(s, t, [away], 3) == []


def brushed(xyz: np.ndarray, seed: int) -> np.ndarray:
    """The cloud with brush that hides the ground on four tenths of it, 0.5 to 4 m high."""
    rng = np.random.default_rng(seed)
    low, high = transforms.bounds(xyz)
    out = xyz.copy()
    hidden = np.zeros(len(xyz), bool)
    while hidden.mean() < 0.4:
        inside = np.hypot(*(xyz[:, :2] - rng.uniform(low[:2], high[:2])).T) < rng.uniform(2.0, 4.5)
        out[inside, 2] = np.maximum(out[inside, 2], xyz[inside, 2] + rng.uniform(0.5, 4.0))
        hidden |= inside
    return out


def test_brush_does_not_hide_the_shape_of_the_ground() -> None:
    # gentle terrain: brush differs by more than the ground does
    s = bev_of(brushed(transforms.apply(T_MOVED, ground(2, (-40.0, -30.0), (40.0, 60.0), 0.15)), 5))
    t = bev_of(brushed(ground(1, (-100.0, -100.0), (100.0, 100.0), 0.15), 6))
    true = pose_of(TRUE, centre_of(s.grid))
    ranks = []
    for robustly in (False, True):
        found = [
            pose_of(one, centre_of(s.grid))
            for one in propose((s, t), CELL, 6, 4.0, least_m2=2000.0, robustly=robustly)
        ]
        near = [
            np.hypot(one.east - true.east, one.north - true.north) < CELL
            and angle_between(one.yaw, true.yaw) < np.radians(3.0)
            for one in found
        ]
        ranks.append(near.index(True) if any(near) else None)
    assert ranks[1] == 0, ranks
    assert ranks[0] != 0, "the test is of something that sums of squares do not find"


def test_medians_leave_out_single_cells_and_make_none_up() -> None:
    s = terrain_of(ground(3, (0.0, 0.0), (80.0, 80.0), 0.1))
    low, mask = s.low.copy(), s.mask.copy()
    low[10, 10] += 5.0
    mask[3:9, 3:9] = 0.0
    mask[6, 6] = 1.0
    smooth = replace(s, low=low, mask=mask).smoothed()
    assert abs(smooth.low[10, 10] - s.low[10, 10]) < 0.3
    assert (smooth.mask <= mask).all()
    assert smooth.mask[6, 6] == 0.0
    assert (smooth.low[smooth.mask == 0] == 0.0).all()


def test_what_the_ground_proposes_is_scored_as_all_else(source: np.ndarray, target: np.ndarray) -> None:
    s, t = bev_of(source), bev_of(target)
    search = Exploration(s, t, scales_of(s, t), CorrelationSettings(), 0, lambda _: None)
    for part in (0, 1):
        assert search.explore(Step(4, part, "terrain"))
    assert search.judged
    for candidate in search.judged:
        best_near, _ = score_nearby(*search.pyramid.at(1), candidate.pose, 1)
        assert candidate.pose.score <= 1.1 * best_near.score


def test_the_closest_grounds_come_first_though_others_share_more(target) -> None:
    # a corner of 60 m is all that both share
    s = terrain_of(transforms.apply(T_MOVED, ground(2, (40.0, 40.0), (180.0, 180.0))))
    t = terrain_of(target)
    true = pose_of(TRUE, centre_of(s.grid))
    others = [Pose(true.yaw + k, true.east - 60.0, true.north - 60.0) for k in (0.0, 1.5, 3.0)]
    near = Pose(true.yaw + 0.01, true.east + 3.0, true.north - 2.0)
    first, second, *_ = closest(s, t, [*others, near], 4)
    # the first given is kept first whatever it comes to
    assert np.hypot(first.east - true.east, first.north - true.north) > 20.0
    assert np.hypot(second.east - true.east, second.north - true.north) < 2.0


def thinned(bev: Bev, share: float, seed: int) -> Bev:
    """Leave a share of the cells."""
    kept = (np.random.default_rng(seed).random(bev.top.shape) < share) & (bev.count > 0)
    top, low = (np.where(kept, band, np.float32(np.nan)) for band in (bev.top, bev.low))
    return Bev(bev.grid, top, low, np.where(kept, bev.count, np.uint32(0)))


@pytest.mark.parametrize(("share", "parts"), [(1.0, 8), (0.7, 8), (0.3, 4), (0.12, 2), (0.02, 1)])
def test_grounds_are_compared_in_the_finest_cells_that_show_them(share: float, parts: int) -> None:
    seen = bev_of(ground(3, (0.0, 0.0), (160.0, 120.0)))
    thin = thinned(seen, share, 5)
    assert cell_to_compare(seen, thin, 8.0) == cell_to_compare(thin, seen, 8.0)
    # no cell is finer than the raster's
    assert cell_to_compare(seen, seen, 2.0) == 1.0
    assert 8.0 / cell_to_compare(seen, thin, 8.0) == parts


def test_on_a_slope_grounds_that_are_seen_in_part_agree_in_fine_cells_only() -> None:
    """What hides half of a cell moves the lowest point in it."""
    steep, again = (ground(seed, (0.0, 0.0), (160.0, 120.0), 4.0) for seed in (3, 4))
    for one in (steep, again):
        one[:, 2] += 0.4 * one[:, 0]
    rng = np.random.default_rng(8)
    hidden = np.zeros(len(steep), bool)
    for middle in rng.uniform((0.0, 0.0), (160.0, 120.0), (2000, 2)):
        hidden |= (np.abs(steep[:, 0] - middle[0]) < 2.0) & (np.abs(steep[:, 1] - middle[1]) < 2.0)
    part, whole = bev_of(steep[~hidden]), bev_of(again)
    here = Hypothesis(0.0, (0.0, 0.0), 0.0, 0)
    coarse, fine = (
        compare_ground(Terrain.of(part, cell), Terrain.of(whole, cell), here) for cell in (8.0, 1.0)
    )
    assert fine.known
    assert fine.spread_m < 0.5 * coarse.spread_m
