"""What the adaptation needs to know of a robot; nothing here depends on how its kinematics are computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError


@runtime_checkable
class Reachability(Protocol):
    """A smooth surrogate for 'the arm reaches this gripper pose'."""

    def distance(
        self, T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 6"], Float[np.ndarray, " n"]]:
        """Value (n,), at most 0 where reachable, growing about 1 per metre outside; its derivative (n, 6) over the
        tool's pose (right tangent: translation, rotation, in the tool's frame); and over the torso's height (n,).
        """
        ...


@dataclass(frozen=True, eq=False)
class Platform:
    """A mobile robot with a lifting torso and one arm, as the adaptation sees it."""

    name: str
    footprint: Float[np.ndarray, "k 2"]
    """metres, base frame, convex, counter-clockwise"""
    torso_limits: tuple[float, float]
    """metres"""
    base_velocity: Float[np.ndarray, "3"]
    """greatest: x, y (metres/s), yaw (radians/s), base frame"""
    base_acceleration: Float[np.ndarray, "3"]
    torso_velocity: float
    opening_m: float
    """greatest distance between the fingers"""
    reachability: Reachability
    achievable: Callable[[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"]], Bool[np.ndarray, " n"]]
    """exact: whether (T_base_tool, torso) has a joint configuration within limits that is clear of the robot itself"""

    def __post_init__(self) -> None:
        if len(self.footprint) < 3 or _area(self.footprint) <= 0:
            raise UnderstudyError(f"platform {self.name!r}: footprint must be 3 corners or more, counter-clockwise")
        if not self.torso_limits[0] <= self.torso_limits[1]:
            raise UnderstudyError(f"platform {self.name!r}: torso_limits must be (least, greatest)")

    @property
    def torso_rest(self) -> float:
        """Middle of the torso's range, metres."""
        return 0.5 * (self.torso_limits[0] + self.torso_limits[1])


def _area(polygon: Float[np.ndarray, "k 2"]) -> float:
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
