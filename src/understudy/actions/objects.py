"""The object that an action moves: where its handle goes, and how it compares with the one of the demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.actions.features import Carrier, floor_frame
from understudy.errors import UnderstudyError
from understudy.geometry import inverse, transform_points
from understudy.lie import se3_log
from understudy.objects.articulation import FIXED, REVOLUTE, Articulation

LEFT, NONE, RIGHT = -1, 0, 1
_PLAIN: Final = 0.5  # part of a unit vector that counts as a direction
_OFF: Final = (0.02, np.radians(5))  # metres, radians: how far a handle may be from its articulation


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """A handle that goes from one position of its articulation to another. World frame."""

    articulation: Articulation
    T_start: Float[np.ndarray, "4 4"]
    """where the handle is before"""
    q_start: float
    q_goal: float

    @classmethod
    def at(cls, articulation: Articulation, T_start: Float[np.ndarray, "4 4"], q_goal: float) -> ObjectMotion:
        """From where the handle is. Raises UnderstudyError when that is not on the articulation."""
        q = articulation.position(T_start[None])
        away = np.abs(se3_log(inverse(articulation.pose(q)[0]) @ T_start))
        far = np.linalg.norm(away[:3]) > _OFF[0] or np.linalg.norm(away[3:]) > _OFF[1]
        if far:
            raise UnderstudyError(
                f"the object's rest pose is {100 * np.linalg.norm(away[:3]):.1f} cm and "
                f"{np.degrees(np.linalg.norm(away[3:])):.1f} degrees off its articulation; give both in the world's "
                "frame (Articulation.moved)"
            )
        return cls(articulation, T_start, float(q[0]), q_goal)

    def poses(self, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """Of the handle. Exactly `T_start` at q_start."""
        start = inverse(self.articulation.pose(np.array([self.q_start]))[0])
        return np.asarray(self.articulation.pose(q) @ start @ self.T_start)

    def carrier(self, q: Float[np.ndarray, " n"]) -> Carrier:
        """The frames for gripper and base."""
        T = self.poses(q)
        floor = np.column_stack([T[:, :2, 3], np.full(len(q), floor_frame(self.T_start[None])[0, 2])])
        return Carrier(T, floor)

    @property
    def travel(self) -> float:
        """Radians or metres, signed."""
        return self.q_goal - self.q_start

    @property
    def way_m(self) -> float:
        """How far the handle goes."""
        arm = self.articulation.radius_m if self.articulation.kind == REVOLUTE else 1.0
        return abs(self.travel) * arm

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """The world's z in the handle's frame at the start."""
        return np.asarray(self.T_start[2, :3])

    def _in_floor_frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Direction of sliding or of the axis, a point on the axis, and the way the handle starts to go."""
        yaw = floor_frame(self.T_start[None])[0, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        T = np.eye(4)
        T[:2, :2] = (c, s), (-s, c)
        T[:3, 3] = -T[:3, :3] @ self.T_start[:3, 3]
        direction, point = T[:3, :3] @ self.articulation.direction, transform_points(T, self.articulation.point)
        if self.articulation.kind == FIXED:
            return direction, point, np.zeros(3)
        go = np.cross(direction, -point) if self.articulation.kind == REVOLUTE else direction
        return direction, point, go / max(float(np.linalg.norm(go)), 1e-9) * np.sign(self.travel)

    @property
    def side(self) -> int:
        """On which side, seen by who stands before the front: the hinge of a door, or where a sliding door goes to.

        LEFT, RIGHT, or NONE: nothing, a drawer, a hinge above or below. Negative y of the floor frame is the left.
        """
        direction, point, go = self._in_floor_frame()
        if self.articulation.kind == REVOLUTE:
            upright = abs(direction[2]) > _PLAIN
            return int(np.sign(point[1])) if upright and abs(point[1]) > 0.02 else NONE
        return int(np.sign(go[1])) if abs(go[1]) > _PLAIN else NONE

    @property
    def towards(self) -> int:
        """1: the handle starts towards who stands before the front; -1: away; 0: neither."""
        go = self._in_floor_frame()[2]
        return int(np.sign(go[0])) if abs(go[0]) > _PLAIN else 0

    def require_like(self, other: ObjectMotion) -> None:
        """Raises UnderstudyError for an object that an action learnt from the other cannot move."""
        if self.articulation.kind != other.articulation.kind:
            raise UnderstudyError(
                f"the action was learnt on a {other.articulation.kind} object, this one is {self.articulation.kind}"
            )
        if other.travel != 0 and not self.travel * other.travel > 0:
            way = "up" if other.travel > 0 else "down"
            raise UnderstudyError(
                f"the action takes q {way}, but from {self.q_start:.3f} to {self.q_goal:.3f} it does not go {way}"
            )
        if self.towards * other.towards < 0:
            words = {1: "towards", -1: "away from"}
            raise UnderstudyError(
                f"the action was learnt on an object that opens {words[other.towards]} the robot, this one opens "
                f"{words[self.towards]} it"
            )
