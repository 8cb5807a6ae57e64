"""A joint path for a trajectory of tool poses, cheaply: few branches of solutions, each followed all the way.

`ik_path.solve_ik_path` looks at every solution of every sample. Where the arm has room, the solutions at one sample
lead through the whole trajectory, each by smallest motions; checking the best of them for self-collision is enough.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError
from understudy.robot.ik import LENGTH, IKProblem, pose_distance
from understudy.robot.ik_kernels import follow_branches
from understudy.robot.ik_path import JUMP_RAD, IKPath, velocity_share
from understudy.robot.model import Robot

_STARTS: Final = 5
"""samples whose solutions are followed, both ends among them"""
_SEEDS, _SOLUTIONS = 48, 8  # at each of them


def follow_ik_path(
    robot: Robot,
    T_base_tool: Float[np.ndarray, "t 4 4"],
    torso: Float[np.ndarray, " t"],
    times_s: Float[np.ndarray, " t"],
    check_collisions: bool = True,
) -> IKPath:
    """The joint path with the fewest failures (no exact solution, a jump, self-collision) among those found, and of
    those the one whose fastest joint is slowest.

    Failures are no proof: `solve_ik_path` may find a path where this does not. Raises UnderstudyError for input that
    does not fit.
    """
    t = len(T_base_tool)
    if t == 0 or times_s.shape != (t,) or (np.diff(times_s) <= 0).any():
        raise UnderstudyError(f"a path needs at least one pose, and times that increase, one for each of {t} poses")
    problem = IKProblem(robot, T_base_tool, torso, None)
    paths, exact = _branches(problem)
    ok = exact & ~_jumps(paths)
    share = np.array([_greatest(robot, path, good, times_s) for path, good in zip(paths, ok, strict=True)])
    order = np.lexsort((share, -ok.sum(axis=1)))
    best, least = None, t + 1
    colliding = np.zeros(t, bool)  # at these samples others collided: checked first, most branches go no farther
    for b in order:
        good = ok[b].copy()
        for part in (good & colliding, good & ~colliding) if check_collisions else ():
            rows = np.flatnonzero(part)
            if t - good.sum() < least and len(rows):
                good[rows] = ~robot.collides(paths[b, rows, 1:], paths[b, rows, 0])
        colliding |= ok[b] & ~good
        if t - good.sum() < least:
            best, least = (paths[b], good), t - int(good.sum())
        if not least:
            break
    assert best is not None
    return _path(problem, *best, times_s)


def _branches(problem: IKProblem) -> tuple[Float[np.ndarray, "b t k"], Bool[np.ndarray, "b t"]]:
    """Solutions at a few samples, followed to both ends; and where they are exact."""
    t = len(problem.T)
    starts = np.unique(np.round(np.linspace(0, t - 1, _STARTS)).astype(int))
    found = problem.solve(starts, _SEEDS, _SOLUTIONS, relax=0)
    targets = np.ascontiguousarray(problem.T[:, :3])
    paths, exact = [problem.reference[None].copy()], [np.zeros((1, t), bool)]  # where there is no solution at all
    for place, i in enumerate(starts.tolist()):
        x = found.x[place][np.isfinite(found.cost[place])]
        if len(x):
            followed, good = follow_branches(
                problem.robot.fixed, x, i, problem.lower, problem.upper, targets, LENGTH, problem.limits
            )
            paths.append(followed)
            exact.append(good)
    return np.concatenate(paths), np.concatenate(exact)


def _jumps(paths: Float[np.ndarray, "b t k"]) -> Bool[np.ndarray, "b t"]:
    """Samples that are not reached from the one before by a small motion."""
    step = np.abs(np.diff(paths[..., 1:], axis=1)).max(axis=2, initial=0.0)
    return np.pad(step > JUMP_RAD, ((0, 0), (1, 0)))


def _greatest(
    robot: Robot, path: Float[np.ndarray, "t k"], good: Bool[np.ndarray, " t"], times_s: Float[np.ndarray, " t"]
) -> float:
    """Velocity of the fastest joint over its limit, between good samples."""
    share = velocity_share(robot, path[:, 1:], path[:, 0], times_s)[:-1]
    return float(share[good[1:] & good[:-1]].max(initial=0.0))


def _path(
    problem: IKProblem, x: Float[np.ndarray, "t k"], good: Bool[np.ndarray, " t"], times_s: Float[np.ndarray, " t"]
) -> IKPath:
    robot, q, torso = problem.robot, x[:, 1:].copy(), 0.5 * (problem.lower[:, 0] + problem.upper[:, 0])
    position, angle = pose_distance(robot.forward(q, torso), problem.T)
    jumps = tuple(np.flatnonzero(_jumps(x[None])[0]).tolist())
    return IKPath(q, torso, good, position, angle, jumps, velocity_share(robot, q, torso, times_s))
