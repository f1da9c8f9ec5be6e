"""What the refinement found, fed back: when a second search bears it out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from helpers_scene import houses

from mtpcr_geo import register
from mtpcr_geo.core import transforms
from mtpcr_geo.core.fits import IcpResult, IcpTrial, Refinement
from mtpcr_geo.core.types import Bev, Matches, Pair, Side
from mtpcr_geo.export.descriptions import transform_rows
from mtpcr_geo.method.bev import make_bev
from mtpcr_geo.method.refine import RefineSettings, refine
from mtpcr_geo.pipeline.stages.feedback import (
    CLOSER,
    _apart_m,
    borne_out,
    fed_back,
    matched_coarser,
    refined_from_search,
)
from mtpcr_geo.verdict.evidence import gather, tie_points_agreeing


def refined(residual: float, *, followed: bool, lost: bool) -> Refinement:
    T, name = np.eye(4), "far" if followed else "ground"
    icp = IcpResult(
        T, "gicp", 0.5, 1000, 1000, {name: IcpTrial(residual, 30)}, name, followed, lost_tie_points=lost
    )
    return Refinement(T, T, icp=icp)


LOST = refined(0.9, followed=False, lost=True)


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        (refined(0.4, followed=True, lost=False), True),
        (refined(0.9 * CLOSER + 0.01, followed=True, lost=False), False),
        (refined(0.4, followed=False, lost=True), False),
        (Refinement(np.eye(4), np.eye(4)), False),
    ],
)
def test_weaker_matches_bear_a_vertical_out_where_surfaces_then_meet(
    after: Refinement, expected: bool
) -> None:
    assert borne_out(LOST, after) is expected


def test_nothing_is_borne_out_where_surfaces_and_tie_points_agreed_before() -> None:
    assert not borne_out(refined(0.9, followed=True, lost=False), refined(0.4, followed=True, lost=False))


@pytest.fixture(scope="module")
def registered() -> tuple[Pair, np.ndarray]:
    """A registered pair of a town, and the true transform in work coordinates."""
    rng = np.random.default_rng(3)
    T = transforms.compose(transforms.yaw_matrix(np.radians(40.0)), np.array([20.0, -9.0, 1.0]))
    source, target = houses(rng, 30_000), houses(rng, 30_000)
    found = register(transforms.apply(transforms.inverse(T), source), target, local=True)
    assert found.pair is not None
    assert found.T_target_source is not None
    corners = np.array([[40.0, 40.0, 0.0], [-40.0, 40.0, 0.0], [0.0, -40.0, 5.0]])
    np.testing.assert_allclose(
        transforms.apply(found.T_target_source @ transforms.inverse(T), corners), corners, atol=0.02
    )
    assert found.pair.T_target_source is not None
    return found.pair, found.pair.T_target_source


def beside(pair: Pair, T: np.ndarray, by: tuple[float, float, float]) -> tuple[Pair, Refinement]:
    """The pair as if every tie point were wrong by the same step, and the refinement from there."""
    assert pair.tie_points is not None
    step = transforms.compose(np.eye(3), np.array(by))
    ties = replace(pair.tie_points, target=pair.tie_points.target + np.array(by))
    off = pair.with_(tie_points=ties, T_target_source=step @ T, refinement=None, verdict=None)
    refined = refine(
        off.source.sample,
        off.target.sample,
        step @ T,
        RefineSettings(),
        cell=off.cell,
        agreeing=lambda one: tie_points_agreeing(off, one),
    )
    return off, refined


def apart_m(found: np.ndarray, T: np.ndarray) -> float:
    """Largest step between where two transforms take two corners of the town, metres."""
    places = transforms.apply(transforms.inverse(T), np.array([[40.0, 40.0, 0.0], [-40.0, -40.0, 0.0]]))
    return float(np.abs(transforms.apply(found, places) - transforms.apply(T, places)).max())


def few_of(pair: Pair) -> Pair:
    """The pair with 12 of its tie points."""
    ties = pair.tie_points
    assert ties is not None
    some = np.linspace(0, len(ties) - 1, 12).astype(int)
    names = ("source", "target", "score", "fold", "held_out", "inlier")
    return pair.with_(tie_points=replace(ties, **{name: getattr(ties, name)[some] for name in names}))


def raster(side: Side, cell: float) -> Bev:
    return make_bev(side.levelled_sample, cell)


@dataclass(frozen=True)
class WithoutStrength:
    """The search, as a matcher whose strengths are not compared would tell of what it finds."""

    matcher: Any
    margin: float
    needs_image: bool = False
    needs_one_cell: bool = True

    def match(self, *views: Any, **options: Any) -> Matches:
        found: Matches = self.matcher.match(*views, **options)
        return replace(found, strength=None, margin=self.margin)


@pytest.mark.parametrize(("margin", "taken"), [(1.1, False), (4.0, True)])
def test_a_vertical_is_borne_out_by_a_matcher_without_strengths_where_its_pose_stands_out(
    registered, margin: float, taken: bool
) -> None:
    pair, T = registered
    matcher = WithoutStrength(pair.matches.matcher, margin)
    pair = pair.with_(matches=replace(pair.matches, strength=None, margin=3.0, matcher=matcher))
    tilted = T @ transforms.compose(tilt_about_x(2.0), np.zeros(3))
    found = fed_back(pair, refined_to(tilted), RefineSettings(), raster)
    assert (found is not None) is taken


def tilt_about_x(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def refined_to(T: np.ndarray) -> Refinement:
    """A refinement that ICP led to a transform, where the tie points no longer agree."""
    icp = IcpResult(T, "gicp", 0.5, 1000, 1000, {"far": IcpTrial(0.9, 30)}, "far", True, lost_tie_points=True)
    return Refinement(T, T, icp=icp)


def test_the_pose_of_the_search_is_refined_where_tie_points_lead_elsewhere(registered) -> None:
    pair, T = registered
    many, refined = beside(pair, T, (3.0, 2.0, 0.5))
    assert refined_from_search(many, refined, RefineSettings()) is None, (
        "many tie points that agree are believed"
    )
    off = few_of(many)
    found = refined_from_search(off, refined, RefineSettings())
    assert found is not None
    assert off.matches is not None
    rows = off.with_(matches=replace(off.matches, repeats=True))
    assert refined_from_search(rows, refined, RefineSettings()) is None, "a row away surfaces meet as well"
    assert found.again is not None
    assert apart_m(found.T, T) < 0.03
    # the checks hear how far that is from where the tie points had led, not from where the search had
    assert found.T_solved is off.T_target_source
    assert off.T_target_source is not None
    after = off.with_(T_target_source=found.T, refinement=found)
    evidence, _ = gather(after)
    assert evidence.refined_away_m == pytest.approx(np.hypot(3.0, 2.0), abs=0.1)


def test_the_pose_of_the_search_is_refined_only_where_it_was_judged_and_may_move_freely(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (3.0, 2.0, 0.5))
    off = few_of(off)
    for motion in ("yaw", "translation"):
        assert refined_from_search(off, refined, RefineSettings(motion=motion)) is None
    assert off.matches is not None
    keypoints = replace(off.matches, matcher=replace(off.matches.matcher, needs_image=True))
    assert refined_from_search(off.with_(matches=keypoints), refined, RefineSettings()) is None


def test_steps_between_two_transforms_are_as_long_with_source_and_target_exchanged(registered) -> None:
    pair, T = registered
    turned = transforms.compose(transforms.yaw_matrix(0.05), np.array([2.0, 1.0, 0.3])) @ T
    other = replace(pair.tie_points, source=pair.tie_points.target, target=pair.tie_points.source)
    exchanged = pair.with_(source=pair.target, target=pair.source, tie_points=other)
    there = _apart_m(pair, T, turned)
    back = _apart_m(exchanged, transforms.inverse(T), transforms.inverse(turned))
    assert there == pytest.approx(back, abs=1e-9)
    assert there > 1.0


def test_the_pose_of_the_search_stays_out_where_it_is_the_same_or_surfaces_meet_no_better(registered) -> None:
    pair, T = registered
    right, refined = beside(pair, T, (0.0, 0.0, 0.0))
    right = few_of(right)
    assert refined_from_search(right, refined, RefineSettings()) is None
    assert right.matches is not None
    first, *others = right.matches.hypotheses
    # from 5 m off ICP comes to the same place, from 17 m to a worse one
    for east, north in ((4.0, -3.0), (8.0, -15.0)):
        wrong = replace(first, shift=(first.shift[0] + east, first.shift[1] + north))
        misled = right.with_(matches=replace(right.matches, hypotheses=(wrong, *others)))
        assert refined_from_search(misled, refined, RefineSettings()) is None
    # nor where nothing was asked of the surfaces
    off, refined = beside(pair, T, (3.0, 2.0, 0.5))
    for settings in (RefineSettings(method=None), RefineSettings(ground=False)):
        assert refined_from_search(few_of(off), refined, settings) is None


def test_tie_points_beside_the_surfaces_are_sought_again_at_coarser_cells(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (1.6, 0.0, 0.0))
    assert refined.icp is not None
    assert refined.icp.contested
    again = matched_coarser(off, refined, RefineSettings(), raster)
    assert again is not None
    assert again.T_target_source is not None
    assert again.cell > pair.cell
    assert again.refinement is not None
    assert ("fed back", again.refinement.again) in transform_rows(again)
    assert apart_m(again.T_target_source, T) < 0.03


def test_nothing_is_sought_again_where_tie_points_and_surfaces_agree(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (0.0, 0.0, 0.0))
    assert matched_coarser(off, refined, RefineSettings(), raster) is None


def test_surfaces_that_slid_away_are_not_borne_out_by_coarser_cells(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (1.6, 0.0, 0.0))
    assert refined.icp is not None
    assert off.matches is not None
    away = transforms.compose(np.eye(3), np.array([0.0, 6.0, 0.0])) @ T
    slid = replace(refined, T=away, icp=replace(refined.icp, T_surfaces=away))
    # what is found anew may lead to a third place, if the same surfaces meet clearly better there
    again = matched_coarser(off, slid, RefineSettings(), raster)
    assert again is not None
    assert again.T_target_source is not None
    assert apart_m(again.T_target_source, T) < 0.03
    # not if they meet as well already, and not among rows, where a third place is the next row
    met = replace(refined, T=T, icp=replace(refined.icp, T_surfaces=away))
    assert matched_coarser(off, met, RefineSettings(), raster) is None
    rows = off.with_(matches=replace(off.matches, repeats=True))
    assert matched_coarser(rows, slid, RefineSettings(), raster) is None


def test_a_refinement_held_to_wrong_tie_points_is_heard_again(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (1.6, 0.0, 0.0))
    assert refined.icp is not None
    assert off.T_target_source is not None
    held = replace(refined, icp=replace(refined.icp, contested=False), T=off.T_target_source, slid_m=1.6)
    again = matched_coarser(off, held, RefineSettings(), raster)
    assert again is not None
    assert again.T_target_source is not None
    np.testing.assert_allclose(again.T_target_source, T, atol=0.03)


def test_a_slide_of_less_than_a_cell_is_not_sought_again(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (0.0, 0.0, 0.0))
    assert matched_coarser(off, replace(refined, slid_m=0.9 * pair.cell), RefineSettings(), raster) is None


def test_a_pose_in_doubt_is_not_sought_again(registered) -> None:
    pair, T = registered
    off, refined = beside(pair, T, (1.6, 0.0, 0.0))
    assert off.matches is not None
    unsure = off.with_(matches=replace(off.matches, margin=1.1))
    assert matched_coarser(unsure, refined, RefineSettings(), raster) is None
