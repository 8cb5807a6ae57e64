"""A robot of `understudy.robot` as the adaptation sees it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.around import Surrounded
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
        surrounded: Surrounded | None,
        thorough: bool,
    ) -> JointPath:
        return joint_path(robot, T_base_tool, torso, times_s, surrounded, thorough)

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


def joint_path(
    robot: Robot,
    T: Float[np.ndarray, "t 4 4"],
    torso: Float[np.ndarray, " t"],
    times_s: Float[np.ndarray, " t"],
    surrounded: Surrounded | None,
    thorough: bool,
) -> JointPath:
    """The path with the fewest failures: samples without exact solution, jumps, samples at which the arm touches what
    is around. thorough: searches go on until there are none; the first keeps clear, the last does not look around.
    """
    best: JointPath | None = None
    for path in _found(robot, T, torso, times_s, surrounded):
        joints = _judged(robot, path, surrounded)
        if best is None or _failures(joints) < _failures(best):
            best = joints
        if not thorough or not _failures(best):
            break
    assert best is not None
    return best


def _found(
    robot: Robot,
    T: Float[np.ndarray, "t 4 4"],
    torso: Float[np.ndarray, " t"],
    times_s: Float[np.ndarray, " t"],
    surrounded: Surrounded | None,
) -> Iterator[IKPath]:
    """Joint paths, from searches that take longer and longer."""
    from understudy.adaptation.clearance import GuardedRobot
    from understudy.robot.ik_bridge import bridged
    from understudy.robot.ik_follow import follow_ik_path
    from understudy.robot.ik_path import solve_ik_path

    robots = [robot] if surrounded is None else [GuardedRobot(robot, surrounded, T), robot]
    quick = [follow_ik_path(robots[0], T, torso, times_s)]
    yield quick[0]
    if quick[0].jumps:
        yield bridged(robots[0], quick[0], T)
    for one in robots:
        yield bridged(one, solve_ik_path(one, T, torso, times_s), T)


def _judged(robot: Robot, path: IKPath, surrounded: Surrounded | None) -> JointPath:
    """What of a path is exact, and clear; a sample that a search gave up because something is there may be exact."""
    from understudy.adaptation.clearance import arm_clear
    from understudy.robot.ik import ANGLE_TOLERANCE, POSITION_TOLERANCE

    exact, t = path.success.copy(), len(path.q)
    near = (path.position_error <= POSITION_TOLERANCE) & (path.angle_error <= ANGLE_TOLERANCE)
    rows = np.flatnonzero(near & ~exact)
    if len(rows):
        exact[rows] = ~robot.collides(path.q[rows], path.torso[rows])
    linked = exact[1:] & exact[:-1]
    linked[[i - 1 for i in path.jumps]] = False
    clear = np.ones((2, t), bool)
    if surrounded is not None:
        clear = np.array(arm_clear(robot, surrounded, path.q, path.torso, np.arange(t)))
    return JointPath(path.q, exact, linked, *clear)


def _failures(path: JointPath) -> int:
    return int((~path.linked).sum() + (~path.exact).sum() + (~path.clear).sum())
