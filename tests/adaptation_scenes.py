"""Synthetic demonstrations of the four tasks, and a robot whose kinematics are a formula. For tests and benchmarks.

Furniture's front is the plane x = 0; a person comes from the +x side, takes hold, opens, lets go, at 10 Hz. What is
'seen' is the truth plus correlated noise, and, on request, gaps and gross outliers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from understudy import lie
from understudy.adaptation.calibration import DEFAULT_HAND_TOOL
from understudy.adaptation.grasps import GraspFamily
from understudy.adaptation.platform import Platform
from understudy.demonstration.demonstration import FREE, OCCUPIED, UNKNOWN, Demonstration, OccupancyMap, Segments
from understudy.demonstration.tasks import TASKS
from understudy.objects.articulation import Articulation, Handle
from understudy.trajectories import PlanarTrack, PoseTrack

__all__ = ["TASKS", "Noise", "Shell", "demonstration", "demonstrations", "platform"]

LEVEL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # handle axes of a level bar on a front that faces +x
UPRIGHT = np.eye(3)


@dataclass(frozen=True)
class Noise:
    """How well the person is seen."""

    hand: tuple[float, float] = (0.015, np.radians(6))
    torso: tuple[float, float] = (0.03, np.radians(5))
    object: tuple[float, float] = (0.0, 0.0)
    missing: float = 0.0
    outliers: float = 0.0
    torso_gap_s: float = 0.0


MARKERS = Noise(hand=(0.003, np.radians(1)), torso=(0.01, np.radians(1)))
CORRUPTED = Noise(missing=0.3, outliers=0.05, torso_gap_s=2.0)


def _pose(R: np.ndarray, p: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def furniture(task: str) -> tuple[Articulation, Handle]:
    """The part that moves, and its handle."""
    up, out = np.array([0, 0, 1.0]), np.array([1.0, 0, 0])
    if task == "drawer":
        T = _pose(LEVEL, (0.04, 0.0, 0.75))
        return Articulation("prismatic", T, out, T[:3, 3], (0.0, 0.3)), Handle(0.14, 0.007, 0.04)
    if task == "sliding_door":
        T = _pose(UPRIGHT, (0.04, 0.2, 1.0))
        return Articulation("prismatic", T, np.array([0, -1.0, 0]), T[:3, 3], (0.0, 0.45)), Handle(0.2, 0.008, 0.04)
    if task == "swivel_door":
        T = _pose(UPRIGHT, (0.04, 0.0, 1.0))
        return Articulation("revolute", T, up, np.array([0, 0.4, 1.0]), (0.0, 1.2)), Handle(0.14, 0.007, 0.04)
    T = _pose(UPRIGHT, (0.05, 0.0, 1.0))
    return Articulation("revolute", T, up, np.array([0, 0.75, 1.0]), (0.0, 1.1)), Handle(0.16, 0.01, 0.05)


def room(task: str) -> tuple[OccupancyMap, np.ndarray]:
    """A map (5 cm) and points of the scene."""
    x, y = np.arange(-1.0, 3.5, 0.05), np.arange(-2.4, 2.4, 0.05)
    X, Y = np.meshgrid(x, y)
    state = np.where(X > 0, FREE, UNKNOWN).astype(np.uint8)
    half = {"drawer": 0.5, "swivel_door": 0.45, "sliding_door": 0.9, "room_door": 5.0}[task]
    front = (X <= 0) & (X > -0.15) & (np.abs(Y) < half)
    if task == "room_door":
        front &= ~((Y > -0.1) & (Y < 0.78))  # the door itself moves
    table = (np.abs(X - 1.0) < 0.3) & (np.abs(Y - 1.3) < 0.4)
    chair = np.hypot(X - 1.1, Y + 1.45) < 0.25
    wall = (Y > 2.2) | (Y < -2.2)
    state[front | table | chair | wall] = OCCUPIED
    z = np.arange(0.1, {"drawer": 0.9, "room_door": 2.0}.get(task, 1.4), 0.06)
    blocked = np.argwhere(front & (X > -0.06))
    points = np.column_stack([np.repeat(x[blocked[:, 1]], len(z)), np.repeat(y[blocked[:, 0]], len(z))])
    scene = np.column_stack([points, np.tile(z, len(blocked))])
    keep = scene[:, 2] < 5 if task == "room_door" else np.hypot(scene[:, 1], 0) > 0.25
    return OccupancyMap(state, np.array([x[0], y[0]]), 0.05), scene[keep].astype(np.float32)


def _smooth_step(s: np.ndarray) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _noise(rng: np.random.Generator, n: int, k: int, sigma: float) -> np.ndarray:
    """Correlated over about 0.2 s, as filtered tracks are."""
    x = gaussian_filter1d(rng.normal(size=(n + 20, k)), 2, axis=0)[10:-10]
    return sigma * x / 0.376  # the filter's own gain


def demonstration(task: str, seed: int = 0, noise: Noise | None = None, samples: int = 110) -> Demonstration:
    """One demonstration; the person starts, stands and moves a little differently with each seed."""
    noise, rng = noise or Noise(), np.random.default_rng([seed, TASKS.index(task)])
    articulation, handle = furniture(task)
    dt = 0.1
    times = dt * np.arange(samples)
    grasp, release = int(0.35 * samples), int(0.85 * samples)
    q = articulation.range[1] * _smooth_step((np.arange(samples) - grasp - 2) / (release - grasp - 5))
    T_object = articulation.pose(q)
    T_hand = _hand(rng, T_object, q / articulation.range[1], grasp, release)
    P = _torso(rng, task, T_hand[:, :2, 3], q / articulation.range[1], grasp)
    map, scene = room(task)
    hand, torso = _seen(rng, T_hand, P, noise, dt)
    object = PoseTrack(
        T_object @ lie.se3_exp(np.repeat(noise.object, 3) * _noise(rng, samples, 6, 1.0)),
        np.tile(np.diag([1e-6] * 6), (samples, 1, 1)),
        np.ones(samples, bool),
        np.ones(samples, bool),
    )
    joints = np.full((samples, 18, 3), np.nan)
    camera = _pose(np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]), (3.2, -0.8, 1.6))
    source = {"truth": "tests/adaptation_scenes.py"}
    return Demonstration(
        task, times, "right", hand, torso, object, articulation, handle, Segments(grasp, release), map, scene, camera,
    joints, source=source,
    )  # fmt: skip


def doorway(width_m: float, seed: int = 0, samples: int = 70) -> Demonstration:
    """Someone pushes a gate that hangs on rails through a doorway in the wall x = -0.15 to 0, and walks after it.

    The person is narrower than a robot's base: goes through 0.25 m beside the middle, turned by 35 degrees. The map has
    cells of 5 cm; widths are odd multiples of that.
    """
    rng = np.random.default_rng([seed, 99])
    T = _pose(UPRIGHT, (0.7, 0.0, 1.0))
    articulation, handle = (
        Articulation("prismatic", T, np.array([-1.0, 0, 0]), T[:3, 3], (0.0, 2.2)),
        Handle(0.2, 0.01, 0.05),
    )
    times = 0.2 * np.arange(samples)
    grasp, release = int(0.25 * samples), int(0.9 * samples)
    q = 2.2 * _smooth_step((np.arange(samples) - grasp - 1) / (release - grasp - 2))
    T_object = articulation.pose(q)
    T_hand = _hand(rng, T_object, q / 2.2, grasp, release)
    walk = _smooth_step(np.arange(samples) / (0.8 * grasp))
    x = 1.2 + 0.4 * (1 - walk) - q
    aside = np.exp(-((x / 0.5) ** 2))
    P = np.column_stack([x, 0.25 * aside, np.pi + np.radians(35) * aside])
    x, y = 0.05 * np.arange(-50, 50), 0.05 * np.arange(-40, 41)
    X, Y = np.meshgrid(x, y)
    wall = (X < 0.01) & (X > -0.16) & (np.abs(Y) > width_m / 2)
    state = np.where(wall | (np.abs(Y) > 1.9), OCCUPIED, FREE).astype(np.uint8)
    hand, torso = _seen(rng, T_hand, P, Noise(), 0.2)
    known = np.ones(samples, bool)
    object = PoseTrack(T_object, np.tile(1e-6 * np.eye(6), (samples, 1, 1)), known, known)
    return Demonstration(
        "gate", times, "right", hand, torso, object, articulation, handle, Segments(grasp, release),
        OccupancyMap(state, np.array([x[0], y[0]]), 0.05), np.zeros((0, 3), np.float32),
        _pose(np.array([[0, 0, -1.0], [1, 0, 0], [0, -1, 0]]), (3.2, -0.8, 1.6)), np.full((samples, 18, 3), np.nan),
        source={"truth": "tests/adaptation_scenes.py"},
    )  # fmt: skip


def demonstrations(task: str, n: int = 5, noise: Noise | None = None, samples: int = 110) -> list[Demonstration]:
    """Several of one task, which share a map."""
    shown = [demonstration(task, seed, noise, samples) for seed in range(n)]
    return [replace(d, map=shown[0].map) for d in shown]


def _hand(rng: np.random.Generator, T_object: np.ndarray, part: np.ndarray, grasp: int, release: int) -> np.ndarray:
    """Reaches, holds (turning a little in the hand while the part moves), lets go."""
    n = len(T_object)
    grip = GraspFamily(0.0, np.pi, 1.0).members(np.array([np.radians(12) + 0.1 * rng.normal()]), np.array([0.0]))[0]
    slip = lie.se3_exp(np.outer(part, np.append(0.01 * rng.normal(size=3), [0, 0, 0.25])))
    T = T_object @ grip @ slip @ lie.se3_inverse(DEFAULT_HAND_TOOL)
    first = T[grasp] @ lie.se3_exp(np.append(np.zeros(3), rng.normal(0, 0.25, 3)))
    first[:3, 3] = T[grasp, :3, 3] + [0.65, -0.25, -0.2] + 0.06 * rng.normal(size=3)
    last = T[release].copy()
    last[:3, 3] += [0.25, -0.05, -0.05]
    early, late = np.arange(grasp), np.arange(release, n)
    s = _smooth_step(early / (grasp - 2))[:, None]
    T[early] = _between(first, T[grasp], s)
    T[late] = _between(T[release - 1], last, _smooth_step((late - release + 1) / (n - release))[:, None])
    return T


def _between(a: np.ndarray, b: np.ndarray, s: np.ndarray) -> np.ndarray:
    T = np.tile(a, (len(s), 1, 1))
    T[:, :3, :3] = a[:3, :3] @ lie.so3_exp(s * lie.so3_log(a[:3, :3].T @ b[:3, :3]))
    T[:, :3, 3] = a[:3, 3] + s * (b[:3, 3] - a[:3, 3])
    return T


def _torso(rng: np.random.Generator, task: str, hand: np.ndarray, part: np.ndarray, grasp: int) -> np.ndarray:
    """Walks up, stands half a metre before the handle a little to the left, gives way as the part comes."""
    n = len(hand)
    place = hand[grasp] + [0.5, 0.15] + 0.04 * rng.normal(size=2)
    give = {"drawer": [0.25, 0.1], "swivel_door": [0.2, -0.15], "sliding_door": [0.0, -0.3], "room_door": [0.6, -0.35]}
    walk = _smooth_step(np.arange(n) / (0.8 * grasp))[:, None]
    xy = place + (1 - walk) * [0.45, -0.1] + part[:, None] * give[task]
    yaw = np.pi + 0.1 * rng.normal() + 0.2 * part
    return np.column_stack([xy, yaw])


def _seen(
    rng: np.random.Generator, T_hand: np.ndarray, P: np.ndarray, noise: Noise, dt: float
) -> tuple[PoseTrack, PlanarTrack]:
    n = len(P)
    p, r = noise.hand
    T = T_hand @ lie.se3_exp(np.column_stack([_noise(rng, n, 3, p), _noise(rng, n, 3, r)]))
    wild = rng.random(n) < noise.outliers
    away = rng.normal(size=(n, 3))
    T[wild, :3, 3] += 0.5 * away[wild] / np.linalg.norm(away[wild], axis=1, keepdims=True)
    observed = rng.random(n) >= noise.missing
    T[~observed] = np.nan
    covariance = np.tile(np.diag(np.repeat([p**2, r**2], 3)), (n, 1, 1))
    hand = PoseTrack(T, covariance, observed, observed.copy())
    p, r = noise.torso
    seen = P + np.column_stack([_noise(rng, n, 2, p), _noise(rng, n, 1, r)])
    known = np.ones(n, bool)
    if noise.torso_gap_s:
        start = int(0.4 * n)
        known[start : start + round(noise.torso_gap_s / dt)] = False
        seen[~known] = np.nan
    return hand, PlanarTrack(seen, np.tile(np.diag([p**2, p**2, r**2]), (n, 1, 1)), known)


@dataclass(frozen=True)
class Shell:
    """Reach of a ball joint at the shoulder: the wrist within a shell, the gripper pointing away from the shoulder."""

    shoulder: tuple[float, float, float] = (0.0, -0.19, 0.75)
    wrist: float = 0.18
    least: float = 0.32
    greatest: float = 0.72
    cosine: float = 0.1
    weight: float = 0.4
    smooth: float = 0.02
    """metres: within this the three conditions blend"""

    def value(self, T_base_tool: np.ndarray, torso: np.ndarray) -> np.ndarray:
        """As `platform.Reachability`."""
        return self.distance(T_base_tool, torso)[0]

    def distance(self, T_base_tool: np.ndarray, torso: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `platform.Reachability`."""
        n = len(T_base_tool)
        R, x = T_base_tool[:, :3, :3], T_base_tool[:, :3, 0]
        away = T_base_tool[:, :3, 3] - self.wrist * x - self.shoulder
        away[:, 2] -= torso
        length = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        u = away / length[:, None]
        c = np.sum(u * x, axis=1)
        values = np.stack([length - self.greatest, self.least - length, self.weight * (self.cosine - c)])
        # a smooth maximum, at most 2 cm above the true one
        top = values.max(axis=0)
        share = np.exp((values - top) / self.smooth)
        value = top + self.smooth * np.log(share.sum(axis=0))
        share = (share / share.sum(axis=0))[..., None]
        side = (x - c[:, None] * u) / length[:, None]
        over_wrist = share[0] * u - share[1] * u - share[2] * self.weight * side
        local = np.einsum("ni,nij->nj", over_wrist, R)
        d = np.zeros((n, 6))
        d[:, :3] = local
        d[:, 3:] = np.cross(np.array([-self.wrist, 0, 0]), local)
        pointing = -self.weight * np.einsum("ni,nij->nj", u, R)
        d[:, 3:] += share[2] * np.cross(np.array([1.0, 0, 0]), pointing)
        return value, d, -over_wrist[:, 2]


def platform(exact_is_smaller_by: float = 0.0, opening_m: float = 0.09) -> Platform:
    """A robot of the PR2's size. Its exact reach is smaller than what the optimiser sees, on request."""
    shell = Shell()
    truth = replace(shell, least=shell.least + exact_is_smaller_by, greatest=shell.greatest - exact_is_smaller_by)
    return Platform(
        name="shell",
        footprint=np.array([[0.33, -0.33], [0.33, 0.33], [-0.33, 0.33], [-0.33, -0.33]]),
        torso_limits=(0.0, 0.3),
        base_velocity=np.array([1.0, 1.0, 2.0]),
        base_acceleration=np.array([1.0, 1.0, 2.0]),
        torso_velocity=0.013,
        opening_m=opening_m,
        reachability=shell,
        achievable=lambda T, torso: truth.distance(T, torso)[0] <= 0,
    )
