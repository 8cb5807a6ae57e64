"""Forward and inverse kinematics of a whole performance at once: every array has the time as its first axis.

Body frame: x forward, y to the person's left, z up. Metres, radians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

STRETCH: Final = 0.998
"""A limb is never straighter than this share of its length."""


def unit(v: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Vectors scaled to length one."""
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))


def about(axis: Float[np.ndarray, "... 3"], angle: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotations about unit axes (one, or one per angle), right-handed (Rodrigues' formula)."""
    axis, angle = np.asarray(axis, np.float64), np.asarray(angle, np.float64)
    u = axis[..., 0], axis[..., 1], axis[..., 2]
    s, c = np.sin(angle), np.cos(angle)
    R = np.empty((*angle.shape, 3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        R[..., i, i] = c + (1 - c) * u[i] * u[i]
        R[..., i, j] = (1 - c) * u[i] * u[j] - s * u[k]
        R[..., j, i] = (1 - c) * u[i] * u[j] + s * u[k]
    return R


X, Y, Z = np.eye(3)


def frame(x: Float[np.ndarray, "*b 3"], near: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotations whose x column is along `x` and whose z column is the part of `near` square to it."""
    x = unit(x)
    z = unit(near - x * np.sum(x * near, -1, keepdims=True))
    return np.stack([x, np.cross(z, x), z], -1)


def apply(R: Float[np.ndarray, "*b 3 3"], v: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "*b 3"]:
    """Rotates vectors: one each, or the same one by all rotations."""
    return np.asarray((R @ v[..., None])[..., 0])


def twist_angle(R: Float[np.ndarray, "*b 3 3"], axis: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """The part of rotations that is about a unit axis (swing-twist), in (-pi, pi]."""
    skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    return np.asarray(2 * np.arctan2(np.sum(skew * axis, -1), 1 + trace))


def middle_joint(
    start: Float[np.ndarray, "t 3"],
    goal: Float[np.ndarray, "t 3"],
    lengths: tuple[float, float],
    pole: Float[np.ndarray, "t 3"],
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"]]:
    """Elbow or knee, bent towards `pole`, and the limb's end: the goal, or as far towards it as the limb reaches."""
    upper, lower = lengths
    way = goal - start
    along = unit(way)
    distance = np.clip(np.linalg.norm(way, axis=-1), abs(upper - lower) + 1e-3, STRETCH * (upper + lower))
    side = unit(pole - along * np.sum(along * pole, -1, keepdims=True))
    a = (upper**2 - lower**2 + distance**2) / (2 * distance)
    height = np.sqrt(np.maximum(upper**2 - a**2, 0.0))
    return start + along * a[:, None] + side * height[:, None], start + along * distance[:, None]


def forward(
    parents: Sequence[int],
    heads: Float[np.ndarray, "b 3"],
    rotations: Mapping[int, Float[np.ndarray, "t 3 3"]],
    root: Float[np.ndarray, "t 3"],
) -> tuple[Float[np.ndarray, "t b 3 3"], Float[np.ndarray, "t b 3"]]:
    """World rotation and place of every bone.

    heads: places of the bones at rest. rotations: world rotations (identity at rest) of the bones that turn by
    themselves; every other bone follows its parent, of which `parents` has the index (less than its own).
    """
    t = len(root)
    R, p = np.empty((t, len(heads), 3, 3)), np.empty((t, len(heads), 3))
    for i, parent in enumerate(parents):
        if parent < 0:
            R[:, i], p[:, i] = rotations.get(i, np.eye(3)), root
        else:
            R[:, i] = rotations.get(i, R[:, parent])
            p[:, i] = p[:, parent] + R[:, parent] @ (heads[i] - heads[parent])
    return R, p
