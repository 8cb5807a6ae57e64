"""Motions for a real robot: `trajectory_msgs/JointTrajectory` in a ROS 2 bag (MCAP), and back.

One message on one topic: base_x, base_y, base_yaw (map frame: metres, radians), torso, arm, and the gripper's first
joint, with positions and velocities. Whoever plays it must keep the closed loop on the handle: played blindly, it
opens only what stands exactly where it was observed.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from understudy.errors import MissingExtraError, RecordingError, UnderstudyError
from understudy.execution.outcome import Trajectory
from understudy.robot.description import RobotDescription
from understudy.robot.urdf import BASE_JOINTS

TOPIC: Final = "/joint_trajectory"
_TYPE: Final = "trajectory_msgs/msg/JointTrajectory"
_SECOND: Final = 1_000_000_000


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joints over time."""

    names: tuple[str, ...]
    times_s: Float[np.ndarray, " t"]
    """from the start"""
    positions: Float[np.ndarray, "t k"]
    """metres, radians"""
    velocities: Float[np.ndarray, "t k"]


def joint_path(trajectory: Trajectory, robot: RobotDescription) -> JointPath:
    """The commanded joints of an execution. Velocities are central differences of what was commanded.

    Raises UnderstudyError for a trajectory of fewer than two samples.
    """
    t = trajectory
    if len(t.times_s) < 2:
        raise UnderstudyError(f"a joint trajectory needs two samples at least, got {len(t.times_s)}")
    gripper = robot.gripper
    closed = np.array([[gripper.joint_value(max(0.0, float(o)))] for o in t.opening_m])
    lift = [t.torso[:, None]] if robot.torso_joint else []
    names = (*BASE_JOINTS, *([robot.torso_joint] if robot.torso_joint else []), *robot.arm_joints, gripper.joints[0])
    positions = np.concatenate([t.base, *lift, t.q, closed], axis=1)
    times = t.times_s - t.times_s[0]
    return JointPath(names, times, positions, np.gradient(positions, times, axis=0))


def write_bag(folder: Path, path: JointPath, frame: str = "map") -> None:
    """A bag folder (metadata.yaml and an .mcap file), whole or not at all.

    Raises UnderstudyError if the folder exists, MissingExtraError without the package rosbags.
    """
    store, bags = _rosbags()
    folder = Path(folder)
    if folder.exists():
        raise UnderstudyError(f"{folder}: is there already: a bag is written to a new folder")
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), frame)
    points = [
        types["trajectory_msgs/msg/JointTrajectoryPoint"](
            positions=np.ascontiguousarray(x, float),
            velocities=np.ascontiguousarray(v, float),
            accelerations=np.zeros(0),
            effort=np.zeros(0),
            time_from_start=_duration(types, t),
        )
        for t, x, v in zip(path.times_s, path.positions, path.velocities, strict=True)
    ]
    message = types[_TYPE](header=header, joint_names=list(path.names), points=points)
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        with bags.Writer(beside / "bag", version=9, storage_plugin=bags.StoragePlugin.MCAP) as writer:
            connection = writer.add_connection(TOPIC, _TYPE, typestore=store)
            writer.write(connection, 0, store.serialize_cdr(message, _TYPE))
        os.replace(beside / "bag", folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def read_bag(folder: Path) -> JointPath:
    """The inverse of `write_bag`. Raises RecordingError for a bag without a joint trajectory."""
    store, bags = _rosbags()
    try:
        with bags.Reader(Path(folder)) as reader:
            wanted = [c for c in reader.connections if c.topic == TOPIC and c.msgtype == _TYPE]
            raw = next((data for _, _, data in reader.messages(connections=wanted)), None) if wanted else None
    except (bags.ReaderError, OSError) as e:
        raise RecordingError(f"{folder}: not a ROS 2 bag: {e}") from e
    if raw is None:
        raise RecordingError(f"{folder}: no {_TYPE} on the topic {TOPIC}")
    message = store.deserialize_cdr(raw, _TYPE)
    times = [p.time_from_start.sec + p.time_from_start.nanosec / _SECOND for p in message.points]
    k = len(message.joint_names)
    return JointPath(
        tuple(message.joint_names),
        np.array(times, float),
        np.array([p.positions for p in message.points]).reshape(-1, k),
        np.array([p.velocities for p in message.points]).reshape(-1, k),
    )


def _duration(types: Any, seconds: float) -> Any:
    whole = round(seconds * _SECOND)
    return types["builtin_interfaces/msg/Duration"](whole // _SECOND, whole % _SECOND)


def _rosbags() -> tuple[Any, Any]:
    try:
        from rosbags import rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as e:
        raise MissingExtraError("ROS bags", "ros") from e
    return get_typestore(Stores.ROS2_HUMBLE), rosbag2
