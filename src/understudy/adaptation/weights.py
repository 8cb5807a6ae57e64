"""How much each edge of the graph weighs, what distance is kept, and in which order constraints are ramped up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np


@dataclass(frozen=True)
class Weights:
    """Standard deviations (or, of limits, what a violation may cost): small is stiff. Pairs: metres, radians."""

    hand: tuple[float, float] = (0.01, np.radians(10))
    """following while reaching, besides the observation's own covariance"""
    hand_holding: tuple[float, float] = (0.15, np.radians(40))
    """the same while manipulating, where the object says where the gripper must be"""
    torso: tuple[float, float] = (0.15, np.radians(20))
    grasp: tuple[float, float] = (0.0002, np.radians(0.03))
    """of gripper and object, for taking hold and for holding, once ramped up"""
    approach: tuple[float, float] = (0.01, np.radians(5))
    """off the straight way, and turned, just before taking hold and after letting go: fingers must pass the handle"""
    gripper_speed: tuple[float, float] = (4.0, 12.0)
    """metres/s, radians/s"""
    gripper_acceleration: tuple[float, float] | None = (2.0, 6.0)
    """metres/s^2, radians/s^2; None: no such edges"""
    posture: tuple[float, float] = (0.2, 0.5)
    """metres/s, radians/s of the gripper as seen from the base, where no hand was observed: the arm rests"""
    base_speed: tuple[float, float] = (0.5, 1.0)
    base_acceleration: tuple[float, float] | None = (0.5, 1.0)
    torso_speed: float = 0.01
    torso_rest: float = 0.3
    """metres, around the middle of the torso's range"""
    obstacle: float = 0.003
    """metres of violation, of map, moving part and scene alike"""
    unknown: float = 0.2
    """metres that the base stands in cells that nothing is known about: a preference, not a constraint"""
    reach: float = 0.003
    """of the reachability field's value"""
    limit: float = 0.01
    """metres/s (/s) beyond a limit; three times that in radians"""
    kernel_width: float = 3.0
    """standard deviations"""


@dataclass(frozen=True)
class Margins:
    """Distances kept beyond what is needed, metres."""

    obstacle: float = 0.02
    reach: float = 0.01
    panel: float = 0.015
    speed: float = 0.95
    """share of the velocity and acceleration limits that is used"""


@dataclass(frozen=True)
class Limits:
    """Of the gripper. Robots state joint velocities; these are the Cartesian ones that the adaptation keeps."""

    speed: float = 1.0
    """metres/s"""
    turning: float = 3.0
    """radians/s"""


@dataclass(frozen=True)
class Stage:
    """One round of the weight schedule."""

    constraints: float
    """share of the final stiffness (one over standard deviation) of map, reachability, limits"""
    grasp: float
    """the same for taking hold and holding"""
    kernel: str
    """on observations"""
    tolerance: float
    iterations: int


SCHEDULE: Final = (
    Stage(constraints=0.03, grasp=0.05, kernel="huber", tolerance=1e-2, iterations=12),
    Stage(constraints=0.2, grasp=0.3, kernel="cauchy", tolerance=1e-2, iterations=12),
    Stage(constraints=1.0, grasp=1.0, kernel="cauchy", tolerance=5e-4, iterations=40),
)
"""The default weight schedule."""
