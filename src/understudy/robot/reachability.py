"""Where the arm reaches: a map by sampling forward kinematics, and base placements by inverting it.

The map lives in the base's axes with the torso at height 0: a torso at height h only shifts z. A cell is a position
(8 cm), a direction of the tool's x axis (each face of a cube in 3 x 3) and a roll about it (8); how many samples fell
into it says how easily it is reached. The smooth function for optimisers is `ReachabilityField`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import gaussian_filter

from understudy.errors import UnderstudyError
from understudy.robot import store
from understudy.robot.field import ReachabilityField, load_field
from understudy.robot.map_kernels import CELL, ORIENTATIONS, cell_of, count_samples, scores
from understudy.robot.model import Robot

__all__ = ["Placements", "ReachabilityField", "ReachabilityMap", "build_map", "load_field", "load_map"]

FORMAT: Final = 1
"""counts changes of what is kept"""
SAMPLES: Final = 8_000_000
_CHUNKS: Final = 4
"""of the samples, each with its own random numbers: the result does not depend on the number of threads"""
_COLLISION_SHARE: Final = 1 / 250
"""of the samples are checked for self-collision"""
_YAWS: Final = 48


@dataclass(frozen=True, eq=False)
class Placements:
    """Base poses from which given tool poses are reached, best first."""

    base: Float[np.ndarray, "k 3"]
    """x, y (metres), yaw (radians), world"""
    score: Float[np.ndarray, " k"]
    """0 ... 1: of the tool pose that is worst to reach from there"""


@dataclass(frozen=True, eq=False)
class ReachabilityMap:
    """Scores of tool poses, 0 (not reached by any sample) to 1 (many configurations, free of self-collision)."""

    origin: Float[np.ndarray, "3"]
    """centre of the first cell: metres, base's axes, torso at height 0"""
    score: UInt8[np.ndarray, "x y z o"]
    """0 ... 255; o counts directions and rolls (`map_kernels.cell_of`)"""

    def reachable(
        self, T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Scores of n poses, interpolated in position."""
        return np.asarray(scores(self.score, self.origin, np.ascontiguousarray(T_base_tool), np.asarray(torso, float)))

    def base_placements(
        self, T_world_tool: Float[np.ndarray, "n 4 4"], torso: float, count: int = 200, step_m: float = CELL
    ) -> Placements:
        """The `count` best base poses from which all n tool poses are reached; fewer if there are not so many.

        Tries all base positions on a grid around the tool poses with `_YAWS` headings. torso: metres.
        """
        if not len(T_world_tool) or step_m <= 0:
            raise UnderstudyError("base placements: need at least one tool pose and a step above 0 m")
        candidates = self._candidates(T_world_tool[:, :2, 3], step_m)
        worst = np.ones(len(candidates))
        for T in T_world_tool:
            open_ = np.flatnonzero(worst > 0)
            heights = np.full(len(open_), torso)
            worst[open_] = np.minimum(worst[open_], self.reachable(_seen_from(candidates[open_], T), heights))
        order = np.argsort(-worst, kind="stable")[:count]
        order = order[worst[order] > 0]
        return Placements(candidates[order], worst[order])

    def _candidates(self, tools: Float[np.ndarray, "n 2"], step: float) -> Float[np.ndarray, "k 3"]:
        """All base poses near enough to each of the tools."""
        corners = self.origin[:2] + CELL * np.array([[0, 0], [self.score.shape[0] - 1, self.score.shape[1] - 1]])
        reach = float(np.abs(corners).max() * np.sqrt(2))
        low, high = tools.max(axis=0) - reach, tools.min(axis=0) + reach
        x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
        yaw = np.arange(_YAWS) * 2 * np.pi / _YAWS - np.pi
        grid = np.meshgrid(x, y, yaw, indexing="ij")
        return np.column_stack([g.ravel() for g in grid])


def _seen_from(base: Float[np.ndarray, "k 3"], T_world_tool: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "k 4 4"]:
    """T_base_tool for k base poses (x, y, yaw)."""
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    T = np.zeros((len(base), 4, 4))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1], T[:, 2, 2], T[:, 3, 3] = c, s, -s, c, 1, 1
    T[:, :2, 3] = -np.einsum("kij,kj->ki", T[:, :2, :2], base[:, :2])
    return T @ T_world_tool


def load_map(robot: Robot, samples: int = SAMPLES, cache: bool = True) -> ReachabilityMap:
    """The robot's map from the cache folder, or built now and kept. cache=False builds anew and keeps nothing."""
    settings = f"format {FORMAT}, {samples} samples"
    arrays = store.load(robot, "map", settings) if cache else None
    if arrays is not None:
        return ReachabilityMap(arrays["origin"], arrays["score"])
    built = build_map(robot, samples)
    if cache:
        store.save(robot, "map", settings, {"origin": built.origin, "score": built.score})
    return built


def build_map(robot: Robot, samples: int = SAMPLES, seed: int = 0) -> ReachabilityMap:
    """Samples the arm's joints uniformly within their limits."""
    q, _ = robot.sample(20_000, seed)
    reach = robot.forward(q, np.zeros(len(q)))[:, :3, 3]
    origin = np.floor(reach.min(axis=0) / CELL - 1) * CELL
    shape = tuple((np.ceil((reach.max(axis=0) - origin) / CELL) + 2).astype(int))
    low = np.append(0.0, np.where(robot.continuous, -np.pi, robot.lower))
    high = np.append(0.0, np.where(robot.continuous, np.pi, robot.upper))
    counts = np.zeros((*shape, ORIENTATIONS), np.uint32)

    def chunk(i: int) -> np.ndarray:
        part = np.zeros(counts.shape, np.uint16)
        count_samples(robot.fixed, low, high, samples // _CHUNKS, np.random.default_rng((seed, i)), origin, part)
        return part

    with ThreadPoolExecutor(2) as pool:
        for part in pool.map(chunk, range(_CHUNKS)):
            counts += part
    free = _free_share(robot, origin, counts.shape[:3], int(samples * _COLLISION_SHARE), seed)
    density = counts / max(float(np.percentile(counts[counts > 0], 90)), 1.0)
    score = np.minimum(density, 1.0) * free[..., None]
    return ReachabilityMap(origin, np.ceil(255 * score).astype(np.uint8))


def _free_share(
    robot: Robot, origin: Float[np.ndarray, "3"], shape: tuple[int, ...], samples: int, seed: int
) -> Float[np.ndarray, "x y z"]:
    """Share of samples without self-collision for each position, smoothed over neighbours; 0 below 5 %.

    Where no sample was checked, 1.
    """
    q, torso = robot.sample(samples, seed + 1)
    T = robot.forward(q, torso)
    T[:, 2, 3] -= torso
    index = np.round((T[:, :3, 3] - origin) / CELL).astype(int)
    inside: Bool[np.ndarray, " n"] = ((index >= 0) & (index < shape)).all(axis=1)
    free, every = np.zeros(shape), np.zeros(shape)
    np.add.at(every, tuple(index[inside].T), 1)
    np.add.at(free, tuple(index[inside].T), ~robot.collides(q, torso)[inside])
    smooth = (gaussian_filter(free, 0.7) + 0.02) / (gaussian_filter(every, 0.7) + 0.02)
    return np.where(smooth < 0.05, 0, np.minimum(smooth, 1))


def orientation_bins(T: Float[np.ndarray, "n 4 4"]) -> np.ndarray:
    """Index of each pose's orientation bin."""
    return np.array([cell_of(pose[:3, :3]) for pose in np.ascontiguousarray(T)])
