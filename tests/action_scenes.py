"""Made-up demonstrations of the four tasks with a known spread, as they would come out of the adaptation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from understudy import lie
from understudy.actions.features import Carrier, Relative, floor_frame
from understudy.actions.motions import RobotMotion
from understudy.demonstration.demonstration import Segments
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation, Handle

UPRIGHT = np.eye(3)
LEVEL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y up, z = x x y
HANDLE = Handle(0.12, 0.008, 0.04)
STAY = np.eye(4)
STEPS = (5, 8, 5)  # out of 18: shares of reach, manipulation and release


@dataclass(frozen=True)
class Scene:
    """One piece of furniture: its front faces the world's +x, the handle is over the origin."""

    kind: str
    R: np.ndarray = field(repr=False)
    """of the handle"""
    height: float
    travel: float
    direction: tuple[float, float, float]
    radius: float = 0.0
    hinge: float = 1.0
    """+1: on the right"""
    follow: float = 0.0
    """share of the handle's way over the floor that the base goes along"""

    def articulation(self) -> Articulation:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, (0, 0, self.height)
        direction = np.array(self.direction, np.float64)
        point = np.array([-0.04, self.hinge * self.radius, self.height]) if self.kind == REVOLUTE else T[:3, 3]
        direction = direction * (self.hinge if self.kind == REVOLUTE else 1)
        return Articulation(self.kind, T, direction, point, (0.0, self.travel))


TASKS = {
    "room_door": Scene(REVOLUTE, LEVEL, 1.02, 1.1, (0, 0, 1), 0.8, follow=0.8),
    "swivel_door": Scene(REVOLUTE, UPRIGHT, 1.1, 1.2, (0, 0, 1), 0.4, follow=0.3),
    "drawer": Scene(PRISMATIC, LEVEL, 0.7, 0.3, (1, 0, 0), follow=0.6),
    "sliding_door": Scene(PRISMATIC, UPRIGHT, 1.0, 0.55, (0, 1, 0), follow=0.9),
    "fixed": Scene(FIXED, UPRIGHT, 1.0, 0.0, (1, 0, 0)),
}


def min_jerk(u: np.ndarray) -> np.ndarray:
    return u**3 * (10 - 15 * u + 6 * u**2)


@dataclass(frozen=True)
class Spread:
    """Standard deviations between demonstrations, constant over each: metres, radians."""

    far: float = 0.03
    """gripper, away from the object"""
    turn: float = 0.1
    grasp: float = 0.002
    grasp_turn: float = 0.01
    base: float = 0.05
    yaw: float = 0.05
    torso: float = 0.02
    travel: float = 0.05
    """relative"""
    duration: float = 0.12
    """relative"""


NO_SPREAD = Spread(*[0.0] * 9)


def demonstrate(
    scene: Scene, rng: np.random.Generator, n: int = 150, spread: Spread = Spread(), T_move: np.ndarray = STAY
) -> RobotMotion:
    """One demonstration of about n samples at 15 Hz; the scene is moved over the floor by T_move."""
    lengths = [max(8, round(n * share / sum(STEPS) * np.exp(rng.normal(0, spread.duration)))) for share in STEPS]
    segments = Segments(lengths[0], lengths[0] + lengths[1])
    articulation = scene.articulation()
    phases = [np.arange(k) / k for k in lengths]
    phases[2] = np.arange(lengths[2]) / (lengths[2] - 1)
    travel = scene.travel * (1 + rng.normal(0, spread.travel))
    q = travel * np.concatenate([0 * phases[0], min_jerk(phases[1]), 1 + 0 * phases[2]])
    T = articulation.pose(q)
    carrier = Carrier(T, np.column_stack([T[:, :2, 3], 0 * q]))  # the front faces the world's x
    away = np.concatenate([1 - min_jerk(phases[0]), 0 * phases[1], min_jerk(phases[2])])
    relative = Relative(_gripper(scene, rng, phases, away, spread), *_base(scene, rng, carrier, away, spread))
    T_world_tool, xy_yaw, torso = relative.world(carrier)
    xy_yaw = lie.se2_compose(floor_frame(T_move[None]), xy_yaw)
    times = np.arange(len(q)) / 15.0
    torso = torso + T_move[2, 3]
    return RobotMotion(
        times, T_move @ T_world_tool, xy_yaw, torso, T_move @ T, articulation.moved(T_move), HANDLE, segments
    )


def _gripper(scene: Scene, rng: np.random.Generator, phases: list, away: np.ndarray, spread: Spread) -> np.ndarray:
    """Relative to the carrier: from a side, onto the handle, held, and back off."""
    T = np.tile(np.eye(4), (len(away), 1, 1))
    reach = len(phases[0])
    side = scene.R.T @ np.array([0.45, -0.25, -0.2])
    back = scene.R.T @ np.array([0.25, 0.05, 0.0])
    late = np.arange(len(away)) >= reach
    sigma = spread.grasp + (spread.far - spread.grasp) * away
    T[:, :3, 3] = away[:, None] * np.where(late[:, None], back, side) + sigma[:, None] * rng.normal(size=3)
    # tool: x into the front, y (the way the fingers close) across the bar
    R_grasp = np.column_stack([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    turn = away[:, None] * np.where(late[:, None], (0.0, 0.0, 0.1), (0.5, 0.4, -0.6))
    sigma = spread.grasp_turn + (spread.turn - spread.grasp_turn) * away
    R = R_grasp @ Rotation.from_rotvec(turn).as_matrix()
    T[:, :3, :3] = R @ Rotation.from_rotvec(sigma[:, None] * rng.normal(size=3)).as_matrix()
    return T


def _base(
    scene: Scene, rng: np.random.Generator, carrier: Carrier, away: np.ndarray, spread: Spread
) -> tuple[np.ndarray, np.ndarray]:
    """In the carrier's floor frame: comes near, goes along with a share of the handle's way, backs off."""
    ways = carrier.floor[:, :2] - carrier.floor[0, :2]
    xy = np.array([0.75, -0.15]) + scene.follow * ways + away[:, None] * np.array([0.5, -0.1])
    yaw = np.pi - 0.1 + 0.15 * away
    world = np.column_stack([xy, yaw])
    base = lie.se2_compose(lie.se2_inverse(carrier.floor), world)
    base += rng.normal(size=3) * (spread.base, spread.base, spread.yaw)
    torso = 0.15 + 0.05 * away - scene.height + spread.torso * rng.normal()
    return base, np.asarray(torso)
