import numpy as np
import pytest

from mtpcr_geo.benchmark import metrics
from mtpcr_geo.core import transforms

EYE = np.eye(4)
SQUARE = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])


def turned(degrees: float, pivot=(0.0, 0.0, 0.0)) -> np.ndarray:
    return transforms.about(np.asarray(pivot), transforms.yaw_matrix(np.deg2rad(degrees)))


def test_a_true_result_has_no_error():
    T = turned(77.0) @ transforms.translation((1e5, 5e6, 12.0))
    errors = metrics.pose_errors(T, T, SQUARE, np.array([5e5, 5e6, 3.0]))
    assert errors.rotation_deg == 0
    assert errors.rmsd_m == errors.rms_m == errors.plan_m == errors.height_m == 0
    assert errors.translation_m < 1e-8
    assert errors.within(1e-9, 1e-6)


@pytest.mark.parametrize("degrees", [1e-7, 0.3, 90.0, 179.0, -30.0])
def test_rotation_error_is_the_angle_between(degrees):
    T_true = turned(200.0)
    assert metrics.rotation_error_deg(turned(degrees) @ T_true, T_true) == pytest.approx(
        abs(degrees), rel=1e-6
    )


def test_translation_error_is_taken_at_the_target():
    centre = np.array([500_000.0, 5_000_000.0, 100.0])
    about_centre = turned(1.0, centre)
    assert metrics.translation_error(about_centre, EYE, centre) < 1e-8
    ten_off = centre + np.array([10.0, 0, 0])  # chord of one degree at ten metres
    assert metrics.translation_error(about_centre, EYE, ten_off) == pytest.approx(0.174531, abs=1e-5)
    assert metrics.translation_error(transforms.translation((3.0, 4.0, 12.0)), EYE, centre) == pytest.approx(
        13.0
    )


def test_centroid_errors_tell_plan_from_height():
    plan, height = metrics.centroid_errors(transforms.translation((3.0, -4.0, -0.5)), EYE, np.zeros(3))
    assert (plan, height) == (5.0, -0.5)


def test_rmsd_is_the_mean_and_rms_the_root_mean_square():
    # half a turn about z: points on the axis stay, points 1 m from it move by 2 m
    source = np.array([[0.0, 0, 0], [0, 0, 5], [1, 0, 0], [-1, 0, 0]])
    assert metrics.rmsd(turned(180.0), EYE, source) == pytest.approx(1.0)
    assert metrics.rms(turned(180.0), EYE, source) == pytest.approx(np.sqrt(2.0))


def test_errors_do_not_change_when_all_lies_far_away():
    far = transforms.translation((4e6, 3e6, 500.0))
    T, T_true = turned(0.01) @ transforms.translation((0.1, 0, 0)), EYE
    near = metrics.pose_errors(T, T_true, SQUARE, np.zeros(3))
    away = metrics.pose_errors(far @ T, far @ T_true, SQUARE, far[:3, 3])
    assert away.rmsd_m == pytest.approx(near.rmsd_m, abs=1e-8)
    assert away.translation_m == pytest.approx(near.translation_m, abs=1e-8)
    assert away.plan_m == pytest.approx(0.1, abs=1e-8)


def test_within_needs_both():
    errors = metrics.PoseErrors(4.9, 2.1, 0, 0, 0, 0)
    assert not errors.within()
    assert errors.within(5.0, 3.0)


def test_overlap_ratios_of_two_strips():
    x, y = np.meshgrid(np.arange(10) + 0.5, np.arange(4) + 0.5)
    a = np.stack([x.ravel(), y.ravel()], 1)
    b = a[a[:, 0] < 5] + [8.0, 0.0]  # cells 8..12 against 0..9
    # cells 7, 8, 9 of a have a neighbour in b; cells 8, 9, 10 of b one in a
    assert metrics.overlap_ratios(a, b) == (3 / 10, 3 / 5)
    assert metrics.overlap_ratios(a, b + 1000.0) == (0.0, 0.0)
    assert metrics.overlap_ratios(a, b[:0]) == (0.0, 0.0)
