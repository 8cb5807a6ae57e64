"""How far a tool pose is from what the arm can reach: a smooth function with gradients, learned from exact IK."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from understudy.robot import store
from understudy.robot.ik import LENGTH, IKProblem, embed, first_free, seed_table
from understudy.robot.model import Robot
from understudy.robot.regressor import Regressor, train

FORMAT: Final = 1
"""counts changes of what is learned or kept"""
SAMPLES: Final = 80_000
_HIDDEN: Final = 64
_EPOCHS: Final = 60
_INSIDE: Final = 0.03
"""metres: how far beyond the boundary, along its normal, the network is told that it is inside"""
_SHALLOW: Final = 0.005
"""metres: all reachable poses are to stay below minus this"""
_TYPICAL_SHARE: Final = 0.35
_NEAR: Final = 0.4
"""metres: the nearest reachable pose is kept up to this distance"""
_CHUNK: Final = 1000
_COLLIDING: Final = 0.03
"""metres: least distance given to poses that are reached only with a collision"""


@dataclass(frozen=True, eq=False)
class Labels:
    """What exact IK says of n poses."""

    T: Float[np.ndarray, "n 4 4"]
    torso: Float[np.ndarray, " n"]
    reachable: Bool[np.ndarray, " n"]
    """within limits and without self-collision"""
    distance: Float[np.ndarray, " n"]
    """metres (a radian counts `LENGTH` metres) to the reachable set; 0 for the reachable"""
    nearest: Float[np.ndarray, "n 4 4"]
    """the reachable pose that is nearest, for those just out of reach (`_NEAR`); else NaN"""


@dataclass(frozen=True, eq=False)
class Targets:
    """What the network is to say of n poses: `value`, or where `bound` is set, not more than `value`."""

    T: Float[np.ndarray, "n 4 4"]
    torso: Float[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    bound: Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class ReachabilityField:
    """value <= 0: reachable with a margin; outside it grows with the distance (metres; a radian counts `LENGTH`)."""

    shoulder: Float[np.ndarray, "3"]
    """origin of the first arm joint, base frame, torso at height 0"""
    network: Regressor
    margin: float
    """metres added to the network's value, so that few poses pass for reachable that are not"""

    def value(self, T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The value of `distance` alone, in less than half of the time."""
        return self.network.value(_features(T_base_tool, torso, self.shoulder)[0]) + self.margin

    def distance(
        self, T_base_tool: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 6"], Float[np.ndarray, " n"]]:
        """(value, d_pose, d_torso) of n poses with the torso at given heights (metres).

        d_pose: derivative by a right perturbation T Exp(xi), xi = (translation, rotation) in the tool's frame.
        """
        features, offset = _features(T_base_tool, torso, self.shoulder)
        value, g = self.network.value_and_gradient(features)
        Rt = np.swapaxes(T_base_tool[:, :3, :3], 1, 2)
        g_offset = g[:, :3] + g[:, 12:13] * offset / features[:, 12:13]
        turned = np.einsum("nij,njk->nik", Rt, np.stack([g_offset, g[:, 3:6], g[:, 6:9]], axis=2))
        g_local, gx, gy = turned[..., 0], turned[..., 1], turned[..., 2]
        d_pose = np.empty((len(value), 6))
        d_pose[:, :3] = g_local + g[:, 9:12]
        d_pose[:, 3:] = _cross(g[:, 9:12], features[:, 9:12])
        d_pose[:, 4] -= gx[:, 2]
        d_pose[:, 5] += gx[:, 1]
        d_pose[:, 3] += gy[:, 2]
        d_pose[:, 5] -= gy[:, 0]
        g_lift = g_offset[:, 2] + np.einsum("ni,ni->n", T_base_tool[:, 2, :3], g[:, 9:12])
        return value + self.margin, d_pose, g[:, 13] - g_lift


def _cross(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """np.cross spends most of its time on shapes."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )


def _features(
    T: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"], shoulder: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "n 14"], Float[np.ndarray, "n 3"]]:
    """(features, tool from the shoulder in the base frame).

    0:3 tool from the shoulder, base frame; 3:9 the tool's x and y axes; 9:12 the tool from the shoulder, tool frame;
    12 their distance; 13 torso. A spherical shoulder and wrist make reachability a simple function of 9:13.
    """
    features = np.empty((len(T), 14))
    offset = T[:, :3, 3] - shoulder
    offset[:, 2] -= torso
    features[:, :3] = offset
    features[:, 3:6], features[:, 6:9] = T[:, :3, 0], T[:, :3, 1]
    features[:, 9:12] = np.einsum("nji,nj->ni", T[:, :3, :3], offset)
    features[:, 12] = np.sqrt(np.einsum("ni,ni->n", offset, offset) + 1e-4)
    features[:, 13] = torso
    return features, offset


def train_field(robot: Robot, samples: int = SAMPLES, epochs: int = _EPOCHS, seed: int = 0) -> ReachabilityField:
    """Labels poses by exact IK and fits the network; the margin comes from poses kept apart."""
    T, torso = training_poses(robot, samples, seed)
    return fit(robot, label(robot, T, torso), epochs, seed)


def fit(robot: Robot, labels: Labels, epochs: int, seed: int, hidden: int = _HIDDEN) -> ReachabilityField:
    """The field of labelled poses, a tenth of which sets the margin."""
    apart = np.arange(len(labels.T)) % 10 == 0
    shoulder = shoulder_of(robot)
    targets = _targets(labels, np.flatnonzero(~apart), np.random.default_rng(seed))
    features, _ = _features(targets.T, targets.torso, shoulder)
    network = train(features, _loss(targets), hidden, epochs, seed=seed)
    field = ReachabilityField(shoulder, network, 0.0)
    value = field.distance(labels.T[apart], labels.torso[apart])[0]
    return ReachabilityField(shoulder, network, _margin(value, labels.reachable[apart]))


def _targets(labels: Labels, rows: np.ndarray, rng: np.random.Generator) -> Targets:
    """The labels, and what follows from them near the boundary.

    On the geodesic from a pose outside to the nearest reachable one the distance falls evenly (triangle inequality in
    the product of translations and rotations), and a little beyond its end the pose is inside.
    """
    T, torso, distance, reachable = (x[rows] for x in (labels.T, labels.torso, labels.distance, labels.reachable))
    outside = np.flatnonzero(np.isfinite(labels.nearest[rows, 0, 0]) & (distance > 1e-3))
    start, end, d = T[outside], labels.nearest[rows][outside], distance[outside]
    close = np.minimum(rng.exponential(0.02, len(d)), d)
    within = rng.uniform(0, 2 * _INSIDE, len(d))
    value = np.where(reachable, -_SHALLOW, distance)
    return Targets(
        np.concatenate([T, _between(start, end, 1 - close / d), _between(start, end, 1 + within / d)]),
        np.concatenate([torso, torso[outside], torso[outside]]),
        np.concatenate([value, close, -np.minimum(within, _INSIDE)]),
        np.concatenate([reachable, np.zeros(len(d), bool), np.ones(len(d), bool)]),
    )


def _between(
    a: Float[np.ndarray, "n 4 4"], b: Float[np.ndarray, "n 4 4"], share: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Poses on the geodesics from a to b (or beyond): positions straight, rotations about one axis."""
    T = a.copy()
    T[:, :3, 3] += share[:, None] * (b - a)[:, :3, 3]
    turn = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]).as_rotvec()
    T[:, :3, :3] = a[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    return T


def shoulder_of(robot: Robot) -> Float[np.ndarray, "3"]:
    """Origin of the first arm joint, base frame, torso at height 0."""
    return np.asarray(robot.fixed[0, :, :3] @ robot.fixed[1, :, 3] + robot.fixed[0, :, 3])


def _margin(value: Float[np.ndarray, " n"], reachable: Bool[np.ndarray, " n"], precision: float = 0.985) -> float:
    """The smallest margin with which of the poses that pass for reachable this share is."""
    order = np.argsort(value)
    share = np.cumsum(reachable[order]) / np.arange(1, len(order) + 1)
    good = np.flatnonzero(share >= precision)
    return float(max(-value[order[good[-1]]], 0.0)) if len(good) else _INSIDE


def training_poses(robot: Robot, n: int, seed: int) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"]]:
    """Poses of random configurations, disturbed more or less (the boundary), all around, and before the robot."""
    rng = np.random.default_rng(seed)
    q, torso = robot.sample(n, seed)
    T = robot.forward(q, torso)
    kind = rng.choice(3, n, p=[0.4, 1 - _TYPICAL_SHARE - 0.4, _TYPICAL_SHARE])
    spread = rng.uniform(0, 0.4, (n, 1))
    near = kind == 0
    T[near, :3, 3] += (spread * rng.normal(size=(n, 3)))[near]
    T[near, :3, :3] = (
        Rotation.from_matrix(T[near, :3, :3]) * Rotation.from_rotvec((spread * rng.normal(size=(n, 3)))[near] * 2)
    ).as_matrix()
    around = kind == 1
    T[around] = uniform_poses(robot, rng, int(around.sum()), 0.35)
    typical = kind == 2
    T[typical] = typical_poses(rng, int(typical.sum()))
    return T, torso


def uniform_poses(robot: Robot, rng: np.random.Generator, n: int, beyond: float) -> Float[np.ndarray, "n 4 4"]:
    """Positions uniform in a box that reaches so many metres beyond the sampled workspace, any orientation."""
    reach = robot.forward(*robot.sample(4096, 1))[:, :3, 3]
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = rng.uniform(reach.min(axis=0) - beyond, reach.max(axis=0) + beyond, (n, 3))
    T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    return T


def typical_poses(rng: np.random.Generator, n: int) -> Float[np.ndarray, "n 4 4"]:
    """A gripper that approaches within 40 degrees of level, at 0.3 to 1.5 m, before the robot, rolled any way."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = rng.uniform((0.2, -0.9, 0.3), (1.2, 0.9, 1.5), (n, 3))
    yaw, pitch, roll = rng.uniform(-1.6, 1.6, n), rng.uniform(-0.7, 0.7, n), rng.uniform(-np.pi, np.pi, n)
    T[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    return T


def label(robot: Robot, T: Float[np.ndarray, "n 4 4"], torso: Float[np.ndarray, " n"], seeds: int = 16) -> Labels:
    """Exact IK with collisions; how far the others are from the reachable set is what the best descent leaves."""
    problem = IKProblem(robot, T, torso, None)
    n = len(T)
    seed_table(robot), robot.self_collision  # made before the threads want them
    chunks = [np.arange(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(lambda rows: _label_chunk(problem, rows, seeds), chunks))
    reachable, distance, nearest = (np.concatenate(x) for x in zip(*parts, strict=True))
    colliding = (distance == 0) & ~reachable
    if colliding.any() and reachable.any():
        gap, _ = cKDTree(embed(T[reachable])).query(embed(T[colliding]))
        distance[colliding] = np.maximum(0.5 * gap, _COLLIDING)
    return Labels(T, torso, reachable, distance, nearest)


def _label_chunk(problem: IKProblem, rows: np.ndarray, seeds: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(reachable, distance, nearest) of some poses; distance 0 for those that are reached, but only with collisions."""
    robot = problem.robot
    found = problem.solve(rows, seeds, 5, relax=2)
    solved = np.isfinite(found.cost[:, 0])
    reachable = first_free(robot, found, True) >= 0
    again = np.flatnonzero(solved & ~reachable)
    if len(again):
        reachable[again] = first_free(robot, problem.solve(rows[again], 4 * seeds, 20, relax=0), True) >= 0
    distance = np.where(solved, 0.0, np.hypot(found.left[:, 0], LENGTH * found.left[:, 1]))
    nearest = np.full((len(rows), 4, 4), np.nan)
    useful = np.flatnonzero(~solved & (distance < _NEAR))
    away = found.nearest[useful]
    free = ~robot.collides(away[:, 1:], away[:, 0])
    nearest[useful[free]] = robot.forward(away[free, 1:], away[free, 0])
    return reachable, distance, nearest


def _loss(targets: Targets) -> Any:
    """Squared errors, which count less far out, and more where the network is optimistic."""
    value_wanted, bound = targets.value.astype(np.float32), targets.bound
    weight = (1 / (0.1 + np.maximum(targets.value, 0)) ** 2).astype(np.float32)

    def loss(value: np.ndarray, batch: Any) -> tuple[float, np.ndarray]:
        error = value - value_wanted[batch]
        error[bound[batch]] = np.maximum(error[bound[batch]], 0)
        w = weight[batch] * np.where((value < 0) & ~bound[batch], np.float32(2), np.float32(1))
        return float((w * error**2).mean()), 2 * w * error / len(error)

    return loss


def load_field(robot: Robot, samples: int = SAMPLES, cache: bool = True) -> ReachabilityField:
    """The robot's field: shipped, from the cache folder, or trained now (about a minute) and kept.

    samples: labelled poses to train on. cache=False trains anew and keeps nothing.
    """
    settings = f"format {FORMAT}, {samples} samples"
    arrays = store.load(robot, "field", settings) if cache else None
    if arrays is None:
        field = train_field(robot, samples)
        if cache:
            store.save(robot, "field", settings, to_arrays(field))
        return field
    weights = tuple(arrays[name] for name in _WEIGHTS)
    return ReachabilityField(
        arrays["shoulder"], Regressor(arrays["shift"], arrays["scale"], weights), float(arrays["margin"])
    )


_WEIGHTS: Final = ("W1", "b1", "W2", "b2", "w3", "b3")


def to_arrays(field: ReachabilityField) -> dict[str, Any]:
    """What is kept of a field."""
    n = field.network
    kept = {"shoulder": field.shoulder, "shift": n.shift, "scale": n.scale, "margin": np.array(field.margin)}
    return kept | dict(zip(_WEIGHTS, n.weights, strict=True))
