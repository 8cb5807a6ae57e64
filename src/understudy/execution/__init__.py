"""Execution: a skill on a robot, planned, closed loop on the handle (docs/execution.md).

Everything is imported when it is first asked for: it needs the extras `robot` and `stage`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from understudy.execution.outcome import Outcome as Outcome
from understudy.execution.outcome import Reason as Reason
from understudy.execution.outcome import Trajectory as Trajectory
from understudy.late import late_names

if TYPE_CHECKING:
    from understudy.execution.config import Config as Config
    from understudy.execution.execution import Execution as Execution
    from understudy.execution.planning import Plan as Plan
    from understudy.execution.planning import make_plan as make_plan
    from understudy.execution.surroundings import Observed as Observed

_LATE = {
    "Config": "config",
    "Execution": "execution",
    "Observed": "surroundings",
    "Plan": "planning",
    "make_plan": "planning",
}
_NEEDED = ("numba", "pinocchio", "mujoco")

__all__ = ["Config", "Execution", "Observed", "Outcome", "Plan", "Reason", "Trajectory", "make_plan"]

__getattr__ = late_names(__name__, _LATE, _NEEDED, "executing skills", "robot")
