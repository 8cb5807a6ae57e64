"""Where up is and where the floor is: the world that stands upright although the camera may look down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from understudy.geometry import along, plane_normal, rigid
from understudy.types import Person

CAMERA_UP = np.array([0.0, -1.0, 0.0])
MAX_TILT = np.deg2rad(50)
"""between the camera's and the floor's up, radians"""
THICKNESS_M = 0.025
MIN_SHARE = 0.06
"""of the points, on the floor"""
MAX_BELOW = 0.03
"""share of the points, under the floor: else it is a table"""

_SAMPLES, _TRIES = 4000, 600
_FEW, _BEST = 600, 40  # points that judge all planes; planes that all points judge
_LOW = 0.35  # share of the points that are lowest in the camera's frame


@dataclass(frozen=True, eq=False)
class Floor:
    """The plane {p : up @ p = height} in the colour camera's frame."""

    up: Float[np.ndarray, "3"]
    """unit vector"""
    height: float
    """metres; negative when the floor is under the camera"""
    seen: bool = True
    """False: nothing that was measured looked like a floor, and it was put below the people"""

    def below(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """The floor's point under (or over) a point."""
        return point + self.up * (self.height - self.up @ point)

    def wxyz(self) -> Float[np.ndarray, "4"]:
        """The smallest rotation that takes the camera's up to the floor's, as a quaternion."""
        q = np.concatenate([[1 + CAMERA_UP @ self.up], np.cross(CAMERA_UP, self.up)])
        return q / np.linalg.norm(q)


def find_floor(points: Float32[np.ndarray, "n 3"] | None, people: Sequence[Person]) -> Floor:
    """The floor among measured points; without one, level with the camera and under the people's lowest joints."""
    return (None if points is None else measured_floor(points)) or _under(people)


def _under(people: Sequence[Person]) -> Floor:
    joints = np.concatenate([p.keypoints for p in people]) if people else np.zeros((0, 3))
    lowest = joints[np.isfinite(joints).all(axis=1), 1]
    return Floor(CAMERA_UP, -(float(lowest.max()) + 0.08) if len(lowest) else -1.5, seen=False)


def measured_floor(points: Float32[np.ndarray, "n 3"]) -> Floor | None:
    """The plane through most points that nearly all others are above (random triples, then least squares).

    points: colour camera's frame, metres. None where nothing measured looks like a floor.
    """
    if len(points) < 200:
        return None
    random = np.random.default_rng(0)
    points = points[random.permutation(len(points))[:_SAMPLES]].astype(np.float64)
    some = random.integers(len(points), size=(3, _TRIES))
    low = np.argsort(-points[:, 1])[: int(_LOW * len(points))]  # where little of the floor is to be seen, it is there
    some[:, ::2] = low[random.integers(len(low), size=some[:, ::2].shape)]
    a, b, c = points[some]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    upright = np.abs(normals @ CAMERA_UP) > np.cos(MAX_TILT) * np.maximum(length, 1e-9)
    normals = normals[upright] / length[upright, None]
    normals *= np.sign(normals @ CAMERA_UP)[:, None]
    heights = np.sum(a[upright] * normals, axis=1)
    few = np.argsort(-_floor_share(points[:_FEW], normals, heights))[:_BEST]  # all points judge only the best planes
    normals, heights = normals[few], heights[few]
    on = _floor_share(points, normals, heights)
    if not len(on) or on.max() < MIN_SHARE:
        return None
    k = np.argmax(on)
    best = points[np.abs(along(points, normals[k : k + 1])[:, 0] - heights[k]) < THICKNESS_M]
    up = plane_normal(best)
    up *= np.sign(up @ CAMERA_UP) or 1.0
    return Floor(up, float(up @ best.mean(axis=0)))


def _floor_share(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "k 3"], heights: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Share of the points on each plane; 0 for planes that too many are under."""
    over = along(points, normals) - heights  # metres
    on = (np.abs(over) < THICKNESS_M).mean(axis=0)
    below = (over < -4 * THICKNESS_M).mean(axis=0)
    share: np.ndarray = np.where(below > MAX_BELOW, 0.0, on)
    return share


def world_from_camera(floor: Floor) -> Float[np.ndarray, "4 4"]:
    """T_world_cam of the world that CONVENTIONS.md describes: z up, the floor at z = 0, the origin below the camera,
    x the way that the camera looks (one that looks straight down: the way of its image's upper edge).
    """
    z = floor.up
    forward = np.array([0.0, 0.0, 1.0]) - z * z[2]
    if np.linalg.norm(forward) < 1e-3:
        forward = CAMERA_UP - z * (CAMERA_UP @ z)
    x = forward / np.linalg.norm(forward)
    R = np.stack([x, np.cross(z, x), z])
    return rigid(R, np.array([0.0, 0.0, -floor.height]))
