"""Bags as the GrAco dataset has them, written from scenes whose points are known."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mtpcr_geo.benchmark import graco
from mtpcr_geo.core import transforms

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
