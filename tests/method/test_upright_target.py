"""A target that lies on its side or on its head is refined and judged as if it stood upright."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_scene import make_pair

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Levelling, Pair
from mtpcr_geo.method.refine import RefineSettings
from mtpcr_geo.method.upright import seen_upright
from mtpcr_geo.pipeline.stages.refining import refined_pair
from mtpcr_geo.verdict.evidence import agreement, gather

LAID = {
    "y up": transforms.axis_angle_matrix(np.array([1.0, 0.0, 0.0]), np.radians(-90.0)),
    "upside down": transforms.axis_angle_matrix(np.array([1.0, 0.0, 0.0]), np.pi),
    "leaning": transforms.axis_angle_matrix(np.array([0.6, 0.8, 0.0]), np.radians(12.0)),
}


def laid(pair: Pair, R: np.ndarray) -> tuple[Pair, np.ndarray]:
    """The pair with its target's work coordinates turned, levelled back; and 4x4 of the turn."""
    A = transforms.about(transforms.centroid(pair.target.sample), R)
    target = replace(
        pair.target,
        sample=transforms.apply(A, pair.target.sample),
        levelling=Levelling(T_level_work=transforms.inverse(A), method="floor", tilt_deg=90.0),
    )
    assert pair.T_target_source is not None
    turned = None if pair.refinement is None else pair.refinement.in_frame(A)
    return pair.with_(target=target, T_target_source=A @ pair.T_target_source, refinement=turned), A


def solved(off: float = 0.3) -> Pair:
    pair = make_pair(20_000, crs=None, state="solved")
    assert pair.T_target_source is not None
    start = transforms.translation((off, -off, 0.5)) @ pair.T_target_source
    return pair.with_(T_target_source=start, refinement=None)


@pytest.mark.parametrize("name", list(LAID))
def test_the_refinement_does_not_depend_on_how_the_target_lies(name):
    pair = solved()
    turned, A = laid(pair, LAID[name])
    settings = RefineSettings()
    expected, found = refined_pair(pair, settings), refined_pair(turned, settings)
    # surfaces of so few points have several places to end in
    gap = transforms.inverse(A) @ found.T @ transforms.inverse(expected.T)
    assert np.linalg.norm(gap[:3, 3]) < 0.02
    assert np.degrees(transforms.rotation_angle(gap[:3, :3])) < 0.02
    assert found.ground_before is not None
    assert expected.ground_before is not None
    assert found.ground_before.cells == pytest.approx(expected.ground_before.cells, rel=0.02)
    assert found.ground_before.rise_m == pytest.approx(expected.ground_before.rise_m, abs=0.01)


@pytest.mark.parametrize("name", list(LAID))
def test_the_evidence_does_not_depend_on_how_the_target_lies(name):
    pair = solved()
    refined = refined_pair(pair, RefineSettings())
    pair = pair.with_(T_target_source=refined.T, refinement=refined)
    turned, A = laid(pair, LAID[name])
    (expected, metrics), (found, of_turned) = gather(pair), gather(turned)
    assert found.ground_cells == pytest.approx(expected.ground_cells, rel=0.01)
    assert found.ground_agreeing == pytest.approx(expected.ground_agreeing, rel=0.01)
    assert found.overlap_m2 == pytest.approx(expected.overlap_m2, rel=0.01)
    assert found.overlap_target == pytest.approx(expected.overlap_target, rel=0.01)
    assert found.objects_missing == pytest.approx(expected.objects_missing, abs=0.01)
    for key in ("sigma_plan_m", "sigma_height_m", "sigma_yaw_deg", "sigma_tilt_deg", "sigma_plan_far_m"):
        assert of_turned[key] == pytest.approx(metrics[key], rel=0.02), key
    assert found.uncertainty is not None
    assert expected.uncertainty is not None
    np.testing.assert_allclose(
        found.uncertainty.pivot, transforms.apply(A, expected.uncertainty.pivot[None])[0], atol=0.05
    )
    places = pair.target.sample[:5]
    there = found.uncertainty.at(transforms.apply(A, places))
    np.testing.assert_allclose(there, expected.uncertainty.at(places), rtol=0.1, atol=1e-8)
    assert agreement(turned, A @ refined.T)[1] == pytest.approx(agreement(pair, refined.T)[1], rel=0.01)


def test_an_upright_target_is_left_as_it_is():
    pair = solved()
    assert seen_upright(pair) is pair


def test_equations_go_to_another_frame_and_back():
    pair = solved()
    refined = refined_pair(pair, RefineSettings())
    assert refined.equations is not None
    A = transforms.about(np.array([10.0, -5.0, 2.0]), LAID["leaning"])
    there = refined.in_frame(A)
    back = there.in_frame(transforms.inverse(A))
    assert there.equations is not None
    assert back.equations is not None
    np.testing.assert_allclose(back.T, refined.T, atol=1e-9)
    np.testing.assert_allclose(back.equations.H, refined.equations.H, rtol=1e-6, atol=1e-4)
    # a block's own correction moves its middle alike
    for k in range(len(refined.equations.H)):
        x = np.linalg.solve(refined.equations.H[k], refined.equations.b[k])
        y = np.linalg.solve(there.equations.H[k], there.equations.b[k])
        np.testing.assert_allclose(y, np.kron(np.eye(2), A[:3, :3]) @ x, rtol=1e-4, atol=1e-7)
