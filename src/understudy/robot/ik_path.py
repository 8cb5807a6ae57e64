"""A continuous joint path for a trajectory of tool poses: dynamic programming over exact solutions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError
from understudy.robot.ik import LENGTH, IKProblem, pose_distance
from understudy.robot.ik_kernels import distinct, solve_from_seeds
from understudy.robot.model import Robot

_POSTURE_WEIGHT: Final = 1e-3
"""of a configuration's posture cost against the squared steps (in joint ranges) of the path"""
_FRESH: Final = 6
"""solutions from the table that join the tracked ones at each sample"""
_KEPT: Final = 12
_JUMP: Final = 1e3
"""cost of a step from one branch of solutions to another: taken only where nothing else is left"""
JUMP_RAD: Final = 0.5
"""of one joint from sample to sample: more is a jump"""


@dataclass(frozen=True, eq=False)
class IKPath:
    """Configurations along a trajectory of t poses."""

    q: Float[np.ndarray, "t j"]
    """continuous joints unwrapped; where there is no solution, the one before"""
    torso: Float[np.ndarray, " t"]
    success: Bool[np.ndarray, " t"]
    position_error: Float[np.ndarray, " t"]
    """metres"""
    angle_error: Float[np.ndarray, " t"]
    """radians"""
    jumps: tuple[int, ...]
    """samples that are not reached from the one before by a small motion"""
    velocity_share: Float[np.ndarray, " t"] | None
    """largest joint velocity over its limit, arm and torso; above 1 it must be slowed down. None without times"""


def solve_ik_path(
    robot: Robot,
    T_base_tool: Float[np.ndarray, "t 4 4"],
    torso: Float[np.ndarray, " t"],
    times_s: Float[np.ndarray, " t"] | None = None,
    seed: Float[np.ndarray, " j"] | None = None,
    check_collisions: bool = True,
) -> IKPath:
    """A path through exact solutions that moves the joints as little as possible.

    At each sample the solutions of the one before are followed, and fresh ones from all over join them; dynamic
    programming chooses among them. seed: posture to be near to (default the comfortable one). Raises UnderstudyError
    for input that does not fit.
    """
    t = len(T_base_tool)
    if t == 0 or (times_s is not None and (times_s.shape != (t,) or (np.diff(times_s) <= 0).any())):
        raise UnderstudyError(f"a path needs at least one pose, and times that increase, one for each of {t} poses")
    problem = IKProblem(robot, T_base_tool, torso, seed)
    fresh = problem.solve(np.arange(t), 4 * _FRESH, _FRESH)
    layers: list[np.ndarray] = []
    for i in range(t):
        tracked = _follow(problem, i, layers[-1]) if i and len(layers[-1]) else np.empty((0, robot.n + 1))
        new = fresh.x[i][np.isfinite(fresh.cost[i])]
        layer = np.concatenate([tracked, new])[: _KEPT + _FRESH]
        if check_collisions and len(layer):
            layer = layer[~robot.collides(layer[:, 1:], layer[:, 0])]
        layers.append(_distinct(layer)[:_KEPT])
    x, success, jumps = _shortest(problem, layers)
    q = robot.unwrap(x[:, 1:])
    position, angle = pose_distance(robot.forward(q, x[:, 0]), problem.T)
    share = None if times_s is None else velocity_share(robot, q, x[:, 0], times_s)
    return IKPath(q, x[:, 0].copy(), success, position, angle, jumps, share)


def _follow(problem: IKProblem, i: int, before: Float[np.ndarray, "s k"]) -> Float[np.ndarray, "m k"]:
    """Solutions at sample i by the smallest motion from each of sample i - 1's."""
    s = len(before)
    lower, upper = np.tile(problem.lower[i], (s, 1)), np.tile(problem.upper[i], (s, 1))
    x, cost, _, _ = solve_from_seeds(
        problem.robot.fixed, before[:, None].copy(), lower, upper, problem.continuous,
        np.repeat(problem.T[i : i + 1, :3], s, axis=0).copy(), LENGTH, before.copy(), problem.scale,
        problem.limits, 1, 2,
    )  # fmt: skip
    return np.asarray(x[np.isfinite(cost[:, 0]), 0])


def _distinct(layer: Float[np.ndarray, "s k"]) -> Float[np.ndarray, "m k"]:
    """Without those that lie within 0.02 of an earlier one."""
    return np.asarray(layer[distinct(np.ascontiguousarray(layer), 0.02)])


def _steps(problem: IKProblem, a: Float[np.ndarray, "s k"], b: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "s m k"]:
    """Joint steps, continuous joints the short way round."""
    step = b[None] - a[:, None]
    turns = 2 * np.pi * np.round(step / (2 * np.pi))
    return np.where(problem.continuous, step - turns, step)


def _shortest(
    problem: IKProblem, layers: list[np.ndarray]
) -> tuple[Float[np.ndarray, "t k"], Bool[np.ndarray, " t"], tuple[int, ...]]:
    """The cheapest choice of one configuration per layer; empty layers keep the configuration before."""
    filled = [i for i, layer in enumerate(layers) if len(layer)]
    t = len(layers)
    x = np.tile(problem.reference[0], (t, 1))
    success = np.zeros(t, bool)
    success[filled] = True
    jumps: list[int] = []
    if filled:
        totals, parents = [_posture(problem, layers[filled[0]])], [np.zeros(0, int)]
        for a, b in pairwise(filled):
            step = _steps(problem, layers[a], layers[b])
            cost = (step / problem.scale) ** 2
            through = totals[-1][:, None] + cost.sum(axis=2) + _JUMP * _is_jump(step, b - a)
            parents.append(through.argmin(axis=0))
            totals.append(through.min(axis=0) + _posture(problem, layers[b]))
        choice = int(totals[-1].argmin())
        for place in range(len(filled) - 1, -1, -1):
            x[filled[place]] = layers[filled[place]][choice]
            if place:
                choice = int(parents[place][choice])
        for a, b in pairwise(filled):
            if _is_jump(_steps(problem, x[a : a + 1], x[b : b + 1]), b - a)[0, 0]:
                jumps.append(b)
    for i in range(t):
        if not success[i] and i:
            x[i] = x[i - 1]
    x[:, 0] = 0.5 * (problem.lower[:, 0] + problem.upper[:, 0])
    return x, success, tuple(jumps)


def _posture(problem: IKProblem, layer: Float[np.ndarray, "s k"]) -> Float[np.ndarray, " s"]:
    away = _steps(problem, problem.reference[:1], layer)[0, :, 1:] / problem.scale[1:]
    return np.asarray(_POSTURE_WEIGHT * (away**2).mean(axis=1))


def _is_jump(step: Float[np.ndarray, "s m k"], samples: int) -> Bool[np.ndarray, "s m"]:
    """More than `JUMP_RAD` in one joint, per sample."""
    return np.asarray(np.abs(step[..., 1:]).max(axis=-1) > JUMP_RAD * samples)


def velocity_share(
    robot: Robot, q: Float[np.ndarray, "t j"], torso: Float[np.ndarray, " t"], times_s: Float[np.ndarray, " t"]
) -> Float[np.ndarray, " t"]:
    """Largest joint velocity over its limit, arm and torso, from each sample to the next (the last repeats)."""
    if len(times_s) < 2:
        return np.zeros(len(times_s))
    dt = np.diff(times_s)
    arm = (np.abs(np.diff(q, axis=0)) / dt[:, None] / robot.velocity).max(axis=1)
    lift = np.abs(np.diff(torso)) / dt / robot.description.limits.torso_velocity
    share = np.maximum(arm, lift)
    return np.append(share, share[-1])
