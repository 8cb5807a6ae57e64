"""Kinematics of one serial chain, compiled: torso (prismatic) and arm (revolute joints), all turned onto z.

A pose is a 3x4 matrix here. Joint k's frame is `fixed[k]` after joint k - 1's, and the joint turns about (joint 0:
moves along) its own z. The tool is `fixed[n + 1]` after the last.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import unwrap
from typing import Any

import numpy as np
from numba import njit


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """numba's njit of the plain function: the type checks that tests wrap around every function are taken off."""
    return njit(unwrap(function), cache=True, nogil=True)


@compiled
def compose(a, b, out):  # type: ignore[no-untyped-def]
    """out = a b, 3x4 each; out must be neither."""
    for i in range(3):
        for j in range(4):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
        out[i, 3] += a[i, 3]


@compiled
def frames(fixed, q, out, tmp):  # type: ignore[no-untyped-def]
    """All joint frames (after their motion) and the tool's last: out (n + 2, 3, 4) for q (n + 1), q[0] the torso's."""
    n = q.shape[0]
    for i in range(3):
        for j in range(4):
            out[0, i, j] = fixed[0, i, j]
        out[0, i, 3] += out[0, i, 2] * q[0]
    for k in range(1, n):
        compose(out[k - 1], fixed[k], tmp)
        c, s = np.cos(q[k]), np.sin(q[k])
        for i in range(3):
            x, y = tmp[i, 0], tmp[i, 1]
            out[k, i, 0] = c * x + s * y
            out[k, i, 1] = c * y - s * x
            out[k, i, 2] = tmp[i, 2]
            out[k, i, 3] = tmp[i, 3]
    compose(out[n - 1], fixed[n], out[n])


@compiled
def forward_many(fixed, q):  # type: ignore[no-untyped-def]
    """Tool poses (m, 4, 4) in the base frame for q (m, n + 1)."""
    m, n = q.shape
    T = np.zeros((m, 4, 4))
    work, tmp = np.empty((n + 1, 3, 4)), np.empty((3, 4))
    for i in range(m):
        frames(fixed, q[i], work, tmp)
        for r in range(3):
            for c in range(4):
                T[i, r, c] = work[n, r, c]
        T[i, 3, 3] = 1.0
    return T


@compiled
def jacobian(work, J):  # type: ignore[no-untyped-def]
    """J (6, n): velocity of the tool (translation, rotation), in the tool's frame, over joint velocities."""
    n = J.shape[1]
    tool = work[n]
    for k in range(n):
        ax, ay, az = work[k, 0, 2], work[k, 1, 2], work[k, 2, 2]
        dx, dy, dz = tool[0, 3] - work[k, 0, 3], tool[1, 3] - work[k, 1, 3], tool[2, 3] - work[k, 2, 3]
        vx, vy, vz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
        wx, wy, wz = ax, ay, az
        if k == 0:
            vx, vy, vz, wx, wy, wz = ax, ay, az, 0.0, 0.0, 0.0
        for i in range(3):
            J[i, k] = tool[0, i] * vx + tool[1, i] * vy + tool[2, i] * vz
            J[3 + i, k] = tool[0, i] * wx + tool[1, i] * wy + tool[2, i] * wz


@compiled
def pose_error(current, target, e):  # type: ignore[no-untyped-def]
    """e (6): translation and rotation vector (radians) that take `current` to `target`, in the current frame.

    The translation is the plain difference, the rotation the logarithm of R_current^T R_target.
    """
    R = np.empty((3, 3))
    for i in range(3):
        e[i] = 0.0
        for j in range(3):
            e[i] += current[j, i] * (target[j, 3] - current[j, 3])
            R[i, j] = current[0, i] * target[0, j] + current[1, i] * target[1, j] + current[2, i] * target[2, j]
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    s = np.sqrt(x * x + y * y + z * z)
    c = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = np.arctan2(s, c)
    if s > 1e-7:
        f = angle / s
        e[3], e[4], e[5] = f * x, f * y, f * z
    elif c > 0:
        e[3], e[4], e[5] = x, y, z
    else:  # half a turn: the axis is the largest column of R + 1
        k = 0
        for i in range(1, 3):
            if R[i, i] > R[k, k]:
                k = i
        e[3], e[4], e[5] = R[0, k], R[1, k], R[2, k]
        e[3 + k] += 1.0
        size = np.pi / np.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
        for i in range(3, 6):
            e[i] *= size
