"""Why a trajectory came out as it did: the cost of every kind of edge over time, and which edges fight where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from understudy.adaptation.graph import Graph, State
from understudy.adaptation.weights import Stage
from understudy.demonstration.demonstration import Demonstration


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
    achieved: Bool[np.ndarray, " n"],
) -> str:
    """Which edges fight, per run of failing samples: those with the greatest cost there."""
    energies = energies_over_time(graph, state, stage)
    lines = []
    for number, (s, d) in enumerate(each):
        failed = ~(free[s] & achieved[s])
        edges_of_runs = np.flatnonzero(np.diff(np.concatenate([[False], failed, [False]]).astype(int)))
        for first, end in edges_of_runs.reshape(-1, 2):
            part = slice(s.start + int(first), s.start + int(end))
            cost = {kind: float(values[part].sum()) for kind, values in energies.items()}
            most = sorted((k for k in cost if cost[k] > 0), key=lambda k: -cost[k])[:3]
            segment = next(n for n, x in d.segments.slices(len(d)).items() if x.start <= first < x.stop)
            short = graph.weights.reach * float(np.sqrt(energies["reach"][part].max()))
            what = [] if achieved[part].all() else [f"out of reach (by up to {short:.2f} m)"]
            what += [] if free[part].all() else ["in collision with the map"]
            shares = ", ".join(f"{k} {100 * cost[k] / sum(cost.values()):.0f} %" for k in most)
            lines.append(
                f"  demonstration {number}, samples {first} to {end - 1} ({segment}, {d.times_s[first]:.1f} s): "
                f"{' and '.join(what)}; the edges that fight there: {shares} of the cost"
            )
    return "\n".join(lines[:20])
