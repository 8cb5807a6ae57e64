"""Rotations as vectors of the tangent space at their mean: R = R_mean Exp(w)."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.lie import so3_exp, so3_left_jacobian, so3_log

_CLOSE: Final = 1e-12  # radians: the mean moves no more, or there is no axis
_STEPS: Final = 100


def karcher_mean(R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation with the least sum of squared angles to n rotations (Karcher 1977)."""
    mean = np.asarray(Rotation.from_matrix(R).mean().as_matrix())  # chordal: near, and blind to the sign of quaternions
    for _ in range(_STEPS):
        step = so3_log(mean.T @ R).mean(axis=0)
        mean = mean @ so3_exp(step)
        if np.linalg.norm(step) < _CLOSE:
            break
    return mean


def to_tangent(R_mean: Float[np.ndarray, "3 3"], R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """w with R = R_mean Exp(w), along a path: where the angle passes pi, w goes on beyond it and does not jump."""
    w = so3_log(R_mean.T @ R)
    angle = np.linalg.norm(w, axis=1)
    if angle.max(initial=0.0) < np.pi / 2:
        return w
    start = int(angle.argmin())
    for steps in (range(start + 1, len(w)), range(start - 1, -1, -1)):
        previous = w[start]
        for i in steps:
            w[i] = previous = nearest_vector(w[i], previous)
    return w


def nearest_vector(w: Float[np.ndarray, "3"], to: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Of the vectors of w's rotation (they differ by full turns), the one nearest to another vector."""
    angle, length = np.linalg.norm(w), np.linalg.norm(to)
    if angle > _CLOSE:
        axis = w / angle
    elif length > _CLOSE:
        axis = to / length
    else:
        return w
    return np.asarray(w + axis * 2 * np.pi * np.round((to @ axis - w @ axis) / (2 * np.pi)))


def right_jacobian(w: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """J with Exp(w + d) = Exp(w) Exp(J d) to first order."""
    return so3_left_jacobian(-w)
