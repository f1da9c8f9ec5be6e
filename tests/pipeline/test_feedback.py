"""A vertical that the refinement found, fed back: when a second search bears it out."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core.fits import IcpResult, IcpTrial, Refinement
from mtpcr_geo.pipeline.stages.feedback import CLOSER, borne_out


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
