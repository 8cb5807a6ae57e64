"""Where the base may stand: a coarse search over offsets from the teacher's torso, before the graph bends anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from understudy import lie
from understudy.adaptation import edges
from understudy.adaptation.fields import half_planes, outline
from understudy.adaptation.graph import Problem, Surroundings
from understudy.adaptation.platform import Platform

_EVERY_S: Final = 0.7  # between moments of the search
_LEAST_MOMENTS: Final = 12
_SHORT_M: Final = 0.02  # of reach or clearance that cost as much as `_FAR` of offset
_FAR: Final = np.array([0.4, 0.4, np.radians(45)])  # offset from the torso, or between moments, that costs 1
_MOVE: Final = np.array([0.15, 0.15, np.radians(20)])
_INNER: Final = 0.8
_FINE_S: Final = 0.2
_FINE_SHARE: Final = 0.5  # of _MOVE
_ENOUGH: Final = 80  # moments in all, for the calibration
_WORST: Final = 400.0  # greatest cost of one constraint at one moment


def _grid(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> Float[np.ndarray, "k 3"]:
    return np.stack(np.meshgrid(x, y, yaw, indexing="ij"), axis=-1).reshape(-1, 3)


_PATH_OFFSETS: Final = _grid(
    np.linspace(-0.45, 0.45, 7), np.linspace(-0.6, 0.6, 9), np.radians([-60.0, -30, 0, 30, 60])
)
_FINE_OFFSETS: Final = _grid(
    np.linspace(-0.16, 0.16, 9), np.linspace(-0.16, 0.16, 9), np.radians(np.linspace(-24.0, 24, 9))
)
_CALIBRATION_OFFSETS: Final = _grid(
    np.linspace(-0.9, 0.3, 9), np.linspace(-0.6, 0.6, 9), np.radians(np.linspace(-60, 60, 7))
)


@dataclass(frozen=True, eq=False)
class Search:
    """What the searches look at."""

    problem: Problem
    platform: Platform
    gripper: Float[np.ndarray, "n 4 4"]
    torso: float
    """height at which reach is looked up, metres"""
    margin: float = 0.04
    """metres that are kept from obstacles and from the end of reach"""

    def costs(
        self, around: Surroundings, steps: Int[np.ndarray, " m"], base: Float[np.ndarray, "m k 3"]
    ) -> Float[np.ndarray, "m k"]:
        """How badly each of k base poses suits the gripper and the obstacles at each of m steps."""
        m, k = base.shape[:2]
        blocked = self.blocked(around, base.reshape(-1, 3)).reshape(m, k)
        return blocked + self.reach_and_panel(steps, base)

    def blocked(self, around: Surroundings, base: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """What the map has against each base pose."""
        polygon = self.platform.footprint
        inner = outline(polygon * _INNER, 0.2)  # a single cell between outline and inner circle is an obstacle, too
        points = np.vstack([outline(polygon, 0.12), inner, np.zeros((1, 2))])
        radii = np.append(np.zeros(len(points) - 1), max(float(half_planes(polygon)[1].min()), 0.0))
        return _cost(edges.base_clearance(around.obstacles, points, radii, base, self.margin)[0].max(axis=1))

    def reach_and_panel(
        self, steps: Int[np.ndarray, " m"], base: Float[np.ndarray, "m k 3"]
    ) -> Float[np.ndarray, "m k"]:
        """What gripper and moving part have against each of k base poses at each of m steps."""
        m, k = base.shape[:2]
        flat = base.reshape(-1, 3)
        field, rest = self.platform.reachability, np.full(m * k, self.torso)
        gripper = np.repeat(self.gripper[steps], k, axis=0)
        short = edges.reach(field, gripper, flat, rest, self.margin)[0][:, 0]
        panel = np.repeat(self.problem.panel[steps], k, axis=0)
        hit = edges.panel_clearance(self.platform.footprint, panel, flat, self.margin)[0].max(axis=1)
        return (_cost(short) + _cost(hit)).reshape(m, k)

    def mean_cost(self, around: Surroundings, base: Float[np.ndarray, "t 3"]) -> float:
        """Of all steps of a path."""
        steps = np.arange(around.steps.start, around.steps.stop)
        return float(self.costs(around, steps, base[:, None]).mean())

    def moments(self, around: Surroundings, every: int | None = None) -> Int[np.ndarray, " m"]:
        """Steps to look at: evenly spread, first and last and the grasp among them."""
        s = around.steps
        if every is None:
            dt = float(np.nanmedian(self.problem.dt[s]))
            every = max(1, min(round(_EVERY_S / dt), (s.stop - s.start) // _LEAST_MOMENTS))
        grasp = self.problem.grasp_steps
        grasp = grasp[(grasp >= s.start) & (grasp < s.stop)]
        return np.unique(np.concatenate([np.arange(s.start, s.stop, every), [s.stop - 1], grasp]))


def _cost(violation: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    return np.asarray(np.minimum((violation / _SHORT_M) ** 2, _WORST))


def estimate_torso_base(
    search: Search, torso: Sequence[Float[np.ndarray, "t 3"]], default: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Y: the one offset from the torso that suits gripper and obstacles best at all moments of all demonstrations."""
    total = np.zeros(len(_CALIBRATION_OFFSETS))
    around = search.problem.surroundings
    every = max(1, sum(s.steps.stop - s.steps.start for s in around) // _ENOUGH)
    count = 0
    for s, path in zip(around, torso, strict=True):
        steps = search.moments(s, every)
        base = lie.se2_compose(path[steps - s.steps.start][:, None], _CALIBRATION_OFFSETS[None])
        total += np.minimum(search.costs(s, steps, base), _WORST / 4).sum(axis=0)
        count += len(steps)
    prior = np.sum(((_CALIBRATION_OFFSETS - default) / _FAR) ** 2, axis=1)
    return np.asarray(_CALIBRATION_OFFSETS[int(np.argmin(total / count + prior))])


def search_path(
    search: Search, around: Surroundings, base: Float[np.ndarray, "t 3"], *, fine: bool = False
) -> tuple[Float[np.ndarray, "t 3"], float]:
    """The base path near `base` (P Y) that suits best, by dynamic programming over offsets; and its worst cost.

    fine: small offsets at many moments, for a path that is nearly good.
    The worst cost is that of reach and obstacles at one moment; about 1 where they are violated by 2 cm.
    """
    offsets, move = (_FINE_OFFSETS, _FINE_SHARE * _MOVE) if fine else (_PATH_OFFSETS, _MOVE)
    dt = float(np.nanmedian(search.problem.dt[around.steps]))
    steps = search.moments(around, max(1, round(_FINE_S / dt)) if fine else None)
    local = steps - around.steps.start
    poses = lie.se2_compose(base[local][:, None], offsets[None])
    unary = search.costs(around, steps, poses)
    prior = np.sum((offsets / _FAR) ** 2, axis=1)
    best, arg = unary[0] + prior, []
    for i in range(1, len(steps)):
        a, b = poses[i - 1] / move, poses[i] / move
        middle = a.mean(axis=0)  # the squares below lose no digits near it
        a, b = a - middle, b - middle
        total = (best + np.sum(a**2, axis=1))[:, None] + np.sum(b**2, axis=1) - 2 * (a @ b.T)
        arg.append(np.argmin(total, axis=0))
        best = total[arg[-1], np.arange(len(prior))] + unary[i] + prior
    choice = [int(np.argmin(best))]
    for back in reversed(arg):
        choice.append(int(back[choice[-1]]))
    chosen = np.array(choice[::-1])
    path = poses[np.arange(len(steps)), chosen]
    t = np.arange(len(base))
    full = np.column_stack([np.interp(t, local, column) for column in path.T])
    return full, float(unary[np.arange(len(steps)), chosen].max())
