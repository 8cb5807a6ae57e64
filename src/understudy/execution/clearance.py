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
from understudy.robot.chain import frames
from understudy.robot.ik import embed
from understudy.robot.model import Robot

_CELL_M: Final = 0.025
_UPPER_M, _LOWER_M, _GRIPPER_M = 0.10, 0.075, 0.05  # radii of upper arm, forearm, palm, with a little to spare
_FROM: Final = 0.25  # share of the upper arm, from the shoulder, that cannot be elsewhere
_SPARE_M: Final = 0.01


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
    ):
        """guarded: samples at which the arm must be clear."""
        self.__dict__.update(robot.__dict__)  # the same model, limits and description: nothing is read anew
        self._robot, self._around, self._guarded = robot, around, guarded
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
        upper, lower, gripper = self._points(q, torso)
        arm = ((upper, _UPPER_M), (lower, _LOWER_M))
        clear = np.ones(len(q), bool)
        for field, T, parts in (
            (self._around.scene, self._T_world_base[sample], (*arm, (gripper, _GRIPPER_M))),
            (self._around.part, self._T_object_base[sample], arm),
        ):
            if field is None:
                continue
            for points, radius in parts:
                there = points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
                distance = field.at(there.reshape(-1, 3))[0].reshape(len(q), -1)
                clear &= distance.min(axis=1) > radius
        return clear

    def _points(self, q: np.ndarray, torso: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points along upper arm, forearm, palm and wrist; base frame."""
        x, fixed = self._robot.stack(q, torso), self._robot.fixed
        work, tmp = np.empty((x.shape[1] + 1, 3, 4)), np.empty((3, 4))
        joints = np.empty((len(x), x.shape[1] + 1, 3))
        axis = np.empty((len(x), 3))
        for i, row in enumerate(x):
            frames(fixed, row, work, tmp)
            joints[i], axis[i] = work[:, :, 3], work[-1, :, 0]
        # the farthest of the joints from the shoulder on are elbow and wrist, wherever the description puts them
        shoulder, elbow, wrist = joints[:, 2], joints[:, 4], joints[:, -3]
        upper = [shoulder + u * (elbow - shoulder) for u in (_FROM, 0.7, 1.0)]
        lower = [elbow + u * (wrist - elbow) for u in (0.3, 0.6, 1.0)]
        hand = [joints[:, -1] - d * axis for d in (0.07, 0.12)]
        return np.stack(upper, axis=1), np.stack(lower, axis=1), np.stack(hand, axis=1)


def _field(points: Float[np.ndarray, "n 3"], low: np.ndarray, high: np.ndarray) -> DistanceField | None:
    inside = points[((points > low) & (points < high)).all(axis=1)]
    if not len(inside):
        return None
    field = point_field(inside, low, high, _CELL_M)
    # a point fills its cell: on average what is there begins a quarter of a cell nearer than its centre
    return DistanceField(field.values + _SPARE_M, field.origin, field.cell_m)
