"""A path for the base to start the graph from: the cheapest one on a lattice over x, y, yaw and time.

A least-squares graph that starts on the wrong side of a door frame stays there. The lattice lies along the object's
front, so that one of its headings goes straight through a doorway. Its cost is that of `placement.Search`: reach,
map and moving part, with the base's outline as it is turned. Moves from one moment to the next cost their squared
length, so the cheapest path is found with distance transforms, one axis after the other (Felzenszwalb & Huttenlocher
2012), here with windows of a few cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from understudy.adaptation.graph import Surroundings
from understudy.adaptation.placement import Search
from understudy.lie import wrapped

_EVERY_S: Final = 0.5  # between moments, on the demonstration's clock
_MOST: Final = 22  # moments; a longer demonstration has them farther apart
_CELL_M: Final = 0.09
_HEADINGS: Final = 24
_AROUND_M: Final = 0.75  # of the lattice around the way that the torso went
_FAR_M: Final = 0.4  # from P Y that costs 1
_FAR_TURN: Final = np.radians(45)
_MOVE_M: Final = 0.15  # between moments half a second apart that costs 1
_MOVE_TURN: Final = np.radians(25)
_WINDOW: Final = 4  # cells or headings from one moment to the next
_CLOSER: Final = (0.7, np.radians(80))  # from P Y: reach is looked up within
_WORST: Final = 400.0  # cost of a pose that is not looked at


@dataclass(frozen=True, eq=False)
class _Lattice:
    """Base poses (x, y, heading), along a front."""

    poses: Float[np.ndarray, "i j h 3"]
    heading_step: float

    @classmethod
    def around(cls, path: Float[np.ndarray, "t 3"], front: float) -> _Lattice:
        """Covers the path with room to every side; front: its first heading (radians)."""
        c, s = np.cos(front), np.sin(front)
        R = np.array([[c, -s], [s, c]])
        local = path[:, :2] @ R
        low, high = local.min(axis=0) - _AROUND_M, local.max(axis=0) + _AROUND_M
        x, y = (np.arange(a, b + _CELL_M, _CELL_M) for a, b in zip(low, high, strict=True))
        step = 2 * np.pi / _HEADINGS
        grid = np.stack(np.meshgrid(x, y, front + step * np.arange(_HEADINGS), indexing="ij"), axis=-1)
        grid[..., :2] = grid[..., :2] @ R.T
        return cls(grid, step)


def plan_path(
    search: Search, around: Surroundings, base: Float[np.ndarray, "t 3"], front: float
) -> Float[np.ndarray, "t 3"]:
    """The cheapest base path near `base` (P Y). front: heading (radians) straight towards the object's front."""
    steps = _moments(search, around)
    local = steps - around.steps.start
    lattice = _Lattice.around(base[local], front)
    flat = lattice.poses.reshape(-1, 3)
    blocked = search.blocked(around, flat)
    total, arrows = np.zeros(lattice.poses.shape[:3]), []
    for m, (step, wanted) in enumerate(zip(steps.tolist(), base[local], strict=True)):
        if m:
            total, back = _moved(total, lattice.heading_step)
            arrows.append(back)
        here = _costs(search, step, flat, blocked, wanted) + _offset(flat, wanted)
        total = total + here.reshape(total.shape)
    chosen = _backtracked(total, arrows)
    path = flat[chosen]
    path[:, 2] = np.unwrap(path[:, 2])
    path[:, 2] += 2 * np.pi * np.round((base[local, 2] - path[:, 2]).mean() / (2 * np.pi))
    t = np.arange(len(base))
    full = np.column_stack([np.interp(t, local, column) for column in path.T])
    return full


def _moments(search: Search, around: Surroundings) -> Int[np.ndarray, " m"]:
    dt = float(np.nanmedian(search.problem.dt[around.steps]))
    n = around.steps.stop - around.steps.start
    return search.moments(around, max(1, round(_EVERY_S / dt), int(np.ceil(n / _MOST))))


def _offset(flat: Float[np.ndarray, "n 3"], wanted: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
    """Cost of being elsewhere than the teacher."""
    away = np.sum((flat[:, :2] - wanted[:2]) ** 2, axis=1) / _FAR_M**2
    return away + (wrapped(flat[:, 2] - wanted[2]) / _FAR_TURN) ** 2


def _costs(
    search: Search,
    step: int,
    flat: Float[np.ndarray, "n 3"],
    blocked: Float[np.ndarray, " n"],
    wanted: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " n"]:
    """Of reach and obstacles; only poses that are free and near enough to the teacher's are looked at closely."""
    out = np.full(len(flat), 2 * _WORST)
    near = (np.linalg.norm(flat[:, :2] - wanted[:2], axis=1) < _CLOSER[0]) & (blocked < _WORST)
    near &= np.abs(wrapped(flat[:, 2] - wanted[2])) < _CLOSER[1]
    rows = np.flatnonzero(near)
    out[rows] = blocked[rows] + search.reach_and_panel(np.array([int(step)]), flat[None, rows])[0]
    return out


def _moved(total: Float[np.ndarray, "i j h"], heading_step: float) -> tuple[np.ndarray, list[Int[np.ndarray, "i j h"]]]:
    """The least of total + squared length of the move, per axis, and where along each axis it came from."""
    arrows = []
    for axis, unit in enumerate((_CELL_M / _MOVE_M, _CELL_M / _MOVE_M, heading_step / _MOVE_TURN)):
        best, arrow = total.copy(), np.zeros(total.shape, np.int8)
        for shift in (s for s in range(-_WINDOW, _WINDOW + 1) if s):
            moved = np.roll(total, shift, axis)
            if axis < 2:
                edge = [slice(None)] * 3
                edge[axis] = slice(0, shift) if shift > 0 else slice(shift, None)
                moved[tuple(edge)] = np.inf
            moved += (unit * shift) ** 2
            better = moved < best
            best[better], arrow[better] = moved[better], shift
        total = best
        arrows.append(arrow)
    return total, arrows


def _backtracked(total: np.ndarray, arrows: list[list[np.ndarray]]) -> Int[np.ndarray, " m"]:
    shape = total.shape
    place = list(np.unravel_index(int(np.argmin(total)), shape))
    chosen = [np.ravel_multi_index(place, shape)]
    for steps in reversed(arrows):
        for axis in (2, 1, 0):
            place[axis] = (place[axis] - int(steps[axis][tuple(place)])) % shape[axis]
        chosen.append(np.ravel_multi_index(place, shape))
    return np.array(chosen[::-1], dtype=np.int64)
