"""A robot of `understudy.robot` as the adaptation sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.platform import Arm, JointPath, Platform, Reachability
from understudy.robot.model import Robot

if TYPE_CHECKING:
    from understudy.robot.ik_path import IKPath


def platform_of(robot: Robot, reachability: Reachability | None = None) -> Platform:
    """The platform of a robot. Without a reachability field, the robot's own is loaded (or built, once)."""
    from understudy.robot import solve_ik

    if reachability is None:
        from understudy.robot import load_field

        reachability = load_field(robot)

    def achievable(T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        return solve_ik(robot, T_base_tool, torso=torso).success

    def path(
        T_base_tool: Float[np.ndarray, "t 4 4"],
        torso: Float[np.ndarray, " t"],
        times_s: Float[np.ndarray, " t"],
        *,
        thorough: bool,
    ) -> JointPath:
        return _joint_path(robot, T_base_tool, torso, times_s, thorough)

    d = robot.description
    return Platform(
        name=d.name,
        footprint=d.footprint,
        torso_limits=robot.torso_limits,
        base_velocity=d.limits.base_velocity,
        base_acceleration=d.limits.base_acceleration,
        torso_velocity=d.limits.torso_velocity,
        opening_m=d.gripper.opening_m,
        reachability=reachability,
        achievable=achievable,
        arm=Arm(robot.velocity, d.limits.arm_acceleration, path),
    )


def _joint_path(
    robot: Robot, T: Float[np.ndarray, "t 4 4"], torso: Float[np.ndarray, " t"], times_s: np.ndarray, thorough: bool
) -> JointPath:
    from understudy.robot.ik_bridge import bridged
    from understudy.robot.ik_follow import follow_ik_path
    from understudy.robot.ik_path import solve_ik_path

    found = follow_ik_path(robot, T, torso, times_s)
    if thorough and found.jumps:
        found = bridged(robot, found, T)
    if thorough and _breaks(found):
        other = bridged(robot, solve_ik_path(robot, T, torso, times_s), T)
        if _breaks(other) < _breaks(found):
            found = other
    linked = found.success[1:] & found.success[:-1]
    linked[[i - 1 for i in found.jumps]] = False
    return JointPath(found.q, found.success, linked)


def _breaks(path: IKPath) -> int:
    return len(path.jumps) + int((~path.success).sum())
