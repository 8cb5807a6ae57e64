"""Measured poses against an articulation: residuals, their derivatives, and the position q of each pose.

Positions q are nuisance variables, one per pose: they are solved for exactly and projected out of the Jacobian
(variable projection, Golub & Pereyra 1973, in Kaufman's form), so that a fit has the articulation's own unknowns only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from understudy.errors import UnderstudyError
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation

_STEPS: Final = 4  # of Gauss-Newton for q; started from the closed form, two reach the last digit


@dataclass(frozen=True, eq=False)
class Measured:
    """Poses that were measured, and how well."""

    p: Float[np.ndarray, "n 3"]
    """metres"""
    R: Float[np.ndarray, "n 3 3"]
    """identity where the rotation was not measured"""
    whitener: Float[np.ndarray, "n 6 6"]
    """A with A'A = inverse covariance of (dp, dr); rows of zeros for a rotation that was not measured"""
    oriented: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.p)

    @property
    def dimensions(self) -> Float[np.ndarray, " n"]:
        """Numbers measured in each pose: 6, or 3."""
        return np.where(self.oriented, 6.0, 3.0)

    def part(self, which: np.ndarray) -> Measured:
        """Some of the poses."""
        return Measured(self.p[which], self.R[which], self.whitener[which], self.oriented[which])

    def scaled(self, scale: Float[np.ndarray, "2"]) -> Measured:
        """With the standard deviations of positions and rotations multiplied."""
        return Measured(self.p, self.R, self.whitener / np.repeat(scale, 3), self.oriented)


def measured(T: Float[np.ndarray, "n 4 4"], covariance: Float[np.ndarray, "n 6 6"]) -> Measured:
    """Poses with finite positions, and the covariances of (dp, dr), metres and radians, along the axes of T's frame.

    A rotation counts as not measured where it is NaN, or where a variance of it is infinite.
    Raises UnderstudyError for a covariance that is not positive definite.
    """
    n = len(T)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    oriented = np.isfinite(T[:, :3, :3]).all(axis=(1, 2)) & np.isfinite(variances[:, 3:]).all(axis=1)
    whitener = np.zeros((n, 6, 6))
    try:
        whitener[:, :3, :3] = np.linalg.inv(np.linalg.cholesky(covariance[:, :3, :3]))
        whitener[oriented] = np.linalg.inv(np.linalg.cholesky(covariance[oriented]))
    except np.linalg.LinAlgError as e:
        raise UnderstudyError("covariance of poses must be positive definite") from e
    R = np.where(oriented[:, None, None], T[:, :3, :3], np.eye(3))
    return Measured(np.array(T[:, :3, 3], np.float64), R, whitener, oriented)


def tangents(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 2"]:
    """Two unit vectors across a unit vector, and across each other."""
    K = _skew(direction[None])[0]
    first = K[:, np.argmin(np.abs(direction))]  # direction x that axis
    first = first / np.linalg.norm(first)
    return np.column_stack([first, K @ first])


def residuals(articulation: Articulation, q: Float[np.ndarray, " n"], m: Measured) -> Float[np.ndarray, "n 6"]:
    """(dp, dr) that take the articulation's poses to the measured ones; dr is 0 where no rotation was measured."""
    E = _turns(articulation, q)
    R, p = E @ articulation.T_rest[:3, :3], _origins(articulation, q, E)
    dr = _log(m.R @ R.transpose(0, 2, 1))
    return np.hstack([m.p - p, dr * m.oriented[:, None]])


def _turns(articulation: Articulation, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations from the rest pose, by Rodrigues' formula: the axis is one for all."""
    if articulation.kind != REVOLUTE:
        return np.broadcast_to(np.eye(3), (len(q), 3, 3))
    K = _skew(articulation.direction[None])[0]
    return np.asarray(np.eye(3) + np.sin(q)[:, None, None] * K + (1 - np.cos(q))[:, None, None] * (K @ K))


def _origins(
    articulation: Articulation, q: Float[np.ndarray, " n"], E: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Where the part's origin goes."""
    rest = articulation.T_rest[:3, 3]
    if articulation.kind == REVOLUTE:
        return np.asarray(E @ (rest - articulation.point) + articulation.point)
    return rest + (q[:, None] * articulation.direction if articulation.kind == PRISMATIC else np.zeros((len(q), 1)))


def _log(R: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Rotation vectors. Less exact within 1e-6 of half a turn, where only outliers are; half of scipy's time."""
    v = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2
    sine = np.sqrt((v**2).sum(axis=1))
    angle = np.arctan2(sine, (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1) / 2)
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    return np.asarray(v * factor[:, None])


def whiten(m: Measured, e: Float[np.ndarray, "n 6 *k"]) -> Float[np.ndarray, "n 6 *k"]:
    """Residuals or their derivatives in standard deviations."""
    return np.asarray((m.whitener @ e.reshape(len(e), 6, -1)).reshape(e.shape))


def slope(articulation: Articulation, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 6"]:
    """Velocity (metres, and radians as a rotation vector) of the part's pose per unit of q."""
    out = np.zeros((len(q), 6))
    if articulation.kind == PRISMATIC:
        out[:, :3] = articulation.direction
    elif articulation.kind == REVOLUTE:
        arm = _origins(articulation, q, _turns(articulation, q)) - articulation.point
        out[:, :3] = arm @ _skew(articulation.direction[None])[0].T
        out[:, 3:] = articulation.direction
    return out


def derivatives(
    articulation: Articulation, q: Float[np.ndarray, " n"], e: Float[np.ndarray, "n 6"]
) -> Float[np.ndarray, "n 6 k"]:
    """Of the residuals e by the unknowns that `stepped` takes."""
    n = len(q)
    motion = np.zeros((n, 6, {FIXED: 6, PRISMATIC: 8, REVOLUTE: 10}[articulation.kind]))
    B = tangents(articulation.direction)
    if articulation.kind == REVOLUTE:
        E = _turns(articulation, q)
        motion[:, :3, :3] = motion[:, 3:, 3:6] = E
        tilt = (np.eye(3) - E) @ B
        arm = _origins(articulation, q, E) - articulation.point
        motion[:, :3, 6:8] = -_skew(arm) @ tilt
        motion[:, 3:, 6:8] = tilt
        motion[:, :3, 8:10] = tilt
    else:
        motion[:, :6, :6] = np.eye(6)
        if articulation.kind == PRISMATIC:
            motion[:, :3, 6:8] = -q[:, None, None] * _skew(articulation.direction[None]) @ B
    return -_seen(motion, e)


def _seen(motion: Float[np.ndarray, "n 6 *k"], e: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 6 *k"]:
    """The change of Log(R_measured R') when R turns by a small rotation on its left: the inverse right Jacobian."""
    phi = e[:, 3:]
    angle = np.clip(np.linalg.norm(phi, axis=1), 1e-3, 3.0)  # below: the series' next term is 1e-9; above: an outlier
    K = _skew(phi)
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    inverse = np.eye(3) + K / 2 + factor[:, None, None] * (K @ K)
    out = motion.copy()
    out[:, 3:] = (inverse @ motion[:, 3:].reshape(len(e), 3, -1)).reshape(motion[:, 3:].shape)
    return out


def _skew(v: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    x, y, z = v.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)


def stepped(articulation: Articulation, delta: Float[np.ndarray, " k"]) -> Articulation:
    """Moved a little: T_rest by (dp, dr) on its left, the direction by a rotation across it, the point across it."""
    T = articulation.T_rest.copy()
    T[:3, 3] += delta[:3]
    T[:3, :3] = (Rotation.from_rotvec(delta[3:6]) * Rotation.from_matrix(T[:3, :3])).as_matrix()
    direction, point = articulation.direction, articulation.point
    if articulation.kind != FIXED:
        B = tangents(direction)
        direction = Rotation.from_rotvec(B @ delta[6:8]).apply(direction)
        direction = direction / np.linalg.norm(direction)
        if articulation.kind == REVOLUTE:
            point = point + B @ delta[8:10]
    return Articulation(articulation.kind, T, direction, point, articulation.range)


def solve_positions(
    articulation: Articulation, m: Measured, start: Float[np.ndarray, " n"] | None = None, steps: int = _STEPS
) -> Float[np.ndarray, " n"]:
    """The likeliest q of each pose; angles in (-pi, pi], or near `start` where that is given."""
    if articulation.kind == FIXED:
        return np.zeros(len(m))
    q = start
    if q is None or articulation.kind == PRISMATIC:
        q = np.zeros(len(m)) if articulation.kind == PRISMATIC else _first_angles(articulation, m)
    for _ in range(1 if articulation.kind == PRISMATIC else steps):
        e = residuals(articulation, q, m)
        j = whiten(m, _seen(slope(articulation, q), e))
        r = whiten(m, e)
        step = (j * r).sum(axis=1) / np.maximum((j**2).sum(axis=1), 1e-12)
        q = q + (step if articulation.kind == PRISMATIC else np.clip(step, -0.5, 0.5))
    return q if start is not None or articulation.kind == PRISMATIC else np.pi - (np.pi - q) % (2 * np.pi)


def _first_angles(articulation: Articulation, m: Measured) -> Float[np.ndarray, " n"]:
    """Angles from positions and from rotations, averaged on the circle with about the weights they deserve."""
    a = articulation.direction
    arm, rest = m.p - articulation.point, articulation.T_rest[:3, 3] - articulation.point
    rest = rest - a * (rest @ a)
    cos, sin = arm @ rest, np.cross(rest, arm) @ a
    length = np.maximum(np.hypot(cos, sin), 1e-12)
    weight = (rest @ rest) * (m.whitener[:, :3, :3] ** 2).sum(axis=(1, 2)) / 3
    turn = m.R @ articulation.T_rest[:3, :3].T  # its twist about a: from the trace and the skew part across a
    swung = turn @ tangents(a)
    across = tangents(a)
    angle = np.arctan2(
        (swung[:, :, 0] @ across[:, 1]) - (swung[:, :, 1] @ across[:, 0]),
        (swung[:, :, 0] @ across[:, 0]) + (swung[:, :, 1] @ across[:, 1]),
    )
    weight_r = (m.whitener[:, 3:, 3:] ** 2).sum(axis=(1, 2)) / 3
    x = weight * cos / length + weight_r * np.cos(angle)
    y = weight * sin / length + weight_r * np.sin(angle)
    return np.asarray(np.arctan2(y, x))


def position_of(
    articulation: Articulation, T: Float[np.ndarray, "n 4 4"], covariance: Float[np.ndarray, "n 6 6"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Where along its articulation a part is: least squares in one unknown.

    T: poses in the articulation's frame; NaN where unknown, or the rotation alone NaN. covariance: of (dp, dr), metres
    and radians, along that frame's axes; infinite rotation variances leave the rotation out.
    Returns q (radians or metres; 0 for a fixed part) and its standard deviation; NaN where there is no position.
    """
    known = np.isfinite(T[:, :3, 3]).all(axis=1)
    q, sigma = np.full((2, len(T)), np.nan)
    if known.any():
        m = measured(T[known], covariance[known])
        q[known] = solve_positions(articulation, m)
        j = whiten(m, slope(articulation, q[known]))
        with np.errstate(divide="ignore"):
            sigma[known] = 0.0 if articulation.kind == FIXED else 1 / np.linalg.norm(j, axis=1)
    return q, sigma
