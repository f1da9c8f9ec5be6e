from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mtpcr_geo.benchmark import graco
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed (extra graco)")

STAMP = 1_650_000_000.0
SECONDS, SCANS = 2.0, 20
# what the dataset reports for the UAV, and a sensor on its side
TIPPED = transforms.compose(
    Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.array([-0.024, -0.005, 0.180])
)
UPRIGHT = transforms.compose(np.eye(3), np.array([-0.012, -0.020, 0.123]))


def true_pose(time: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """A curve flown while turning: where the IMU is at (n,) seconds since the start."""
    place = np.stack([8 * time, 3 * np.sin(time), 40 + 0.5 * time], axis=1)
    turn = Rotation.from_euler("ZYX", np.stack([0.9 * time, 0.1 * np.sin(3 * time), 0.05 * time], axis=1))
    return turn, place


def seen(T_imu_lidar: np.ndarray, seed: int) -> tuple[np.ndarray, list[tuple[float, np.ndarray, np.ndarray]]]:
    """World points, and the scans in which a moving sensor sees them: stamp, lidar xyz, relative times."""
    rng = np.random.default_rng(seed)
    world, scans = [], []
    for k in range(SCANS):
        n = 400
        relative = np.sort(rng.uniform(-0.002, 0.098, n)).astype(np.float32)
        points = np.c_[rng.uniform(-20, 60, (n, 2)), rng.uniform(0, 12, n)]
        stamp = 0.1 * k + 0.01
        turn, place = true_pose(stamp + relative.astype(np.float64))
        in_imu = turn.inv().apply(points - place)
        scans.append((stamp, transforms.apply(transforms.inverse(T_imu_lidar), in_imu), relative))
        world.append(points)
    return np.concatenate(world), scans


def write_bag(path, version: int, scans) -> None:
    """Write Odometry at 200 Hz and PointCloud2 with the fields of a VLP-16."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_FOXY)
    kind = store.types
    sequence = {"seq": 0} if version == 1 else {}

    def header(time: float, frame: str):
        whole = int(np.floor(STAMP + time))
        stamp = kind["builtin_interfaces/msg/Time"](whole, round((STAMP + time - whole) * 1e9))
        return kind["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **sequence)

    point, vector = kind["geometry_msgs/msg/Point"], kind["geometry_msgs/msg/Vector3"]
    field = kind["sensor_msgs/msg/PointField"]
    layout = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)]
    fields = [field(name, offset, datatype, 1) for name, offset, datatype in layout]
    zeros = np.zeros(36)
    messages = []
    for time in np.arange(-0.05, SECONDS + 0.3, 0.005):
        turn, place = true_pose(np.array([time]))
        pose = kind["geometry_msgs/msg/Pose"](
            point(*place[0].tolist()), kind["geometry_msgs/msg/Quaternion"](*turn[0].as_quat().tolist())
        )
        twist = kind["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        odometry = kind["nav_msgs/msg/Odometry"](
            header(time, "enu"),
            "imu",
            kind["geometry_msgs/msg/PoseWithCovariance"](pose, zeros),
            kind["geometry_msgs/msg/TwistWithCovariance"](twist, zeros),
        )
        messages.append((time, graco.TRUTH_TOPIC, odometry))
    for stamp, xyz, relative in scans:
        table = np.zeros(
            len(xyz) + 1,
            {
                "names": ["x", "y", "z", "ring", "time"],
                "formats": ["<f4", "<f4", "<f4", "<u2", "<f4"],
                "offsets": [0, 4, 8, 16, 18],
                "itemsize": 22,
            },
        )
        for k, axis in enumerate("xyz"):
            table[axis][:-1] = xyz[:, k]
        table["time"][:-1] = relative
        table["x"][-1] = np.nan  # a beam that met nothing
        data = np.frombuffer(table.tobytes(), np.uint8)
        cloud = kind["sensor_msgs/msg/PointCloud2"](
            header(stamp, "velodyne"), 1, len(table), fields, False, 22, 22 * len(table), data, False
        )
        messages.append((stamp, graco.POINTS_TOPIC, cloud))
    messages.sort(key=lambda entry: entry[0])
    if version == 1:
        from rosbags.rosbag1 import Writer

        writer, encode = Writer(path), store.serialize_ros1
    else:
        from rosbags.rosbag2 import Writer

        writer, encode = Writer(path, version=9), store.serialize_cdr
    with writer:
        links = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, name in (
                (graco.TRUTH_TOPIC, "nav_msgs/msg/Odometry"),
                (graco.POINTS_TOPIC, "sensor_msgs/msg/PointCloud2"),
            )
        }
        for time, topic, message in messages:
            writer.write(links[topic], round((STAMP + time) * 1e9), encode(message, message.__msgtype__))


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
