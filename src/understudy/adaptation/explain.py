"""Why a trajectory came out as it did: the cost of every kind of edge over time, and which edges fight where."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.fields import half_planes
from understudy.adaptation.graph import Graph, State
from understudy.adaptation.weights import Stage
from understudy.demonstration.demonstration import OCCUPIED, Demonstration, OccupancyMap

_DIRECTIONS: Final = 36
"""over half a turn, in which the width of a passage is measured"""


def energies_over_time(graph: Graph, state: State, stage: Stage) -> dict[str, Float[np.ndarray, " n"]]:
    """Cost per kind of edge at every step."""
    out: dict[str, np.ndarray] = {}
    for e in graph.linearise(state, stage):
        np.add.at(out.setdefault(e.kind, np.zeros(len(state.torso))), e.steps, e.cost)
    return out


def conflicts(
    graph: Graph,
    state: State,
    stage: Stage,
    each: Sequence[tuple[slice, Demonstration]],
    free: Bool[np.ndarray, " n"],
    beside: Bool[np.ndarray, " n"],
    achieved: Bool[np.ndarray, " n"],
) -> str:
    """Which edges fight, per run of failing samples: those with the greatest cost there."""
    energies = energies_over_time(graph, state, stage)
    lines = []
    for number, (s, d) in enumerate(each):
        failed = ~(free[s] & beside[s] & achieved[s])
        edges_of_runs = np.flatnonzero(np.diff(np.concatenate([[False], failed, [False]]).astype(int)))
        for first, end in edges_of_runs.reshape(-1, 2):
            part = slice(s.start + int(first), s.start + int(end))
            cost = {kind: float(values[part].sum()) for kind, values in energies.items()}
            most = sorted((k for k in cost if cost[k] > 0), key=lambda k: -cost[k])[:3]
            segment = next(n for n, x in d.segments.slices(len(d)).items() if x.start <= first < x.stop)
            short = graph.weights.reach * float(np.sqrt(energies["reach"][part].max()))
            what = [] if achieved[part].all() else [f"out of reach (by up to {short:.2f} m)"]
            hit = part.start + np.flatnonzero(~free[part])
            what += [_collision(d.map, graph.platform.footprint, state.base[hit])] if len(hit) else []
            what += [] if beside[part].all() else ["where the moving part is"]
            shares = ", ".join(f"{k} {100 * cost[k] / sum(cost.values()):.0f} %" for k in most)
            lines.append(
                f"  demonstration {number}, samples {first} to {end - 1} ({segment}, {d.times_s[first]:.1f} s): "
                f"{' and '.join(what)}; the edges that fight there: {shares} of the cost"
            )
    return "\n".join(lines[:20])


def _collision(map: OccupancyMap, footprint: Float[np.ndarray, "k 2"], base: Float[np.ndarray, "n 3"]) -> str:
    """Where the base meets the map: and whether it could pass there at all."""
    normals, offsets = half_planes(footprint)
    needed = float((offsets + (-normals @ footprint.T).max(axis=1)).min())
    widest = min(_passage(map, place) for place in base[:, :2])
    if widest >= needed:
        return "in collision with the map"
    return f"in collision with the map (too narrow: {widest:.2f} m between obstacles, the base needs {needed:.2f} m)"


def _passage(map: OccupancyMap, place: Float[np.ndarray, "2"]) -> float:
    """Metres between the nearest obstacles to both sides of a place, in the direction in which that is least."""
    row, column = np.nonzero(map.state == OCCUPIED)
    away = map.origin_xy + map.resolution_m * np.column_stack([column, row]) - place
    angle = np.pi / _DIRECTIONS * np.arange(_DIRECTIONS)
    across = away @ np.array([np.cos(angle), np.sin(angle)])
    beside = np.abs(away @ np.array([-np.sin(angle), np.cos(angle)])) < map.resolution_m
    left = np.where(beside & (across > 0), across, np.inf).min(axis=0, initial=np.inf)
    right = np.where(beside & (across <= 0), -across, np.inf).min(axis=0, initial=np.inf)
    return float(np.maximum(left + right - map.resolution_m, 0.0).min())
