"""Exact inverse kinematics with joint limits and self-collision, for many poses at once and along paths.

From many seeds at once (sampled configurations whose tool is nearest), damped Gauss-Newton with bounds; the solution
nearest to a wanted posture is kept. A pose counts as solved when its error is at most `POSITION_TOLERANCE` and
`ANGLE_TOLERANCE`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from understudy.errors import UnderstudyError
from understudy.robot.ik_kernels import solve_from_seeds
from understudy.robot.model import Robot

POSITION_TOLERANCE: Final = 1e-4
"""metres"""
ANGLE_TOLERANCE: Final = 1e-3
"""radians"""
LENGTH: Final = 0.25
"""metres that weigh as much as a radian, wherever poses are compared"""

_TABLE: Final = 200_000
_ROUNDS: Final = ((12, 3), (48, 12), (240, 48))
"""(seeds, solutions wanted): what the first round leaves unsolved gets the next"""
_OUTSIDE: Final = 0.30
"""metres and scaled radians: no further round where the nearest seed's descent stays this far away"""


@dataclass(frozen=True, eq=False)
class IKResult:
    """One configuration for each of n poses."""

    q: Float[np.ndarray, "n j"]
    """arm joints; where there is no success, the nearest that was found"""
    torso: Float[np.ndarray, " n"]
    """metres"""
    success: Bool[np.ndarray, " n"]
    position_error: Float[np.ndarray, " n"]
    """metres"""
    angle_error: Float[np.ndarray, " n"]
    """radians"""
    why: tuple[str, ...]
    """'' for a success; 'unreachable': no exact solution within the limits; 'collision': each found collides"""


def embed(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 9"]:
    """Positions and scaled x and y axes: nearby points are nearby poses (a radian is about `LENGTH` metres)."""
    axes = np.concatenate([T[:, :3, 0], T[:, :3, 1]], axis=1)
    return np.concatenate([T[:, :3, 3], LENGTH / np.sqrt(1.5) * axes], axis=1)


class SeedTable:
    """Sampled configurations, found by the pose of their tool relative to the torso."""

    def __init__(self, robot: Robot, n: int = _TABLE):
        q, _ = robot.sample(n, seed=0)
        self.q = q
        self.tree = cKDTree(embed(robot.forward(q, np.zeros(n))), balanced_tree=False, compact_nodes=False)

    def nearest(
        self, T: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"], k: int
    ) -> Float[np.ndarray, "n k j"]:
        """Arm joints of the k samples nearest to each pose, with the torso at a height (metres)."""
        lowered = T.copy()
        lowered[:, 2, 3] -= torso
        _, index = self.tree.query(embed(lowered), k)
        return self.q[index.reshape(len(T), k)]


_tables: WeakKeyDictionary[Robot, SeedTable] = WeakKeyDictionary()


def seed_table(robot: Robot) -> SeedTable:
    """The robot's table, made when first asked for (half a second)."""
    if robot not in _tables:
        _tables[robot] = SeedTable(robot)
    return _tables[robot]


@dataclass(frozen=True, eq=False)
class Solutions:
    """All that one round found for n poses. Configurations have the torso first."""

    x: Float[np.ndarray, "n s k"]
    cost: Float[np.ndarray, "n s"]
    """posture cost, ascending; inf: no solution"""
    nearest: Float[np.ndarray, "n k"]
    left: Float[np.ndarray, "n 2"]
    """metres, radians between the pose and `nearest`"""


def solve_ik(
    robot: Robot,
    T_base_tool: Float[np.ndarray, "n 4 4"],
    torso: Float[np.ndarray, " n"] | Float[np.ndarray, "n 2"] | None = None,
    seed: Float[np.ndarray, "*n j"] | None = None,
    check_collisions: bool = True,
) -> IKResult:
    """Configurations that put the tool exactly at n poses, each for itself.

    torso: heights (n,), or bounds (n, 2) within which it is free; None: free within its limits. seed: (j,) or (n, j),
    the posture to be near to; default the robot's comfortable one. check_collisions: solutions in which the robot
    touches itself do not count. Raises UnderstudyError for shapes that do not fit or poses that are not finite.
    """
    problem = IKProblem(robot, T_base_tool, torso, seed)
    n = len(T_base_tool)
    x, success = np.zeros((n, robot.n + 1)), np.zeros(n, bool)
    left, why = np.full((n, 2), np.inf), np.full(n, "unreachable", dtype=object)
    todo = np.arange(n)
    for k, wanted in _ROUNDS:
        if not len(todo):
            break
        found = problem.solve(todo, k, wanted)
        choice = first_free(robot, found, check_collisions)
        ok = choice >= 0
        good = todo[ok]
        x[good], success[good], why[good] = found.x[np.flatnonzero(ok), choice[ok]], True, ""
        bad = todo[~ok]
        nearer = found.left[~ok] @ (1, LENGTH) < left[bad] @ (1, LENGTH)
        x[bad[nearer]], left[bad[nearer]] = found.nearest[~ok][nearer], found.left[~ok][nearer]
        solved = np.isfinite(found.cost[~ok, 0])
        why[bad[solved]] = "collision"
        todo = bad[left[bad] @ (1, LENGTH) < _OUTSIDE]
    reached = robot.forward(x[:, 1:], x[:, 0])
    position, angle = pose_distance(reached, T_base_tool)
    return IKResult(x[:, 1:], x[:, 0].copy(), success, position, angle, tuple(why))


def pose_distance(
    a: Float[np.ndarray, "n 4 4"], b: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Metres and radians between poses."""
    position = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    chord = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2))
    return position, 2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1))


class IKProblem:
    """The poses, bounds and reference postures of one call."""

    def __init__(
        self,
        robot: Robot,
        T: Float[np.ndarray, "n 4 4"],
        torso: Float[np.ndarray, " n"] | Float[np.ndarray, "n 2"] | None,
        seed: Float[np.ndarray, "*n j"] | None,
    ):
        n = len(T)
        if T.shape != (n, 4, 4) or not np.isfinite(T).all():
            raise UnderstudyError(f"poses for inverse kinematics: must be finite, (n, 4, 4), got {T.shape}")
        low, high = robot.torso_limits
        bounds = np.tile([low, high], (n, 1)) if torso is None else np.asarray(torso, float)
        bounds = np.column_stack([bounds, bounds]) if bounds.ndim == 1 else bounds
        if bounds.shape != (n, 2) or not (bounds[:, 0] <= bounds[:, 1]).all():
            raise UnderstudyError(f"torso: must be (n,) heights or (n, 2) bounds, low first, got {bounds.shape}")
        if bounds.min(initial=low) < low - 1e-9 or bounds.max(initial=high) > high + 1e-9:
            raise UnderstudyError(f"torso: heights must be within {low:g} ... {high:g} m on {robot.name}")
        posture = robot.description.posture if seed is None else np.asarray(seed, float)
        if posture.shape not in ((robot.n,), (n, robot.n)):
            raise UnderstudyError(f"seed: must be ({robot.n},) or (n, {robot.n}), got {posture.shape}")
        self.robot, self.T = robot, np.ascontiguousarray(T, float)
        self.given = seed is not None
        middle = bounds.mean(axis=1)
        self.lower = np.column_stack([bounds[:, 0], np.tile(robot.lower, (n, 1))])
        self.upper = np.column_stack([bounds[:, 1], np.tile(robot.upper, (n, 1))])
        self.reference = np.column_stack([middle, np.broadcast_to(posture, (n, robot.n))])
        self.scale = np.concatenate([[1.0], np.where(robot.continuous, 2 * np.pi, robot.upper - robot.lower)])
        self.continuous = np.concatenate([[False], robot.continuous])
        self.limits = np.array([POSITION_TOLERANCE, ANGLE_TOLERANCE])

    def solve(self, rows: np.ndarray, k: int, wanted: int, relax: int = 8) -> Solutions:
        """Tries the reference posture and k table seeds for those rows."""
        robot = self.robot
        low, high = self.lower[rows, 0], self.upper[rows, 0]
        heights = [0.5 * (low + high)] if (low == high).all() else [low + s * (high - low) for s in (0.5, 0.1, 0.9)]
        seeds = [self.reference[rows][:, None]]
        for h in heights:
            near = seed_table(robot).nearest(self.T[rows], h, max(k // len(heights), 1))
            seeds.append(np.concatenate([np.broadcast_to(h[:, None, None], (*near.shape[:2], 1)), near], axis=2))
        stacked = np.ascontiguousarray(np.concatenate(seeds, axis=1))
        out = solve_from_seeds(
            robot.fixed, stacked, self.lower[rows], self.upper[rows], self.continuous, self.T[rows][:, :3].copy(),
            LENGTH, self.reference[rows], self.scale, self.limits, wanted, relax,
        )  # fmt: skip
        return Solutions(*out)


def first_free(robot: Robot, found: Solutions, check: bool) -> np.ndarray:
    """Index of the best solution that does not collide, for each pose; -1: none."""
    n, s = found.cost.shape
    choice = np.full(n, -1)
    for o in range(s):
        rows = np.flatnonzero((choice < 0) & np.isfinite(found.cost[:, o]))
        if not len(rows):
            break
        if check:
            x = found.x[rows, o]
            rows = rows[~robot.collides(x[:, 1:], x[:, 0])]
        choice[rows] = o
    return choice
