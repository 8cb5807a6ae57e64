"""The whole arm against what stands around and the part that moves: exact, by points on its links' hulls.

The graph knows gripper, base and torso. Where the elbow goes follows from the joints only: here the solutions that
touch something are left out, before a path is chosen among the rest.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from understudy import lie
from understudy.adaptation.around import Surrounded
from understudy.robot.arm_surface import arm_surface
from understudy.robot.ik import embed, seed_table
from understudy.robot.model import Robot

_HAND_M: Final = np.array([0.07, 0.12])  # behind the tool: middles of balls that cover palm and wrist
_HAND_RADIUS_M: Final = 0.04  # to a cell in which something is


def arm_clear(
    robot: Robot,
    surrounded: Surrounded,
    q: Float[np.ndarray, "n j"],
    torso: Float[np.ndarray, " n"],
    sample: Int[np.ndarray, " n"],
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Whether the arm is clear of the scene, and of the part, with configurations for some of the samples."""
    x, surface, around = robot.stack(q, torso), arm_surface(robot), surrounded.around
    T_world_base = lie.se2_to_se3(surrounded.base[sample])
    T_object_base = lie.se3_inverse(surrounded.T_world_object[sample]) @ T_world_base
    scene, part = (
        np.ones(len(q), bool)
        if field is None
        else surface.clear(x, T, field.values, field.origin, field.cell_m, surrounded.spare_m)
        for field, T in ((around.scene, T_world_base), (around.part, T_object_base))
    )
    return scene, part


def hand_clear(
    surrounded: Surrounded, T_base_tool: Float[np.ndarray, "n 4 4"], sample: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether palm and wrist are clear of the scene."""
    if surrounded.around.scene is None:
        return np.ones(len(sample), bool)
    T = lie.se2_to_se3(surrounded.base[sample]) @ T_base_tool
    middles = T[:, None, :3, 3] - _HAND_M[:, None] * T[:, None, :3, 0]
    near = surrounded.around.scene.values_at(middles.reshape(-1, 3)).reshape(len(sample), -1)
    return np.asarray(near.min(axis=1) > _HAND_RADIUS_M)


class GuardedRobot(Robot):
    """A robot for searches of joint paths whose self-collision check also looks around.

    Which sample of the path a configuration belongs to follows from where it puts the tool. In every other respect it
    is the robot: it counts as equal to it, so that tables that are kept per robot serve it, too.
    """

    def __init__(
        self,
        robot: Robot,
        surrounded: Surrounded,
        T_base_tool: Float[np.ndarray, "t 4 4"],
        guarded: Bool[np.ndarray, " t"] | None = None,
        hand: bool = False,
    ):
        """guarded: samples at which the arm must be clear (None: all). hand: palm and wrist must be, too; no choice of
        joints moves them.
        """
        seed_table(robot)  # asked for first by a robot that is soon forgotten, it would be made anew each time
        self.__dict__.update(robot.__dict__)  # the same model, limits and description: nothing is read anew
        self._robot, self._surrounded, self._hand = robot, surrounded, hand
        self._guarded = np.ones(len(T_base_tool), bool) if guarded is None else guarded
        self._poses = cKDTree(embed(T_base_tool))

    def __hash__(self) -> int:
        return hash(self._robot)

    def __eq__(self, other: object) -> bool:
        return other is self or other is self._robot

    def collides(self, q: Float[np.ndarray, "n j"], torso: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Whether the arm touches the robot itself or something else."""
        T_base_tool = self._robot.forward(q, torso)
        sample = np.asarray(self._poses.query(embed(T_base_tool))[1])
        out = np.zeros(len(q), bool)
        rows = np.flatnonzero(self._guarded[sample])
        if len(rows):
            scene, part = arm_clear(self._robot, self._surrounded, q[rows], torso[rows], sample[rows])
            out[rows] = ~(scene & part)
            if self._hand:
                out[rows] |= ~hand_clear(self._surrounded, T_base_tool[rows], sample[rows])
        rest = np.flatnonzero(~out)
        if len(rest):
            out[rest] = self._robot.collides(q[rest], torso[rest])
        return out
