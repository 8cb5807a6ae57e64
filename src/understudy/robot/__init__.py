"""Robots: description, kinematics, inverse kinematics and reachability (docs/robot.md).

Everything is imported when it is first asked for: `import understudy.robot` needs neither Pinocchio nor numba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from understudy.late import late_names
from understudy.robot.description import (
    ROBOTS,
    Gripper,
    Limits,
    RobotDescription,
    RobotError,
    load_description,
    parse_description,
)

if TYPE_CHECKING:
    from understudy.robot.ik import IKResult as IKResult
    from understudy.robot.ik import solve_ik as solve_ik
    from understudy.robot.ik_follow import follow_ik_path as follow_ik_path
    from understudy.robot.ik_path import IKPath as IKPath
    from understudy.robot.ik_path import solve_ik_path as solve_ik_path
    from understudy.robot.model import Robot as Robot
    from understudy.robot.model import load_robot as load_robot
    from understudy.robot.reachability import ReachabilityField as ReachabilityField
    from understudy.robot.reachability import ReachabilityMap as ReachabilityMap
    from understudy.robot.reachability import load_field as load_field
    from understudy.robot.reachability import load_map as load_map
    from understudy.robot.urdf import urdf_with_base as urdf_with_base

_LATE = {
    "Robot": "model",
    "load_robot": "model",
    "urdf_with_base": "urdf",
    "IKResult": "ik",
    "solve_ik": "ik",
    "follow_ik_path": "ik_follow",
    "IKPath": "ik_path",
    "solve_ik_path": "ik_path",
    "ReachabilityField": "reachability",
    "ReachabilityMap": "reachability",
    "load_field": "reachability",
    "load_map": "reachability",
}
_NEEDED = ("numba", "pinocchio")

__all__ = [
    "ROBOTS",
    "Gripper",
    "IKPath",
    "IKResult",
    "Limits",
    "ReachabilityField",
    "ReachabilityMap",
    "Robot",
    "RobotDescription",
    "RobotError",
    "follow_ik_path",
    "load_description",
    "load_field",
    "load_map",
    "load_robot",
    "parse_description",
    "solve_ik",
    "solve_ik_path",
    "urdf_with_base",
]

__getattr__ = late_names(__name__, _LATE, _NEEDED, "robots", "robot")
