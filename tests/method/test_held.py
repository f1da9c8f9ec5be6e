"""A refinement that slid is held to the tie points in plan and yaw, and keeps its height and tilt."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.fits import IcpResult, IcpTrial, Refinement
from mtpcr_geo.method.held import held_to_tie_points

PIVOT = np.array([120.0, -40.0, 8.0])
BEFORE = transforms.compose(transforms.yaw_matrix(0.8), np.array([5.0, 7.0, 2.0]))


def refined(plan: float, yaw_deg: float, tilt_deg: float, rise: float) -> Refinement:
    R = transforms.tilt_matrix(0.4, np.radians(tilt_deg)) @ transforms.yaw_matrix(np.radians(yaw_deg))
    place = transforms.apply(BEFORE, PIVOT[None])[0]
    after = place + [0.6 * plan, 0.8 * plan, rise]
    return Refinement(transforms.compose(R, after - R @ place) @ BEFORE, BEFORE)


@pytest.mark.parametrize("R_level", [np.eye(3), transforms.tilt_matrix(1.0, np.radians(80.0))])
def test_plan_and_yaw_go_back_and_height_and_tilt_stay(R_level: np.ndarray) -> None:
    T_work_level = transforms.compose(R_level.T, np.zeros(3))
    # the same in levelled axes as in work axes that lie on their side
    upright = refined(0.7, 0.3, 1.5, 0.2)
    found = Refinement(T_work_level @ upright.T, T_work_level @ upright.T_before)
    held = held_to_tie_points(found, PIVOT, R_level, 0.25)
    assert held.slid_m == pytest.approx(0.7)
    T = transforms.inverse(T_work_level) @ held.T
    start, end = (transforms.apply(one, PIVOT[None])[0] for one in (BEFORE, T))
    assert end == pytest.approx(start + [0.0, 0.0, 0.2], abs=1e-9)
    turned = T[:3, :3] @ BEFORE[:3, :3].T
    assert transforms.yaw_of(turned) == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(transforms.rotation_angle(turned)) == pytest.approx(1.5, abs=1e-3)


def test_what_stays_near_the_tie_points_is_left_as_it_is() -> None:
    found = refined(0.2, 0.3, 1.5, 3.0)
    assert held_to_tie_points(found, PIVOT, np.eye(3), 0.25) is found


@pytest.mark.parametrize(("after", "held"), [(0.20, True), (0.18, True), (0.12, False)])
def test_surfaces_that_meet_clearly_better_have_not_slid(after: float, held: bool) -> None:
    found = refined(0.7, 0.3, 1.5, 0.2)
    tried = {
        "tie_points": IcpTrial(0.22, 9),
        "ground": IcpTrial(0.20, 9),
        "near": IcpTrial(after, 9),
    }
    icp = IcpResult(found.T, "gicp", 0.5, 900, 900, tried, "near", followed=True, lost_tie_points=False)
    found = Refinement(found.T, found.T_before, icp=icp)
    assert (held_to_tie_points(found, PIVOT, np.eye(3), 0.25).slid_m is not None) is held
