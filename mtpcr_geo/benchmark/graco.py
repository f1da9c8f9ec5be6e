"""The GrAco dataset: bags of ROS 1 and ROS 2 as de-skewed clouds in its common frame (``rosbags``).

Y. Zhu and others: GRACO, a multimodal dataset for ground and aerial cooperative localization and mapping
(IEEE Robotics and Automation Letters, 2023). Each point is placed by the ground truth at its own time::

    p_world = T_world_imu(stamp + time) T_imu_lidar p_lidar

The frame is east, north, up about the base station, shared by all sequences. On the UAV both sensors are
tipped by 90 degrees; nothing here takes the lidar's z for up.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from mtpcr_geo.benchmark.published import COMBINATIONS, Combination
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import InputError, MissingPartError
from mtpcr_geo.core.voxels import first_in_voxels

POINTS_TOPIC = "/velodyne/points"
TRUTH_TOPIC = "/gnss/ground_truth"
LARGEST_GAP_S = 0.25
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_PLACES = {"A": "aerial", "G": "ground"}
_FARTHEST_M = 1e8
_THIN_AT = 4_000_000
_DAMAGES = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    sqlite3.Error,
    struct.error,
)
"""What rosbags raises besides its own errors where a bag is damaged: it trusts lengths and names in it."""


@dataclass(frozen=True)
class Trajectory:
    """Where the IMU was.

    Attributes:
        time: (n,) seconds since the epoch, rising.
        position: (n, 3) metres in the common frame.
        rotation: its attitude at the same times, IMU to common frame.

    """

    time: Floats
    position: Floats
    rotation: Rotation

    def at(self, time: Floats) -> tuple[Rotation, Floats]:
        """Interpolate at (k,) seconds within the trajectory: spherically for attitude, linearly for place."""
        places = np.stack([np.interp(time, self.time, self.position[:, k]) for k in range(3)], axis=1)
        return Slerp(self.time, self.rotation)(time), places

    def covers(self, time: Floats) -> Mask:
        """Return which of (k,) times lie between two poses that are not too far apart to interpolate."""
        after = np.searchsorted(self.time, time, side="left")
        known = (time >= self.time[0]) & (time <= self.time[-1])
        after = np.clip(after, 1, len(self.time) - 1)
        return np.asarray(known & (self.time[after] - self.time[after - 1] <= LARGEST_GAP_S))


def combinations() -> tuple[Combination, ...]:
    """Return the paper's fourteen combinations."""
    return COMBINATIONS


def find_sequence(root: Path, name: str) -> Path:
    """Find a sequence's bag by the paper's name: "A03" is ``aerial-03`` (any separator, or none).

    Args:
        root: folder that holds bags, at any depth: ``.bag`` files, or folders with ``metadata.yaml``.
        name: such as "A03" or "G05".

    Raises:
        InputError: if it is not there, or more than one bag fits.

    """
    place, number = _PLACES[name[0].upper()], int(name[1:])
    fits = re.compile(rf"{place}[-_ ]?0*{number}(?!\d)", re.IGNORECASE)
    bags = [*Path(root).rglob("*.bag"), *(path.parent for path in Path(root).rglob("metadata.yaml"))]
    found = sorted({bag for bag in bags if fits.search(bag.stem if bag.is_file() else bag.name)})
    if not found:
        raise InputError(f"no bag for {name} below {root}; its file or folder is named {place}-{number:02d}")
    if len(found) > 1:
        raise InputError(f"{len(found)} bags for {name} below {root}: {', '.join(map(str, found))}; keep one")
    return found[0]


def find_calibration(root: Path, name: str) -> Path:
    """Find ``imu-lidar.yaml`` of a sequence: the one below a folder named ground or aerial.

    Raises:
        InputError: if there is none, or more than one.

    """
    place = _PLACES[name[0].upper()]
    found = sorted(
        path
        for path in Path(root).rglob("imu-lidar.yaml")
        if any(place in part.lower() for part in path.relative_to(root).parts[:-1])
    )
    if len(found) != 1:
        raise InputError(
            f"{len(found)} files imu-lidar.yaml in folders named {place} below {root}; one is needed"
        )
    return found[0]


def read_calibration(path: Path, key: str = "T_Imu_Lidar") -> Floats:
    """Read a 4x4 from a calibration file: sixteen numbers, row by row, in ``data`` under a key.

    The files come as plain YAML and as OpenCV's, whose header YAML readers refuse; so they are read as text.

    Raises:
        InputError: if it is not there, or not a rigid transform.

    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read the calibration {path}: {error.strerror}") from error
    found = re.search(rf"{key}\s*:.*?data\s*:\s*\[(.*?)\]", text, re.DOTALL)
    numbers = re.split(r"[\s,]+", re.sub(r"#[^\n]*", "", found[1]).strip()) if found else []
    try:
        T = np.array([float(number) for number in numbers if number], np.float64).reshape(4, 4)
    except ValueError as error:
        raise InputError(f"{path} has no sixteen numbers in 'data' under {key}") from error
    R = T[:3, :3]
    # printed with a few digits only: near a rotation, and made one
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise InputError(f"{key} in {path} is not a rigid transform")
    return transforms.compose(transforms.orthonormal(R), T[:3, 3])


def read_sequence(
    bag: Path,
    T_imu_lidar: Floats,
    *,
    voxel_m: float = 0.1,
    every: int = 1,
    range_m: tuple[float, float] = (1.0, 120.0),
    points_topic: str = POINTS_TOPIC,
    truth_topic: str = TRUTH_TOPIC,
) -> Floats:
    """Read a sequence as one cloud in the common frame, each point at its own time.

    Args:
        bag: a ROS 1 ``.bag`` file or a ROS 2 folder.
        T_imu_lidar: 4x4, lidar to IMU.
        voxel_m: thinned to the first point in each voxel of this edge, metres; 0 keeps all.
        every: use each n-th scan.
        range_m: nearest and farthest range kept, metres.
        points_topic, truth_topic: topics of PointCloud2 and Odometry.

    Returns:
        (n, 3) float64 metres: east, north, up.

    Raises:
        InputError: if the bag cannot be read or lacks a topic.
        MissingPartError: if ``rosbags`` is not installed.

    """
    with _open(bag) as reader:
        path = _trajectory(reader, bag, truth_topic)
        parts: list[Floats] = []
        held = 0
        limit = _THIN_AT
        for number, message in enumerate(_messages(reader, bag, points_topic)):
            if number % every:
                continue
            xyz, time = points_of(message)
            distance = np.linalg.norm(xyz, axis=1)
            keep = (distance >= range_m[0]) & (distance <= range_m[1]) & path.covers(time)
            parts.append(place(xyz[keep], time[keep], path, T_imu_lidar))
            if not (np.abs(parts[-1]) < _FARTHEST_M).all():
                raise InputError(f"{bag} is damaged: {truth_topic} holds poses that are no places on earth")
            held += len(parts[-1])
            if voxel_m > 0 and held > limit:
                parts = [_thinned(np.concatenate(parts), voxel_m)]
                held = len(parts[0])
                limit = held + _THIN_AT
    if not held:
        raise InputError(f"{bag} holds no points on {points_topic} at times that {truth_topic} covers")
    cloud = np.concatenate(parts)
    return _thinned(cloud, voxel_m) if voxel_m > 0 else cloud


def place(xyz: Floats, time: Floats, path: Trajectory, T_imu_lidar: Floats) -> Floats:
    """De-skew: take lidar points (n, 3) of times (n,) to the common frame, (n, 3) metres."""
    if not len(xyz):
        return np.empty((0, 3))
    moments, which = np.unique(time, return_inverse=True)
    rotation, position = path.at(moments)
    in_imu = transforms.apply(T_imu_lidar, xyz)
    R = rotation.as_matrix()[which]
    return np.asarray(np.einsum("nij,nj->ni", R, in_imu) + position[which])


def points_of(message: Any) -> tuple[Floats, Floats]:
    """Unpack a PointCloud2: finite points (n, 3) in the sensor's frame, and their times (n,), seconds.

    A field ``time`` (seconds relative to the stamp) is used where there is one.

    Raises:
        InputError: if the message holds less than it says.

    """
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: (order + _TYPES[field.datatype], field.offset) for field in message.fields}
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [form for form, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": message.point_step,
        }
    )
    raw = np.ascontiguousarray(message.data, np.uint8).tobytes()
    used = message.width * message.point_step
    if used > message.row_step or message.height * message.row_step > len(raw):
        raise InputError(
            f"a scan of {message.height} x {message.width} points of {message.point_step} bytes has "
            f"{len(raw)} bytes of data"
        )
    rows = [raw[r * message.row_step : r * message.row_step + used] for r in range(message.height)]
    table = np.frombuffer(b"".join(rows), layout)
    xyz = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    time = np.full(len(table), stamp)
    if "time" in fields:
        time += table["time"].astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1) & np.isfinite(time)
    return xyz[finite], time[finite]


def _trajectory(reader: Any, bag: Path, topic: str) -> Trajectory:
    time, position, quaternion = [], [], []
    for message in _messages(reader, bag, topic):
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        time.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
        position.append((at.x, at.y, at.z))
        quaternion.append((turn.x, turn.y, turn.z, turn.w))
    # a stamp that comes twice would leave nothing to interpolate between
    moments, first = np.unique(np.array(time), return_index=True)
    if len(moments) < 2:
        raise InputError(f"{bag} holds {len(moments)} poses on {topic}; at least two are needed")
    return Trajectory(moments, np.array(position)[first], Rotation.from_quat(np.array(quaternion)[first]))


def _messages(reader: Any, bag: Path, topic: str) -> Iterator[Any]:
    wanted = [connection for connection in reader.connections if connection.topic == topic]
    if not wanted:
        topics = ", ".join(sorted({connection.topic for connection in reader.connections}))
        raise InputError(f"{bag} has no topic {topic}; it has {topics}")
    for connection, _, raw in reader.messages(connections=wanted):
        yield reader.deserialize(raw, connection.msgtype)


@contextmanager
def _open(bag: Path) -> Iterator[Any]:
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, TypesysError, get_typestore
    except ImportError as error:
        raise MissingPartError(
            "GrAco's bags need rosbags, which is not installed; run pip install 'mtpcr-geo[graco]'"
        ) from error
    damages: tuple[type[Exception], ...] = (
        AnyReaderError,
        rosbag1.ReaderError,
        rosbag2.ReaderError,
        TypesysError,
        *_DAMAGES,
    )
    with suppress(ImportError):  # what newer rosbags read SQLite with
        import apsw

        damages += (apsw.Error,)
    try:
        # older ROS 2 bags do not hold the definitions of their messages
        with AnyReader([Path(bag)], default_typestore=get_typestore(Stores.ROS2_FOXY)) as reader:
            yield reader
    except damages as error:
        raise InputError(f"cannot read the bag {bag}: {error or type(error).__name__}") from error


def _thinned(xyz: Floats, voxel: float) -> Floats:
    # a lattice from the origin, so that thinning twice leaves what thinning once does
    return np.asarray(xyz[first_in_voxels(xyz, voxel, np.zeros(3))])
