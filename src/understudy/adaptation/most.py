"""Adapting as many demonstrations together as can be: what one robot cannot do as shown should not cost the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from understudy.adaptation.adapt import AdaptConfig, adapt
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.platform import Platform
from understudy.adaptation.result import AdaptationResult
from understudy.demonstration.demonstration import Demonstration
from understudy.robot.model import Robot


def adapt_most(
    demonstrations: Sequence[Demonstration], robot: Robot | Platform, *, config: AdaptConfig | None = None
) -> tuple[AdaptationResult, dict[int, str]]:
    """The adaptation of the largest set that is found feasible, and why the others (by their number) were left out.

    All together first. If that is refused: those that are feasible alone; then those of them that open to the same
    side, the larger group first; then single ones. Raises InfeasibleError when none is feasible even alone.
    """
    config = config or AdaptConfig()
    everything = list(range(len(demonstrations)))
    try:
        return adapt(demonstrations, robot, config=config), {}
    except InfeasibleError as together:
        if len(everything) == 1:
            raise
        first = together
    alone: dict[int, AdaptationResult] = {}
    left_out: dict[int, str] = {}
    for i in everything:
        try:
            alone[i] = adapt([demonstrations[i]], robot, config=config)
        except InfeasibleError as e:
            left_out[i] = str(e)
    if not alone:
        raise first
    kept = list(alone)
    for group in _groups(demonstrations, kept, tried=kept if not left_out else []):
        rest = {i: "cannot be adapted together with the others that were kept" for i in kept if i not in group}
        if len(group) == 1:
            return alone[group[0]], left_out | rest
        try:
            return adapt([demonstrations[i] for i in group], robot, config=config), left_out | rest
        except InfeasibleError:
            continue
    raise first


def _groups(demonstrations: Sequence[Demonstration], kept: list[int], tried: list[int]) -> list[list[int]]:
    """Sets that are worth a try, in order; the last ones are single."""
    sides = [[i for i in kept if _side(demonstrations[i]) == side] for side in (1, -1)]
    larger = sorted((g for g in sides if 1 < len(g) < len(kept)), key=len, reverse=True)
    together = [kept] if kept != tried and len(kept) > 1 else []
    return [*together, *larger, *([i] for i in kept)]


def _side(demonstration: Demonstration) -> int:
    """To which side of its handle the part goes; demonstrations of different sides are mirror images."""
    articulation = demonstration.articulation.in_part()
    middle = articulation.pose(np.array([max(articulation.range) / 2]))[0, :3, 3]
    return 1 if middle[1] >= 0 else -1
