"""When a robot cannot do what was shown."""

from understudy.errors import UnderstudyError


class InfeasibleError(UnderstudyError):
    """No trajectory keeps all constraints; the message says which edges of the graph fight, and where."""
