"""Where the base may stand: a coarse search over offsets from the teacher's torso, before the graph bends anything."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from understudy import lie
from understudy.adaptation import edges
from understudy.adaptation.fields import half_planes, outline, polygon_values
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
_MOST_M: Final = _SHORT_M * np.sqrt(_WORST) + edges.SOFT_M  # of a violation: beyond, it costs no more


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
    memory: dict[tuple[object, ...], np.ndarray] = field(default_factory=dict)
    """costs that were computed before: neither map nor moving part ask for the torso's height"""

    def costs(
        self, around: Surroundings, steps: Int[np.ndarray, " m"], base: Float[np.ndarray, "m k 3"]
    ) -> Float[np.ndarray, "m k"]:
        """How badly each of k base poses suits the gripper and the obstacles at each of m steps."""
        m, k = base.shape[:2]
        blocked = self.blocked(around, base.reshape(-1, 3)).reshape(m, k)
        return blocked + self.reach_and_panel(steps, base)

    def blocked(self, around: Surroundings, base: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """What the map has against each base pose."""
        key = ("map", self.margin, around.steps.start, _digest(base))
        if key not in self.memory:
            self.memory[key] = self._cost_of_map(around, base)
        return self.memory[key]

    def _cost_of_map(self, around: Surroundings, base: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        polygon, obstacles = self.platform.footprint, around.obstacles
        inner = outline(polygon * _INNER, 0.2)  # a single cell between outline and inner circle is an obstacle, too
        points = np.vstack([outline(polygon, 0.12), inner])
        middle = obstacles.values_at(base[:, :2])
        room = -middle + max(float(half_planes(polygon)[1].min()), 0.0)
        # distances change by at most the way gone: nothing is near, or the middle alone costs the most
        far = middle > float(np.linalg.norm(points, axis=1).max()) + self.margin + edges.SOFT_M + 2 * obstacles.cell_m
        look = np.flatnonzero(~far & (room + self.margin < _MOST_M))
        c, s = np.cos(base[look, 2]), np.sin(base[look, 2])
        world = np.empty((len(look), len(points), 2))
        world[..., 0] = base[look, None, 0] + c[:, None] * points[:, 0] - s[:, None] * points[:, 1]
        world[..., 1] = base[look, None, 1] + s[:, None] * points[:, 0] + c[:, None] * points[:, 1]
        nearest = obstacles.values_at(world.reshape(-1, 2)).reshape(len(look), len(points)).min(axis=1, initial=np.inf)
        room[look] = np.maximum(room[look], -nearest)
        return _cost(np.where(far, 0.0, edges.hinge(room + self.margin, edges.SOFT_M)[0]))

    def reach_and_panel(
        self, steps: Int[np.ndarray, " m"], base: Float[np.ndarray, "m k 3"]
    ) -> Float[np.ndarray, "m k"]:
        """What gripper and moving part have against each of k base poses at each of m steps."""
        m, k = base.shape[:2]
        flat = base.reshape(-1, 3)
        seen = lie.se3_inverse(lie.se2_to_se3(flat)).reshape(m, k, 4, 4) @ self.gripper[steps][:, None]
        value = self.platform.reachability.value(seen.reshape(-1, 4, 4), np.full(m * k, self.torso))
        short = edges.hinge(value + self.margin, edges.SOFT_M)[0]
        key = ("part", self.margin, _digest(steps), _digest(flat))
        if key not in self.memory:
            self.memory[key] = self._cost_of_panel(steps, base)
        return (_cost(short) + self.memory[key]).reshape(m, k)

    def _cost_of_panel(self, steps: Int[np.ndarray, " m"], base: Float[np.ndarray, "m k 3"]) -> Float[np.ndarray, " n"]:
        """Of the points of the moving part that are near enough, the one deepest in the footprint."""
        m, k = base.shape[:2]
        polygon, panel = self.platform.footprint, self.problem.panel[steps]
        room = self.margin + edges.SOFT_M
        away = panel[:, None] - base[:, :, None, :2]
        radius = float(np.linalg.norm(polygon, axis=1).max()) + room
        with np.errstate(invalid="ignore"):  # NaN: no point
            pose, point = np.nonzero((np.sum(away**2, axis=3) < radius**2).reshape(m * k, -1))
        dx, dy = away.reshape(m * k, -1, 2)[pose, point].T
        yaw = base.reshape(-1, 3)[pose, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        depth = np.full(m * k, -np.inf)
        np.maximum.at(depth, pose, self.margin - polygon_values(polygon, c * dx + s * dy, c * dy - s * dx))
        return _cost(edges.hinge(np.maximum(depth, -room), edges.SOFT_M)[0])

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


def _digest(x: np.ndarray) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(x).tobytes(), digest_size=16).digest()


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
