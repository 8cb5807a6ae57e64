"""Points on the surface of the arm's links, and whether they are clear of what a distance field knows."""

from __future__ import annotations

from typing import Any, Final
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull

from understudy.robot.chain import compiled, frames
from understudy.robot.model import Robot, require_pinocchio

_SPACING_M: Final = 0.03
_FIRST: Final = 3
"""joint of the arm from which on links count: what hangs on the shoulder cannot be elsewhere (1 is the first)"""


class ArmSurface:
    """Of each link between the shoulder and the gripper: points on the convex hull of its collision shapes.

    From a robot's third arm joint to the last but one: the hand is no part of it (it has to go near to things).
    """

    points: Float[np.ndarray, "n 3"]
    """in the frame of their joint (`chain`), metres"""
    joint: Int[np.ndarray, " n"]
    """number of the joint: 0 is the torso's"""

    def __init__(self, robot: Robot):
        collision, d, pin = robot.self_collision, robot.description, require_pinocchio()
        model, data = collision.model, collision.model.createData()
        torso = robot.torso_limits[0]
        x = robot.stack(d.posture[None], np.array([torso]))[0]
        work, tmp = np.empty((len(x) + 1, 3, 4)), np.empty((3, 4))
        frames(robot.fixed, x, work, tmp)
        pin.forwardKinematics(model, data, collision.configurations(d.posture[None], np.array([torso]))[0])
        points, joints = [np.zeros((0, 3))], [np.zeros(0, int)]
        for number, name in enumerate(d.arm_joints[_FIRST - 1 : -1], start=_FIRST):
            link = model.getJointId(name)
            shapes = [o for o in collision.geometry.geometryObjects if o.parentJoint == link]
            for shape in shapes:
                T_base_shape = (data.oMi[link] * shape.placement).homogeneous
                on_base = _surface(shape.geometry) @ T_base_shape[:3, :3].T + T_base_shape[:3, 3]
                points.append((on_base - work[number, :, 3]) @ work[number, :, :3])
                joints.append(np.full(len(on_base), number))
        self.points, self.joint = np.ascontiguousarray(np.concatenate(points)), np.concatenate(joints)
        self._fixed = robot.fixed

    def at(self, x: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "m n 3"]:
        """Where the points are in the base's frame; x: torso and arm (`Robot.stack`)."""
        return np.asarray(_placed(self._fixed, np.ascontiguousarray(x), self.points, self.joint))

    def clear(
        self,
        x: Float[np.ndarray, "m k"],
        T_field_base: Float[np.ndarray, "m 4 4"],
        values: Float[np.ndarray, "a b c"],
        origin: Float[np.ndarray, "3"],
        cell_m: float,
        least_m: float,
    ) -> Bool[np.ndarray, " m"]:
        """Whether all points are at least so far from what a field of distances knows (`adaptation.fields`).

        Points beyond the field count as clear.
        """
        T = np.ascontiguousarray(T_field_base[:, :3])
        return np.asarray(
            _clear(self._fixed, np.ascontiguousarray(x), self.points, self.joint, T, values, origin, cell_m, least_m)
        )


_surfaces: WeakKeyDictionary[Robot, ArmSurface] = WeakKeyDictionary()


def arm_surface(robot: Robot) -> ArmSurface:
    """The robot's, made when first asked for."""
    if robot not in _surfaces:
        _surfaces[robot] = ArmSurface(robot)
    return _surfaces[robot]


def _surface(geometry: Any) -> Float[np.ndarray, "n 3"]:
    """Points on the convex hull of a shape, `_SPACING_M` apart; of one without vertices, on its bounding box."""
    corners = _vertices(geometry)
    faces = corners[ConvexHull(corners).simplices]
    sides = np.linalg.norm(faces - np.roll(faces, 1, axis=1), axis=2).max(axis=1)
    found = [corners]
    for face, side in zip(faces, sides, strict=True):
        n = int(np.ceil(side / _SPACING_M))
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        u, v = i[i + j <= n] / n, j[i + j <= n] / n
        found.append(np.stack([1 - u - v, u, v], axis=1) @ face)
    points = np.concatenate(found)
    # one point per cell: the one farthest out
    far = np.linalg.norm(points - points.mean(axis=0), axis=1)
    points = points[np.argsort(-far, kind="stable")]
    _, first = np.unique(np.floor(points / _SPACING_M).astype(int), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)])


def _vertices(geometry: Any) -> Float[np.ndarray, "n 3"]:
    for name in ("points", "vertices"):
        if hasattr(geometry, name):
            return np.asarray(getattr(geometry, name)(), dtype=float).reshape(-1, 3)
    geometry.computeLocalAABB()
    box = np.array([geometry.aabb_local.min_, geometry.aabb_local.max_])
    corner = np.array(np.meshgrid(*[[0, 1]] * 3)).reshape(3, -1).T
    return np.asarray(np.take_along_axis(box, corner, axis=0))


@compiled
def _placed(fixed, x, points, joint):  # type: ignore[no-untyped-def]
    m, k = x.shape
    out = np.empty((m, len(points), 3))
    work, tmp = np.empty((k + 1, 3, 4)), np.empty((3, 4))
    for i in range(m):
        frames(fixed, x[i], work, tmp)
        for p in range(len(points)):
            T = work[joint[p]]
            for a in range(3):
                out[i, p, a] = T[a, 0] * points[p, 0] + T[a, 1] * points[p, 1] + T[a, 2] * points[p, 2] + T[a, 3]
    return out


@compiled
def _clear(fixed, x, points, joint, T_field_base, values, origin, cell, least):  # type: ignore[no-untyped-def]
    m = len(x)
    clear = np.ones(m, np.bool_)
    size = values.shape
    place, low = np.empty(3), np.empty(3, np.int64)
    for i in range(m):
        there = _placed(fixed, x[i : i + 1], points, joint)[0]
        T = T_field_base[i]
        for p in range(len(points)):
            inside = True
            for a in range(3):
                world = T[a, 0] * there[p, 0] + T[a, 1] * there[p, 1] + T[a, 2] * there[p, 2] + T[a, 3]
                place[a] = (world - origin[a]) / cell
                low[a] = int(np.floor(place[a]))
                inside = inside and low[a] >= 0 and low[a] < size[a] - 1
            if not inside:
                continue
            f0, f1, f2 = place[0] - low[0], place[1] - low[1], place[2] - low[2]
            distance = 0.0
            for corner in range(8):
                i0, i1, i2 = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1
                weight = (f0 if i0 else 1 - f0) * (f1 if i1 else 1 - f1) * (f2 if i2 else 1 - f2)
                distance += weight * values[low[0] + i0, low[1] + i1, low[2] + i2]
            if distance < least:
                clear[i] = False
                break
    return clear
