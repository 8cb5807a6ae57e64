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

    All together first. If that is refused, those that are feasible alone are taken together; then fewer and fewer of
    them: those that open to the same side, and without the one that failed at most samples. Raises InfeasibleError
    when none is feasible even alone.
    """
    config = config or AdaptConfig()
    try:
        return adapt(demonstrations, robot, config=config), {}
    except InfeasibleError as together:
        if len(demonstrations) == 1:
            raise
        first = together
    alone: dict[int, AdaptationResult] = {}
    left_out: dict[int, str] = {}
    for i, d in enumerate(demonstrations):
        try:
            alone[i] = adapt([d], robot, config=config)
        except InfeasibleError as e:
            left_out[i] = str(e)
    if not alone:
        raise first
    kept = tuple(alone)
    groups = {kept, *_sides(demonstrations, kept), *((i,) for i in kept)}
    tried: set[tuple[int, ...]] = set()
    if not left_out:
        tried.add(kept)
        groups.add(_without_worst(kept, first))
    while groups - tried:
        group = min(groups - tried, key=lambda g: (-len(g), g))
        tried.add(group)
        rest = {i: "cannot be adapted together with the others that were kept" for i in kept if i not in group}
        if len(group) == 1:
            return alone[group[0]], left_out | rest
        try:
            return adapt([demonstrations[i] for i in group], robot, config=config), left_out | rest
        except InfeasibleError as e:
            groups.add(_without_worst(group, e))
    raise first


def _without_worst(group: tuple[int, ...], error: InfeasibleError) -> tuple[int, ...]:
    """Less the demonstration at which most samples failed (nothing less, if that is not known)."""
    worst = max(error.failing, key=lambda i: error.failing[i], default=None)
    return tuple(i for place, i in enumerate(group) if place != worst)


def _sides(demonstrations: Sequence[Demonstration], kept: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Those that open to the same side."""
    sides = [tuple(i for i in kept if _side(demonstrations[i]) == side) for side in (1, -1)]
    return [g for g in sides if 1 < len(g) < len(kept)]


def _side(demonstration: Demonstration) -> int:
    """To which side of its handle the part goes; demonstrations of different sides are mirror images."""
    articulation = demonstration.articulation.in_part()
    middle = articulation.pose(np.array([max(articulation.range) / 2]))[0, :3, 3]
    return 1 if middle[1] >= 0 else -1
