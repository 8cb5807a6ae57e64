"""What came of an execution."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Float

from understudy.errors import UnderstudyError


class Reason(StrEnum):
    """Why an execution ended. Only the first is a success."""

    OPENED = "opened"
    COLLISION = "opened, but touched something else"
    NOT_FAR_ENOUGH = "not opened far enough"
    NO_PLAN = "no feasible motion"
    MISSED = "the fingers closed on nothing"
    LOST = "the handle slipped out of the fingers"
    BLOCKED = "the part does not move"
    FORCE = "the force is too high"
    OUT_OF_REACH = "the arm cannot follow the handle"
    TIMEOUT = "out of time"


class Stopped(UnderstudyError):
    """Inside the package: an attempt ends here."""

    def __init__(self, reason: Reason, detail: str):
        super().__init__(f"{reason}: {detail}")
        self.reason, self.detail = reason, detail


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What was commanded, and what came of it, at the rate of control."""

    times_s: Float[np.ndarray, " t"]
    base: Float[np.ndarray, "t 3"]
    """commanded: x, y (metres), yaw (radians), world"""
    torso: Float[np.ndarray, " t"]
    q: Float[np.ndarray, "t j"]
    opening_m: Float[np.ndarray, " t"]
    T_world_tool: Float[np.ndarray, "t 4 4"]
    """measured"""
    opened: Float[np.ndarray, " t"]
    """measured position of the part: radians or metres"""
    force: Float[np.ndarray, " t"]
    """between gripper and part, newtons"""


@dataclass(frozen=True, eq=False)
class Outcome:
    """One execution."""

    success: bool
    reason: Reason
    detail: str
    """in words, with numbers"""
    opened_share: float
    """of the goal, when the gripper let go (or when it stopped)"""
    retries: int
    course: tuple[str, ...]
    """what ended each attempt but a successful one"""
    max_force: float
    """newtons, between gripper and part"""
    collisions: tuple[tuple[str, str], ...]
    """(link, what it touched)"""
    excused: tuple[tuple[str, str], ...]
    """the same of a part that came back by itself after it was let go; no collisions"""
    duration_s: float
    """simulated"""
    planning_s: float
    """processor time"""
    trajectory: Trajectory = field(repr=False)

    def to_json(self) -> dict[str, Any]:
        """Without the trajectory."""
        return {
            "success": self.success,
            "reason": self.reason.name,
            "detail": self.detail,
            "opened_share": round(self.opened_share, 4),
            "retries": self.retries,
            "course": list(self.course),
            "max_force_n": round(self.max_force, 1),
            "collisions": [list(pair) for pair in self.collisions],
            "excused": [list(pair) for pair in self.excused],
            "duration_s": round(self.duration_s, 2),
            "planning_s": round(self.planning_s, 2),
        }
