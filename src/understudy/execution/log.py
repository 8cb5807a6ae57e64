"""The course of an execution, row by row."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from understudy.execution.outcome import Trajectory
from understudy.robot.simulator import RobotState, Targets


@dataclass(eq=False)
class Log:
    """Rows of the trajectory."""

    times_s: list[float] = field(default_factory=list)
    base: list[np.ndarray] = field(default_factory=list)
    torso: list[float] = field(default_factory=list)
    q: list[np.ndarray] = field(default_factory=list)
    opening_m: list[float] = field(default_factory=list)
    T_world_tool: list[np.ndarray] = field(default_factory=list)
    opened: list[float] = field(default_factory=list)
    force: list[float] = field(default_factory=list)

    def add(self, state: RobotState, targets: Targets, opened: float, force: float) -> None:
        """One tick."""
        self.times_s.append(state.time_s)
        self.base.append(targets.base.copy())
        self.torso.append(targets.torso)
        self.q.append(targets.q.copy())
        self.opening_m.append(targets.opening_m)
        self.T_world_tool.append(state.T_world_tool)
        self.opened.append(opened)
        self.force.append(force)

    def trajectory(self) -> Trajectory:
        """All rows."""
        t = len(self.times_s)
        j = len(self.q[0]) if t else 0
        return Trajectory(
            np.array(self.times_s, float),
            np.array(self.base, float).reshape(t, 3),
            np.array(self.torso, float),
            np.array(self.q, float).reshape(t, j),
            np.array(self.opening_m, float),
            np.array(self.T_world_tool, float).reshape(t, 4, 4),
            np.array(self.opened, float),
            np.array(self.force, float),
        )
