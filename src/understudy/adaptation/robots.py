"""A robot of `understudy.robot` as the adaptation sees it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.platform import Platform, Reachability
from understudy.robot.model import Robot


def platform_of(robot: Robot, reachability: Reachability | None = None) -> Platform:
    """The platform of a robot. Without a reachability field, the robot's own is loaded (or built, once)."""
    from understudy.robot import solve_ik

    if reachability is None:
        from understudy.robot import load_field

        reachability = load_field(robot)

    def achievable(T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        return solve_ik(robot, T_base_tool, torso=torso).success

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
    )
