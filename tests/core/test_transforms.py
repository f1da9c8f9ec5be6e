from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mtpcr_geo.core import transforms

angles = st.floats(-np.pi, np.pi)


@given(angles, angles, st.floats(-0.5, 0.5))
@settings(max_examples=50)
def test_inverse_undoes_a_transform(yaw: float, azimuth: float, tilt: float) -> None:
    T = transforms.compose(
        transforms.yaw_matrix(yaw) @ transforms.tilt_matrix(azimuth, tilt), np.array([3.0, -7.0, 2.0])
    )
    assert np.allclose(transforms.inverse(T) @ T, np.eye(4), atol=1e-14)


def test_a_pivot_stays_where_it_is_however_far_out() -> None:
    pivot = np.array([5e6, 4e6, 100.0])
    T = transforms.about(pivot, transforms.yaw_matrix(1.0))
    assert np.allclose(transforms.apply(T, pivot[None]), pivot, atol=1e-8)


@pytest.mark.parametrize("angle", [1e-9, 1e-6, 1e-3, 1.0, 3.0])
def test_rotation_angle_is_exact_for_tiny_angles_too(angle: float) -> None:
    assert transforms.rotation_angle(transforms.yaw_matrix(angle)) == pytest.approx(angle, rel=1e-9)


def test_orthonormal_gives_the_nearest_proper_rotation() -> None:
    R = transforms.yaw_matrix(0.4)
    assert np.allclose(transforms.orthonormal(R * 1.01), R)
    assert np.linalg.det(transforms.orthonormal(-np.eye(3))) == pytest.approx(1.0)


def test_bounds_are_those_of_the_columns() -> None:
    xyz = np.random.default_rng(0).normal(size=(50, 3))
    low, high = transforms.bounds(xyz)
    assert (low == xyz.min(axis=0)).all()
    assert (high == xyz.max(axis=0)).all()
