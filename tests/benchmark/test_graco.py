from __future__ import annotations

import numpy as np
import pytest
from helpers_bags import TIPPED, UPRIGHT, seen, write_bag
from scipy.spatial.transform import Rotation

from mtpcr_geo.benchmark import graco
from mtpcr_geo.core.errors import InputError

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed (extra graco)")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(("name", "T_imu_lidar"), [("aerial-03", TIPPED), ("ground-05", UPRIGHT)])
def test_bag_comes_out_as_the_cloud_it_was_made_from(tmp_path, version, name, T_imu_lidar):
    world, scans = seen(T_imu_lidar, version)
    write_bag(tmp_path / (f"{name}.bag" if version == 1 else name), version, scans)
    short = name[0].upper() + name[-2:]
    bag = graco.find_sequence(tmp_path, short)
    cloud = graco.read_sequence(bag, T_imu_lidar, voxel_m=0.0, range_m=(0.0, 200.0))
    assert cloud.shape == world.shape
    assert np.linalg.norm(cloud - world, axis=1).max() < 0.01
    # without the times of single points it would be off by decimetres
    still = [(stamp, xyz, np.zeros_like(relative)) for stamp, xyz, relative in scans]
    write_bag(tmp_path / "skewed.bag", 1, still)
    skewed = graco.read_sequence(tmp_path / "skewed.bag", T_imu_lidar, voxel_m=0.0, range_m=(0.0, 200.0))
    assert np.linalg.norm(skewed - world, axis=1).max() > 0.5


def test_thinning_keeps_a_point_a_voxel_and_far_points_go(tmp_path):
    _, scans = seen(TIPPED, 3)
    write_bag(tmp_path / "aerial-01.bag", 1, scans)
    full = graco.read_sequence(tmp_path / "aerial-01.bag", TIPPED, voxel_m=0.0)
    thin = graco.read_sequence(tmp_path / "aerial-01.bag", TIPPED, voxel_m=5.0)
    assert len(thin) == len(np.unique(np.floor(full / 5.0), axis=0))
    near = graco.read_sequence(tmp_path / "aerial-01.bag", TIPPED, voxel_m=0.0, range_m=(1.0, 45.0))
    assert 0 < len(near) < len(full)
    half = graco.read_sequence(tmp_path / "aerial-01.bag", TIPPED, voxel_m=0.0, every=2)
    assert len(half) == pytest.approx(len(full) / 2, rel=0.05)


def test_sequences_and_calibrations_are_found_by_name(tmp_path):
    for name in ("ground/ground-05.bag", "ground/Ground_15.bag", "aerial/aerial-05/metadata.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert graco.find_sequence(tmp_path, "G05").name == "ground-05.bag"
    assert graco.find_sequence(tmp_path, "A05").name == "aerial-05"
    with pytest.raises(InputError, match="no bag for A01"):
        graco.find_sequence(tmp_path, "A01")
    (tmp_path / "ground_05.bag").touch()
    with pytest.raises(InputError, match="2 bags"):
        graco.find_sequence(tmp_path, "G05")
    with pytest.raises(InputError, match="imu-lidar"):
        graco.find_calibration(tmp_path, "G05")
    (tmp_path / "aerial" / "imu-lidar.yaml").touch()
    assert graco.find_calibration(tmp_path, "A05").parent.name == "aerial"


@pytest.mark.parametrize("header", ["", "%YAML:1.0\n---\n"])
def test_calibration_is_read_whatever_its_header(tmp_path, header):
    numbers = ", ".join(f"{x:.7f}" for x in TIPPED.ravel())
    other = "T_Imu_Cam:\n  data: [1, 2, 3]\n"
    path = tmp_path / "imu-lidar.yaml"
    path.write_text(f"{header}T_Imu_Lidar: !!opencv-matrix\n  rows: 4\n  data: [{numbers}]\n{other}")
    assert np.allclose(graco.read_calibration(path), TIPPED, atol=1e-6)
    path.write_text(f"{header}{other}")
    with pytest.raises(InputError, match="sixteen"):
        graco.read_calibration(path)


def test_bags_without_a_topic_or_of_another_kind_are_refused(tmp_path):
    write_bag(tmp_path / "a.bag", 1, seen(UPRIGHT, 4)[1][:1])
    with pytest.raises(InputError, match="no topic /lidar; it has /gnss/ground_truth, /velodyne/points"):
        graco.read_sequence(tmp_path / "a.bag", UPRIGHT, points_topic="/lidar")
    (tmp_path / "b.bag").write_bytes(b"no bag at all")
    with pytest.raises(InputError, match="cannot read the bag"):
        graco.read_sequence(tmp_path / "b.bag", UPRIGHT)


def test_poses_too_far_apart_are_not_bridged():
    time = np.array([0.0, 0.1, 0.9, 1.0])
    path = graco.Trajectory(time, np.zeros((4, 3)), Rotation.identity(4))
    assert path.covers(np.array([-0.1, 0.0, 0.05, 0.5, 0.95, 1.0, 1.1])).tolist() == [
        False, True, True, False, True, True, False
    ]  # fmt: skip


def test_fourteen_combinations():
    names = [c.name for c in graco.combinations()]
    assert len(names) == len(set(names)) == 14
    assert [sum(c.group == g for c in graco.combinations()) for g in ("A-G", "G-G", "A-A")] == [8, 3, 3]
