"""One start, what the graph made of it, and what the exact checks say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from understudy.adaptation.checks import Checked
from understudy.adaptation.graph import Graph
from understudy.adaptation.solver import Convergence
from understudy.adaptation.start import Start

LOOSE: Final = 0.002
"""metres and radians: a grasp that is missed by more is none"""


@dataclass(frozen=True, eq=False)
class Attempt:
    """From one start to a solution."""

    start: Start
    graph: Graph
    found: Checked
    rounds: int
    convergence: Convergence

    @property
    def rank(self) -> tuple[bool, bool, int, int]:
        """The least is best: a grasp that is none; then what fails."""
        return float(self.graph.missed(self.found.state).max()) > LOOSE, *self.found.failures
