"""Plots of 25 m through `mtpcr_geo.register`: two samplings, any start, are accepted and right."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_plots import plot

import mtpcr_geo as mg
from mtpcr_geo.core import transforms

CORNERS = np.array([[12.0, 12, 0], [-12, 12, 0], [-12, -12, 0], [12, -12, 10]])


def off(T: np.ndarray, T_moved: np.ndarray) -> float:
    """Farthest that a corner of the plot comes to lie from where it belongs, metres."""
    return float(np.linalg.norm(transforms.apply(T @ T_moved, CORNERS) - CORNERS, axis=1).max())


@pytest.mark.parametrize(("yaw_deg", "density"), [(20.0, 60.0), (215.0, 200.0)])
def test_a_plot_is_accepted_and_right(yaw_deg: float, density: float) -> None:
    rng = np.random.default_rng(8)
    T_moved = transforms.compose(transforms.yaw_matrix(np.radians(yaw_deg)), np.array([40.0, -15.0, 3.0]))
    source, target = transforms.apply(T_moved, plot(rng, density=density)), plot(rng, density=density)
    found = mg.register(source, target)
    assert found.verdict.name == "accepted"
    assert found.T_target_source is not None
    assert off(found.T_target_source, T_moved) < 0.02
    assert found.verdict.metrics["null_ratio"] > 1.6
    assert found.verdict.metrics["overlap_m2"] == pytest.approx(625.0, rel=0.1)


def test_a_scan_is_found_in_an_airborne_cloud_of_the_plot() -> None:
    rng = np.random.default_rng(9)
    ground_scan = plot(rng, density=150.0)
    near = ground_scan[np.hypot(*ground_scan[:, :2].T) < 10.0]
    T_moved = transforms.compose(transforms.yaw_matrix(np.radians(130.0)), np.array([5.0, 30.0, -2.0]))
    found = mg.register(transforms.apply(T_moved, near), plot(rng, density=20.0))
    assert found.verdict.name == "accepted"
    assert found.T_target_source is not None
    assert off(found.T_target_source, T_moved) < 0.05


@pytest.mark.slow
def test_a_plot_of_other_trees_is_never_accepted() -> None:
    rng = np.random.default_rng(10)
    target = plot(rng, 36.0, 40.0)
    # two plots of one forest that share nothing
    west, east = target[target[:, 0] < -5.0], target[target[:, 0] > 5.0]
    found = mg.register(west, east)
    assert found.verdict.name != "accepted"


def test_too_few_square_metres_are_never_accepted() -> None:
    rng = np.random.default_rng(2)
    found = mg.register(rng.uniform(0.0, 6.0, (500, 3)), rng.uniform(0.0, 6.0, (500, 3)))
    assert found.verdict.name == "refused"
    assert found.verdict.reasons
