"""Execution: a skill on a robot, planned, closed loop on the handle (docs/execution.md).

Everything is imported when it is first asked for: it needs the extras `robot` and `stage`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from understudy.execution.outcome import Outcome as Outcome
from understudy.execution.outcome import Reason as Reason
from understudy.execution.outcome import Trajectory as Trajectory

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


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{__name__}.{_LATE[name]}"), name)
    except ModuleNotFoundError as e:
        from understudy.errors import MissingExtraError

        if e.name in _NEEDED:
            raise MissingExtraError("executing skills", "robot") from e
        raise
