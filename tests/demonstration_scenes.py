"""Demonstrations and depth images made by formula, for the tests of what is built from them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from understudy.camera import Camera
from understudy.demonstration.demonstration import Demonstration, OccupancyMap, Segments
from understudy.geometry import inverse, rigid
from understudy.objects.articulation import REVOLUTE, Articulation, Handle
from understudy.trajectories import PlanarTrack, PoseTrack
from understudy.types import RegisteredDepth
from understudy.voxels import pixel_rays


def minimum_jerk(s: np.ndarray) -> np.ndarray:
    """0 to 1 while s goes from 0 to 1, at rest before and after."""
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def door_demonstration(
    seed: int = 0, t: int = 90, T_move: np.ndarray | None = None, stretch: float = 1.0
) -> Demonstration:
    """A hand reaches for a door's handle, opens the door and leaves. `T_move` moves all of it."""
    rng = np.random.default_rng(seed)
    T_move = np.eye(4) if T_move is None else T_move
    times = np.arange(t) * 0.1 * stretch
    phase = times / stretch
    T_rest = rigid(np.diag([-1.0, -1, 1]), np.array([0.0, 0.0, 1.0]))
    hinge = Articulation(REVOLUTE, T_rest, np.array([0, 0, -1.0]), np.array([0.04, 0.5, 1.0]), (0.0, 1.2))
    q = 1.2 * minimum_jerk((phase - 3) / 3)
    T_object = hinge.pose(q)
    grip = rigid(Rotation.from_euler("y", -100, degrees=True).as_matrix(), np.array([0.01, 0.0, 0.02]))
    away = 0.5 * (1 - minimum_jerk(phase / 2.8)) + 0.6 * minimum_jerk((phase - 6.2) / 2)
    T_hand = T_object @ grip
    T_hand[:, :3, 3] += away[:, None] * np.array([-1.0, 0.2, -0.3])
    hand = PoseTrack(T_move @ T_hand, np.tile(np.eye(6) * 1e-4, (t, 1, 1)), np.ones(t, bool), np.ones(t, bool))
    part = PoseTrack(T_move @ T_object, np.tile(np.eye(6) * 1e-6, (t, 1, 1)), np.ones(t, bool), np.ones(t, bool))
    yaw = Rotation.from_matrix(T_move[:3, :3]).as_rotvec()[2]
    torso = np.column_stack([-0.7 + 0.2 * q, 0.1 * np.sin(phase), np.zeros(t), np.ones(t)])
    xy_yaw = np.column_stack([(torso @ T_move.T)[:, :2], 0.1 * phase + yaw])
    cells = rng.integers(0, 3, (40, 50)).astype(np.uint8)
    return Demonstration(
        task="swivel_door",
        times_s=times,
        acting="right",
        hand=hand,
        torso=PlanarTrack(xy_yaw, np.tile(np.eye(3) * 1e-3, (t, 1, 1)), np.ones(t, bool)),
        object=part,
        articulation=hinge.moved(T_move),
        handle=Handle(0.12, 0.008, 0.04),
        segments=Segments(30, 60),
        map=OccupancyMap(cells, np.array([-1.0, -1.2]), 0.05),
        scene=rng.normal(size=(200, 3)).astype(np.float32),
        T_world_cam=T_move @ rigid(np.eye(3), np.array([-2.0, 0.3, 1.5])),
        joints=rng.normal(size=(t, 18, 3)),
        part=rng.normal(size=(50, 3)).astype(np.float32),
        source={"recording": "made by formula"},
    )


LOOKING_DOWN = rigid(
    Rotation.from_euler("x", -100, degrees=True).as_matrix().T @ np.diag([1.0, 1.0, 1.0]), np.array([0.0, 0.0, 1.6])
)


def camera() -> Camera:
    return Camera(160, 120, np.array([[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]]))


def cast(T_world_cam: np.ndarray, boxes: list[tuple[np.ndarray, np.ndarray]]) -> RegisteredDepth:
    """Depth of the floor (z = 0) and of boxes (least and greatest corner, world), exact."""
    own = camera()
    rays = pixel_rays(own).reshape(2, -1).T.astype(np.float64)
    direction = np.column_stack([rays, np.ones(len(rays))]) @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(direction[:, 2] < -1e-9, -origin[2] / direction[:, 2], np.inf)
        for low, high in boxes:
            a, b = (low - origin) / direction, (high - origin) / direction
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            z = np.where((near < far) & (near > 0), np.minimum(z, near), z)
    z = np.where(z < 8, z, 0).astype(np.float32)
    return RegisteredDepth(z.reshape(own.height, own.width), own)


def to_cam(T_world_cam: np.ndarray, points: np.ndarray) -> np.ndarray:
    T = inverse(T_world_cam)
    return points @ T[:3, :3].T + T[:3, 3]
