"""The inner loop's parts: an arm that follows a tool pose exactly, and an estimate of where the handle is."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.geometry import inverse
from understudy.objects.articulation import Articulation
from understudy.robot.ik import LENGTH, pose_distance
from understudy.robot.ik_kernels import solve_from_seeds
from understudy.robot.model import Robot

_ENOUGH: Final = np.array([1e-3, 5e-3])  # metres, radians: of a solution
_SPEED: Final = 0.8  # share of the arm's velocity limits


class Arm:
    """Follows tool poses, each from the joints before, near to a planned posture where the arm has a choice."""

    def __init__(self, robot: Robot, q: Float[np.ndarray, " j"]):
        self.robot, self.q = robot, q.copy()
        self.error = (0.0, 0.0)
        """metres, radians by which the last pose was missed"""
        self._scale = np.concatenate([[1.0], np.where(robot.continuous, 2 * np.pi, robot.upper - robot.lower)])
        self._continuous = np.concatenate([[False], robot.continuous])

    def follow(
        self, T_base_tool: Float[np.ndarray, "4 4"], torso: float, posture: Float[np.ndarray, " j"], seconds: float
    ) -> tuple[Float[np.ndarray, " j"], Float[np.ndarray, " j"]]:
        """Joints and their velocities; no joint moves faster than its limit."""
        robot = self.robot
        ends = [np.concatenate([[torso], x])[None] for x in (robot.lower, robot.upper)]
        seed = np.concatenate([[torso], self.q])[None, None]
        reference = np.concatenate([[torso], posture])[None]
        found, cost, nearest, _ = solve_from_seeds(
            robot.fixed, seed, *ends, self._continuous, T_base_tool[None, :3].copy(), LENGTH, reference, self._scale,
            _ENOUGH, 1, 1,
        )  # fmt: skip
        wanted = found[0, 0, 1:] if np.isfinite(cost[0, 0]) else nearest[0, 1:]
        step = wanted - self.q
        step = np.where(robot.continuous, lie.wrapped(step), step)
        most = _SPEED * robot.velocity * seconds
        step *= min(1.0, float((most / np.maximum(np.abs(step), 1e-12)).min()))
        self.q = self.q + step
        reached = robot.forward(self.q[None], np.array([torso]))
        position, angle = pose_distance(reached, T_base_tool[None])
        self.error = float(position[0]), float(angle[0])
        return self.q, step / seconds


class HandleEstimate:
    """Where the handle is, from noisy measurements: the articulation as it was thought to be, moved by a transform.

    A filter of first order on the transform's tangent: what is wrong with the articulation (a hinge that is somewhere
    else) changes slowly along the way.
    """

    def __init__(self, articulation: Articulation, gain: float = 0.15):
        self.T_correct = np.eye(4)
        """takes the assumed handle's poses to the estimated ones; world, from the left"""
        self.q = 0.0
        """estimated position of the part"""
        self._articulation, self._gain, self._count = articulation, gain, 0

    def pose(self, q: float) -> Float[np.ndarray, "4 4"]:
        """T_world_object with the part at q."""
        return np.asarray(self.T_correct @ self._articulation.pose(np.array([q]))[0])

    def correction_on_floor(self, q: float) -> Float[np.ndarray, "3"]:
        """x, y, yaw of the motion on the floor that does to the handle at q what `T_correct` does; world."""
        yaw = float(np.arctan2(self.T_correct[1, 0], self.T_correct[0, 0]))
        assumed = self._articulation.pose(np.array([q]))[0, :2, 3]
        c, s = np.cos(yaw), np.sin(yaw)
        return np.append(self.pose(q)[:2, 3] - np.array([[c, -s], [s, c]]) @ assumed, yaw)

    def position(self, T_world_object: Float[np.ndarray, "4 4"]) -> float:
        """Where the part is, by one measurement."""
        return float(self._articulation.position((inverse(self.T_correct) @ T_world_object)[None])[0])

    def restart(self) -> None:
        """The next measurements count fully: a running mean at first."""
        self._count = 0

    def moved(self, dq: float) -> None:
        """The part goes on, as far as is known of what moves it: so that the estimate does not lag behind."""
        self.q += dq

    def add(self, T_world_object: Float[np.ndarray, "4 4"], q: float | None = None) -> None:
        """A measurement. q: where the part is known to be; None: it follows from the measurement, too."""
        self._count += 1
        gain = max(self._gain, 1.0 / self._count)
        measured = self.position(T_world_object)
        if q is None:
            self.q += max(0.4, gain) * (measured - self.q)
            q = measured
        else:
            self.q = q
        expected = self.pose(q)
        step = lie.se3_log(inverse(expected) @ T_world_object)
        # by the inverse of an exact pose: by that of `expected`, errors of rounding would double with every measurement
        self.T_correct = expected @ lie.se3_exp(gain * step) @ inverse(self._articulation.pose(np.array([q]))[0])
