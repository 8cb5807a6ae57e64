"""What the adaptation needs to know of a robot; nothing here depends on how its kinematics are computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.around import Surrounded
from understudy.errors import UnderstudyError


@runtime_checkable
class Reachability(Protocol):
    """A smooth surrogate for 'the arm reaches this gripper pose'."""

    def value(self, T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The value of `distance` alone."""
        ...

    def distance(
        self, T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 6"], Float[np.ndarray, " n"]]:
        """Value (n,), at most 0 where reachable, growing about 1 per metre outside; its derivative (n, 6) over the
        tool's pose (right tangent: translation, rotation, in the tool's frame); and over the torso's height (n,).
        """
        ...


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joints of the arm along a trajectory of t gripper poses."""

    q: Float[np.ndarray, "t j"]
    """radians; continuous joints without whole turns between samples"""
    exact: Bool[np.ndarray, " t"]
    """puts the gripper exactly there, within the joints' limits, clear of the robot itself"""
    linked: Bool[np.ndarray, " t-1"]
    """from this sample to the next by a small motion, both exact"""
    scene_clear: Bool[np.ndarray, " t"]
    """the arm's links touch nothing that stands around, as far as it is known"""
    part_clear: Bool[np.ndarray, " t"]
    """nor the part that moves"""

    @property
    def clear(self) -> Bool[np.ndarray, " t"]:
        """The arm touches nothing."""
        return self.scene_clear & self.part_clear


@runtime_checkable
class JointSearch(Protocol):
    """Finds joints for a trajectory."""

    def __call__(
        self,
        T_base_tool: Float[np.ndarray, "t 4 4"],
        torso: Float[np.ndarray, " t"],
        times_s: Float[np.ndarray, " t"],
        *,
        surrounded: Surrounded | None,
        thorough: bool,
    ) -> JointPath:
        """surrounded: what the arm should not touch. thorough: all solutions of all samples are looked at where few of
        them did not do; slow.
        """
        ...


@dataclass(frozen=True, eq=False)
class Arm:
    """The arm's joints."""

    velocity: Float[np.ndarray, " j"]
    """greatest, radians/s"""
    acceleration: Float[np.ndarray, " j"]
    path: JointSearch


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
    arm: Arm | None = None
    """None: nothing is known of joints; then nothing is said of their velocities"""

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
