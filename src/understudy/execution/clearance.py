"""Inverse kinematics that keeps the whole arm clear of what stands around and of the part that moves.

The graph knows the gripper, the wrist and the base. Where the elbow goes follows from the joints only: here the
solutions that touch something are left out, before a path is chosen among the rest.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from understudy import lie
from understudy.adaptation.fields import DistanceField, point_field
from understudy.execution.surroundings import Observed
from understudy.robot.arm_surface import arm_surface
from understudy.robot.ik import embed, seed_table
from understudy.robot.model import Robot

_CELL_M: Final = 0.025
_HAND_M: Final = np.array([0.07, 0.12])  # behind the tool: middles of balls that cover palm and wrist
_HAND_RADIUS_M: Final = 0.04  # to a cell in which something is


class Around:
    """Fields of distances: to what stands still (world), and to the part that moves (its own frame)."""

    def __init__(self, observed: Observed):
        middle = observed.T_world_object[:3, 3]
        low, high = middle - (1.3, 1.3, 0.8), middle + (1.3, 1.3, 0.6)
        part = observed.part.astype(float)
        self.scene = _field(observed.scene.astype(float), low, high)
        self.part = _field(part, part.min(axis=0) - 0.3, part.max(axis=0) + 0.3) if len(part) else None


class GuardedRobot(Robot):
    """A robot for `solve_ik_path` whose self-collision check also looks around.

    Which sample of the path a configuration belongs to follows from where it puts the tool. In every other respect it
    is the robot: it counts as equal to it, so that tables that are kept per robot serve it, too.
    """

    def __init__(
        self,
        robot: Robot,
        around: Around,
        base: Float[np.ndarray, "t 3"],
        T_base_tool: Float[np.ndarray, "t 4 4"],
        T_world_object: Float[np.ndarray, "t 4 4"],
        guarded: Bool[np.ndarray, " t"],
        spare_m: float = 0.0,
    ):
        """guarded: samples at which the arm must be clear. spare_m: of the links' surfaces to a cell in which something
        is; to that itself, it is half a cell more.
        """
        seed_table(robot)  # asked for first by a robot that is soon forgotten, it would be made anew each time
        self.__dict__.update(robot.__dict__)  # the same model, limits and description: nothing is read anew
        self._robot, self._around, self._guarded, self._spare = robot, around, guarded, spare_m
        self._T_world_base = lie.se2_to_se3(base)
        self._T_object_base = lie.se3_inverse(T_world_object) @ self._T_world_base
        self._poses = cKDTree(embed(T_base_tool))

    def __hash__(self) -> int:
        return hash(self._robot)

    def __eq__(self, other: object) -> bool:
        return other is self or other is self._robot

    def collides(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether the arm touches the robot itself or something else."""
        sample = np.asarray(self._poses.query(embed(self._robot.forward(q, torso)))[1])
        out = np.zeros(len(q), bool)
        rows = np.flatnonzero(self._guarded[sample])
        if len(rows):
            out[rows] = ~self._clear(q[rows], torso[rows], sample[rows])
        rest = np.flatnonzero(~out)
        if len(rest):
            out[rest] = self._robot.collides(q[rest], torso[rest])
        return out

    def _clear(
        self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"], sample: np.ndarray
    ) -> Bool[np.ndarray, " n"]:
        x, clear = self._robot.stack(q, torso), np.ones(len(q), bool)
        surface, around = arm_surface(self._robot), self._around
        for field, T in ((around.scene, self._T_world_base[sample]), (around.part, self._T_object_base[sample])):
            if field is not None:
                clear &= surface.clear(x, T, field.values, field.origin, field.cell_m, self._spare)
        if around.scene is not None:
            T_world_tool = self._T_world_base[sample] @ self._robot.forward(q, torso)
            hand = T_world_tool[:, None, :3, 3] - _HAND_M[:, None] * T_world_tool[:, None, :3, 0]
            near = around.scene.at(hand.reshape(-1, 3))[0].reshape(len(q), -1)
            clear &= near.min(axis=1) > _HAND_RADIUS_M
        return clear


def _field(points: Float[np.ndarray, "n 3"], low: np.ndarray, high: np.ndarray) -> DistanceField | None:
    inside = points[((points > low) & (points < high)).all(axis=1)]
    if not len(inside):
        return None
    return point_field(inside, low, high, _CELL_M)
