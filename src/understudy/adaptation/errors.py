"""When a robot cannot do what was shown."""

from __future__ import annotations

from collections.abc import Mapping

from understudy.errors import UnderstudyError


class InfeasibleError(UnderstudyError):
    """No trajectory keeps all constraints; the message says which edges of the graph fight, and where."""

    def __init__(self, message: str, failing: Mapping[int, int] | None = None):
        super().__init__(message)
        self.failing = dict(failing or {})
        """number of a demonstration -> samples at which checks fail"""
