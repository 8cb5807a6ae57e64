"""The room that furniture leaves to a person: distances to its boxes, and a first path for the body by dynamic
programming over places on the floor and time.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from understudy.lie import wrapped
from understudy.stage.furniture import Box, Furniture

DT: Final = 0.2
"""Seconds between the path's places."""
_CELL: Final = 0.06  # metres
_REACH_CELLS: Final = 4  # that a body moves at most in DT: 1.2 m/s
_LOW, _HIGH = 0.05, 1.85  # metres of height in which a box is in a body's way
_BODY_RADIUS: Final = 0.27  # metres that the body's middle keeps away
_HANDLE_WAY: Final = 0.52  # metres from the middle of the body to the hand, seen from above
_WIDE: Final = 1e3  # cost of standing in a box


class Space:
    """Boxes that stand still and boxes that move with the furniture's part."""

    def __init__(self, furniture: Furniture) -> None:
        self.articulation = furniture.articulation
        self.still = list(furniture.blocks)
        self.moving = [furniture.panel, *furniture.parts]

    def distance(self, points: Float[np.ndarray, "t m 3"], q: Float[np.ndarray, " t"]) -> Float[np.ndarray, "t m"]:
        """Signed distance of points to the nearest box, the part being at q; negative inside. Metres."""
        T = self.articulation.pose(q)
        nearest = np.full(points.shape[:2], np.inf)
        for box in self.still:
            nearest = np.minimum(nearest, _to_box(points, box.T_frame_box[None], box))
        for box in self.moving:
            nearest = np.minimum(nearest, _to_box(points, T @ box.T_frame_box, box))
        return nearest

    def on_floor(self, xy: Float[np.ndarray, "n 2"], q: float) -> Float[np.ndarray, " n"]:
        """Distance of places on the floor to whatever a body would bump into, seen from above."""
        T = self.articulation.pose(np.array([q]))[0]
        nearest = np.full(len(xy), np.inf)
        for box, pose in [(b, b.T_frame_box) for b in self.still] + [(b, T @ b.T_frame_box) for b in self.moving]:
            high = np.abs(pose[2, :3]) @ np.array(box.half_m)
            if pose[2, 3] + high < _LOW or pose[2, 3] - high > _HIGH:
                continue
            points = np.column_stack([xy, np.full(len(xy), pose[2, 3])])
            nearest = np.minimum(nearest, _to_box(points[None], pose[None], box)[0])
        return nearest


def _to_box(
    points: Float[np.ndarray, "t m 3"], T_world_box: Float[np.ndarray, "k 4 4"], box: Box
) -> Float[np.ndarray, "t m"]:
    local = (points - T_world_box[:, None, :3, 3]) @ T_world_box[:, :3, :3]
    out = np.abs(local) - np.array(box.half_m)
    return np.asarray(np.linalg.norm(np.maximum(out, 0.0), axis=-1) + np.minimum(out.max(-1), 0.0))


def floor_path(
    space: Space,
    q: Float[np.ndarray, " t"],
    hand: Float[np.ndarray, "t 3"],
    bound: Float[np.ndarray, " t"],
    start: Float[np.ndarray, "2"],
    goal: Float[np.ndarray, "2"],
    free_s: tuple[float, float],
) -> Float[np.ndarray, "t 2"]:
    """Places of the body's middle every DT seconds: the least costly way past everything, near the hand while it holds.

    hand: x, y of the acting hand on the handle and the heading of its fingers. bound: 0 to 1, how much the body has to
    be near it. free_s: the body stands still before the first and after the second of these times.
    """
    lows, highs = np.minimum(start, goal), np.maximum(start, goal)
    lows, highs = np.minimum(lows, hand[:, :2].min(0)) - 0.8, np.maximum(highs, hand[:, :2].max(0)) + 0.8
    shape = np.ceil((highs - lows) / _CELL).astype(int) + 1
    cells = np.stack(np.meshgrid(*(np.arange(n) * _CELL for n in shape), indexing="ij"), -1) + lows
    flat = cells.reshape(-1, 2)
    steps = range(-_REACH_CELLS, _REACH_CELLS + 1)
    moves = [(i, j) for i in steps for j in steps if i * i + j * j <= _REACH_CELLS**2]
    total = np.where(np.linalg.norm(cells - start, axis=-1) < 0.75 * _CELL, 0.0, 1e6)
    came: list[np.ndarray] = []
    clear: dict[float, np.ndarray] = {}
    for k in range(len(q)):
        key = round(float(q[k]), 2)
        if key not in clear:
            gap = _BODY_RADIUS - space.on_floor(flat, float(q[k]))
            clear[key] = (_WIDE * np.clip(gap, 0, 0.3) ** 1.5 + 2.0 * np.clip(gap + 0.08, 0, None)).reshape(shape)
        here = clear[key] + bound[k] * _discomfort(cells, hand[k])
        if k == 0:
            total = total + here
            continue
        stands = k * DT < free_s[0] or k * DT > free_s[1]
        best, back = np.full(total.shape, np.inf), np.zeros(total.shape, int)
        for index, (i, j) in enumerate(moves):
            if stands and (i or j):
                continue
            cost = _shifted(total, i, j) + 0.35 * (i * i + j * j) * (_CELL / DT) ** 2
            better = cost < best
            best, back = np.where(better, cost, best), np.where(better, index, back)
        total = best + here
        came.append(back)
    total = total + 4.0 * np.sum((cells - goal) ** 2, -1)
    spot = np.unravel_index(int(total.argmin()), total.shape)
    out = [spot]
    for back in reversed(came):
        i, j = moves[int(back[spot])]
        spot = (spot[0] - i, spot[1] - j)
        out.append(spot)
    path = np.array([cells[s] for s in reversed(out)])
    return np.asarray(gaussian_filter1d(path, 0.35 / DT, axis=0, mode="nearest"))


def _discomfort(cells: Float[np.ndarray, "a b 2"], hand: Float[np.ndarray, "3"]) -> Float[np.ndarray, "a b"]:
    """How badly the body would stand for a hand at x, y with the fingers heading as given."""
    way = hand[:2] - cells
    distance = np.linalg.norm(way, axis=-1)
    turn = np.arctan2(way[..., 1], way[..., 0]) - hand[2]
    turn = np.abs(wrapped(turn))
    far = ((distance - _HANDLE_WAY) / 0.10) ** 2
    return np.minimum(far, 40.0) + np.clip(turn - 0.5, 0, None) ** 2 * 6.0


def _shifted(values: Float[np.ndarray, "a b"], i: int, j: int) -> Float[np.ndarray, "a b"]:
    """out[a, b] = values[a - i, b - j], infinite where that is outside."""
    out = np.full(values.shape, np.inf)
    a, b = values.shape
    out[max(i, 0) : a + min(i, 0), max(j, 0) : b + min(j, 0)] = values[
        max(-i, 0) : a + min(-i, 0), max(-j, 0) : b + min(-j, 0)
    ]
    return out
