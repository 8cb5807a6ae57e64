"""Measured poses against an articulation: residuals, their derivatives, and the position q of each pose.

Positions q are nuisance variables, one per pose: they are solved for exactly and projected out of the Jacobian
(variable projection, Golub & Pereyra 1973, in Kaufman's form), so that a fit has the articulation's own unknowns only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError
from understudy.lie import hat
from understudy.objects.articulation import FIXED, PRISMATIC, REVOLUTE, Articulation

_STEPS: Final = 4  # of Gauss-Newton for q; started from the closed form, two reach the last digit


@dataclass(frozen=True, eq=False)
class Measured:
    """Poses that were measured, and how well."""

    p: Float[np.ndarray, "n 3"]
    """metres"""
    R: Float[np.ndarray, "n 3 3"]
    """identity where the rotation was not measured"""
    whitener: Float[np.ndarray, "*b n 6 6"]
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

    def scaled(self, scale: Float[np.ndarray, "*b 2"]) -> Measured:
        """With the standard deviations of positions and rotations multiplied; for hypotheses each by its own."""
        return Measured(self.p, self.R, self.whitener / np.repeat(scale, 3, axis=-1)[..., None, None, :], self.oriented)


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


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Articulations of one kind while they are fitted: one (no leading shape) or many. Nothing is checked."""

    kind: str
    R: Float[np.ndarray, "*b 3 3"]
    p: Float[np.ndarray, "*b 3"]
    """with R the pose at q = 0"""
    direction: Float[np.ndarray, "*b 3"]
    point: Float[np.ndarray, "*b 3"]

    @classmethod
    def of(cls, a: Articulation) -> Hypotheses:
        """One articulation."""
        return cls(a.kind, a.T_rest[:3, :3], a.T_rest[:3, 3], a.direction, a.point)

    def part(self, which: Any) -> Hypotheses:
        """One of many, or some."""
        return Hypotheses(self.kind, self.R[which], self.p[which], self.direction[which], self.point[which])

    def where(self, mask: Bool[np.ndarray, " b"], other: Hypotheses) -> Hypotheses:
        """These where the mask is true, others elsewhere."""
        row = mask[:, None]
        R, p = np.where(row[..., None], self.R, other.R), np.where(row, self.p, other.p)
        return Hypotheses(
            self.kind,
            R,
            p,
            np.where(row, self.direction, other.direction),
            np.where(row, self.point, other.point),
        )


def tangents(direction: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 2"]:
    """Two unit vectors across a unit vector, and across each other."""
    K = hat(direction)
    least = np.abs(direction).argmin(axis=-1)[..., None, None]
    first = np.take_along_axis(K, least, axis=-1)  # direction x that axis
    first = first / np.sqrt((first**2).sum(axis=-2, keepdims=True))
    return np.concatenate([first, K @ first], axis=-1)


def residuals(h: Hypotheses, q: Float[np.ndarray, "*b n"], m: Measured) -> Float[np.ndarray, "*b n 6"]:
    """(dp, dr) that take the articulations' poses to the measured ones; dr is 0 where no rotation was measured."""
    E = _turns(h, q)
    dr = _log(m.R @ (E @ h.R[..., None, :, :]).swapaxes(-1, -2))
    return np.concatenate([m.p - _origins(h, q, E), dr * m.oriented[:, None]], axis=-1)


def _turns(h: Hypotheses, q: np.ndarray) -> np.ndarray:
    """Rotations (*b, n, 3, 3) from the rest pose, by Rodrigues' formula: the axis is one for all."""
    if h.kind != REVOLUTE:
        return np.broadcast_to(np.eye(3), (*q.shape, 3, 3))
    K = hat(h.direction)[..., None, :, :]
    return np.asarray(np.eye(3) + np.sin(q)[..., None, None] * K + (1 - np.cos(q))[..., None, None] * (K @ K))


def _origins(h: Hypotheses, q: np.ndarray, E: np.ndarray) -> np.ndarray:
    """Where the part's origin goes, (*b, n, 3)."""
    if h.kind == REVOLUTE:
        arm = (h.p - h.point)[..., None, :, None]
        return np.asarray((E @ arm)[..., 0] + h.point[..., None, :])
    way = q[..., None] * h.direction[..., None, :] if h.kind == PRISMATIC else np.zeros((*q.shape, 3))
    return h.p[..., None, :] + way


def _log(R: np.ndarray) -> np.ndarray:
    """Rotation vectors (*b, 3). Less exact within 1e-6 of half a turn, where only outliers are."""
    v = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1) / 2
    sine = np.sqrt((v**2).sum(axis=-1))
    angle = np.arctan2(sine, (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1) / 2)
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    return np.asarray(v * factor[..., None])


def _exp(v: np.ndarray) -> np.ndarray:
    """Rotations (*b, 3, 3) of rotation vectors (*b, 3)."""
    angle = np.sqrt((v**2).sum(axis=-1))[..., None, None]
    K = hat(v)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * (K @ K))


def whiten(m: Measured, e: Float[np.ndarray, "*b n 6"]) -> Float[np.ndarray, "*b n 6"]:
    """Residuals in standard deviations."""
    return np.asarray((m.whitener @ e[..., None])[..., 0])


def slope(h: Hypotheses, q: Float[np.ndarray, "*b n"]) -> Float[np.ndarray, "*b n 6"]:
    """Velocity (metres, and radians as a rotation vector) of the part's pose per unit of q."""
    out = np.zeros((*q.shape, 6))
    if h.kind == PRISMATIC:
        out[..., :3] = h.direction[..., None, :]
    elif h.kind == REVOLUTE:
        arm = _origins(h, q, _turns(h, q)) - h.point[..., None, :]
        out[..., :3] = arm @ hat(h.direction).swapaxes(-1, -2)
        out[..., 3:] = h.direction[..., None, :]
    return out


def derivatives(
    h: Hypotheses, q: Float[np.ndarray, "*b n"], e: Float[np.ndarray, "*b n 6"]
) -> Float[np.ndarray, "*b n 6 k"]:
    """Of the residuals e by the unknowns that `stepped` takes."""
    motion = np.zeros((*q.shape, 6, {FIXED: 6, PRISMATIC: 8, REVOLUTE: 10}[h.kind]))
    if h.kind == REVOLUTE:
        E = _turns(h, q)
        motion[..., :3, :3] = motion[..., 3:, 3:6] = E
        tilt = (np.eye(3) - E) @ tangents(h.direction)[..., None, :, :]
        arm = _origins(h, q, E) - h.point[..., None, :]
        motion[..., :3, 6:8] = -hat(arm) @ tilt
        motion[..., 3:, 6:8] = motion[..., :3, 8:10] = tilt
    else:
        motion[..., :6] = np.eye(6)
        if h.kind == PRISMATIC:
            way = hat(h.direction) @ tangents(h.direction)
            motion[..., :3, 6:8] = -q[..., None, None] * way[..., None, :, :]
    motion[..., 3:, :] = _seen(e) @ motion[..., 3:, :]
    return -motion


def _seen(e: np.ndarray) -> np.ndarray:
    """The change of Log(R_measured R') when R turns by a small rotation on its left: the inverse right Jacobian."""
    angle = np.sqrt((e[..., 3:] ** 2).sum(axis=-1))
    angle = np.clip(angle, 1e-3, 3.0)  # below: the series' next term is 1e-9; above: an outlier
    K = hat(e[..., 3:])
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.asarray(np.eye(3) + K / 2 + factor[..., None, None] * (K @ K))


def stepped(h: Hypotheses, delta: np.ndarray) -> Hypotheses:
    """Moved a little: the pose by (dp, dr) on its left, the direction by a rotation across it, the point across it."""
    direction, point = h.direction, h.point
    if h.kind != FIXED:
        B = tangents(direction)
        turn = _exp((B @ delta[..., 6:8, None])[..., 0])
        direction = (turn @ direction[..., None])[..., 0]
        if h.kind == REVOLUTE:
            point = point + (B @ delta[..., 8:10, None])[..., 0]
    return Hypotheses(h.kind, _exp(delta[..., 3:6]) @ h.R, h.p + delta[..., :3], direction, point)


def solve_positions(
    h: Hypotheses, m: Measured, start: Float[np.ndarray, "*b n"] | None = None, steps: int = _STEPS
) -> Float[np.ndarray, "*b n"]:
    """The likeliest q of each pose; angles in (-pi, pi], or near `start` where that is given."""
    q = np.zeros((*h.p.shape[:-1], len(m))) if start is None else start
    if h.kind == FIXED:
        return q
    if h.kind == REVOLUTE and start is None:
        q = _first_angles(h, m)
    for _ in range(1 if h.kind == PRISMATIC else steps):
        e = residuals(h, q, m)
        j = slope(h, q)
        j[..., 3:] = (_seen(e) @ j[..., 3:, None])[..., 0]
        j, r = whiten(m, j), whiten(m, e)
        step = (j * r).sum(axis=-1) / np.maximum((j**2).sum(axis=-1), 1e-12)
        q = q + (step if h.kind == PRISMATIC else np.clip(step, -0.5, 0.5))
    return q if start is not None or h.kind == PRISMATIC else np.pi - (np.pi - q) % (2 * np.pi)


def _first_angles(h: Hypotheses, m: Measured) -> np.ndarray:
    """Angles from positions and from rotations, averaged on the circle with about the weights they deserve."""
    across = tangents(h.direction)
    arm, rest = (m.p - h.point[..., None, :]) @ across, (h.p - h.point)[..., None, :] @ across
    cos = (arm * rest).sum(axis=-1)
    sin = arm[..., 1] * rest[..., 0] - arm[..., 0] * rest[..., 1]
    length = np.maximum(np.hypot(cos, sin), 1e-12)
    precision = (m.whitener**2).sum(axis=-2) / 3
    weight = (rest**2).sum(axis=-1) * precision[..., :3].sum(axis=-1)
    turn = m.R @ h.R[..., None, :, :].swapaxes(-1, -2)
    twist = across[..., None, :, :].swapaxes(-1, -2) @ turn @ across[..., None, :, :]
    angle = np.arctan2(twist[..., 1, 0] - twist[..., 0, 1], twist[..., 0, 0] + twist[..., 1, 1])
    weight_r = precision[..., 3:].sum(axis=-1)
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
        m, h = measured(T[known], covariance[known]), Hypotheses.of(articulation)
        q[known] = solve_positions(h, m)
        j = whiten(m, slope(h, q[known]))
        with np.errstate(divide="ignore"):
            sigma[known] = 0.0 if articulation.kind == FIXED else 1 / np.linalg.norm(j, axis=1)
    return q, sigma
