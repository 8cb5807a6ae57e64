"""Self-motions spread over time: a redundant arm that changes from one branch of solutions to another need not jump.

`ik_path` chooses among exact solutions, sample by sample. Where a posture that was good gets into the way of something,
the best choice is often another one of the same family (the elbow elsewhere, the tool where it was), taken from one
sample to the next. Here that motion is begun earlier and ended later, through exact solutions in between.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.robot.ik import LENGTH, IKProblem, pose_distance
from understudy.robot.ik_kernels import solve_from_seeds
from understudy.robot.ik_path import JUMP_RAD, IKPath
from understudy.robot.model import Robot

_WINDOWS: Final = ((2, 2), (4, 4), (8, 8), (8, 0), (0, 8), (14, 14), (16, 0), (0, 16))
"""samples before and after a jump over which its motion is spread, the first that is possible"""
_GENTLE: Final = 0.7
"""share of a jump's size that is the most for a step in between"""


def bridged(robot: Robot, path: IKPath, T_base_tool: Float[np.ndarray, "t 4 4"]) -> IKPath:
    """The path with its jumps spread where exact, collision-free solutions lead across.

    T_base_tool: the poses that `path` was made for. Jumps that cannot be spread stay in `jumps`.
    `velocity_share` is not computed again: None if anything changed.
    """
    q, left = path.q.copy(), []
    for jump in path.jumps:
        for before, after in _WINDOWS:
            first, last = jump - before, jump - 1 + after
            if first < 1 or last > len(q) - 2 or not path.success[first - 1 : last + 2].all():
                continue
            found = _across(robot, q, path.torso, T_base_tool, jump, slice(first, last + 1))
            if found is not None:
                q[first : last + 1] = found
                break
        else:
            left.append(jump)
    if len(left) == len(path.jumps):
        return path
    q = robot.unwrap(q)
    position, angle = pose_distance(robot.forward(q, path.torso), T_base_tool)
    return replace(
        path, q=q, position_error=position, angle_error=angle, jumps=tuple(left), velocity_share=None
    )  # fmt: skip


def _across(
    robot: Robot,
    q: Float[np.ndarray, "t j"],
    torso: Float[np.ndarray, " t"],
    T_base_tool: Float[np.ndarray, "t 4 4"],
    jump: int,
    window: slice,
) -> Float[np.ndarray, "w j"] | None:
    """Exact solutions of the window's samples from one side's posture to the other's; None if there are none."""
    rows = np.arange(window.start, window.stop)
    u = (rows - window.start + 1) / (len(rows) + 1)
    one, other = q[np.minimum(rows, jump - 1)], q[np.maximum(rows, jump)]
    way = np.where(robot.continuous, lie.wrapped(other - one), other - one)
    between = one + (u**2 * (3 - 2 * u))[:, None] * way
    problem = IKProblem(robot, T_base_tool[window], torso[window], between)
    x, cost, _, _ = solve_from_seeds(
        robot.fixed, problem.reference[:, None].copy(), problem.lower, problem.upper, problem.continuous,
        problem.T[:, :3].copy(), LENGTH, problem.reference, problem.scale, problem.limits, 1, 12,
    )  # fmt: skip
    found = x[:, 0, 1:]
    ends = np.concatenate([q[window.start - 1][None], found, q[window.stop][None]])
    step = np.diff(ends, axis=0)
    step = np.where(robot.continuous, lie.wrapped(step), step)
    gentle = np.abs(step).max() <= _GENTLE * JUMP_RAD
    if not np.isfinite(cost).all() or not gentle or robot.collides(found, torso[window]).any():
        return None
    return np.asarray(found)
