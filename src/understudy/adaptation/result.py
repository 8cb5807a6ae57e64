"""What adaptation gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.calibration import Calibration
from understudy.adaptation.platform import JointPath
from understudy.adaptation.solver import Convergence


@dataclass(frozen=True, eq=False)
class Adapted:
    """One demonstration, as the robot can do it; at the demonstration's samples. World frame."""

    times_s: Float[np.ndarray, " t"]
    """the demonstration's own, or stretched where it was too fast for the robot"""
    T_world_tool: Float[np.ndarray, "t 4 4"]
    base: Float[np.ndarray, "t 3"]
    """x, y, yaw: metres, metres, radians (continuous)"""
    torso: Float[np.ndarray, " t"]
    """metres"""
    achievable: Bool[np.ndarray, " t"]
    """exact inverse kinematics has a solution"""
    collision_free: Bool[np.ndarray, " t"]
    """the footprint is exactly clear of the map"""
    grasp: Float[np.ndarray, "4 4"]
    """T_object_tool: that of the result, or its mirror image for a door that is hung on the other side"""
    energies: dict[str, Float[np.ndarray, " t"]]
    """cost of each kind of edge at each sample: what was bent, and why"""
    joints: JointPath | None = None
    """of the arm, where the robot says how they are found"""


@dataclass(frozen=True, eq=False)
class Report:
    """How the result came about."""

    convergence: Convergence
    rounds: int
    """how often margins were tightened because exact checks failed"""
    notes: tuple[str, ...]
    """what a user should know"""


@dataclass(frozen=True, eq=False)
class AdaptationResult:
    """All demonstrations of one task, adapted to one robot with one grasp."""

    task: str
    robot: str
    demonstrations: tuple[Adapted, ...]
    grasp: Float[np.ndarray, "4 4"]
    """T_object_tool: the chosen feasible grasp, for the side of the first demonstration"""
    calibration: Calibration
    report: Report
