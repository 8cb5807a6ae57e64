"""SO(3), SE(3) and SE(2): exponentials, logarithms, adjoints and Jacobians of stacks of transforms.

Tangent vectors are (translation, rotation), metres and radians. Perturbations are on the right: T (+) d = T Exp(d).
With e = Log(A^-1 T), d e / d T = right Jacobian inverse at e, and d e / d A = -left Jacobian inverse at e.
Planar poses are rows (x, y, yaw). Formulas: Barfoot, State Estimation for Robotics, 2017, chapter 7; Sola et al.,
A micro Lie theory, arXiv 1812.01537. Any number of leading dimensions.
"""

from __future__ import annotations

from math import factorial
from typing import Final

import numpy as np
from jaxtyping import Float

_SERIES_BELOW: Final = 0.5  # radians: closed forms lose digits to cancellation below
_TERMS: Final = 9
_ALTERNATING: Final = (-1.0) ** np.arange(_TERMS)
_C1: Final = _ALTERNATING / [factorial(2 * k + 3) for k in range(_TERMS)]
_C2: Final = _ALTERNATING / [factorial(2 * k + 4) for k in range(_TERMS)]
_C3: Final = _ALTERNATING * [(k + 1) / factorial(2 * k + 5) for k in range(_TERMS)]
_INVERSE: Final = np.array([1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000])
_NEAREST: Final = 1e-12  # angle at which sin(x) / x is 1 to the last digit


def hat(w: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Cross-product matrices: hat(w) v = w x v."""
    K = np.zeros((*w.shape, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return K


def _polynomial(coefficients: np.ndarray, x: np.ndarray) -> np.ndarray:
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value


def _blend(angle: np.ndarray, coefficients: np.ndarray, closed: np.ndarray) -> np.ndarray:
    small = angle < _SERIES_BELOW
    return np.asarray(np.where(small, _polynomial(coefficients, np.asarray(np.where(small, angle, 0.0)) ** 2), closed))


def _b(angle: np.ndarray) -> np.ndarray:
    """(1 - cos a) / a^2"""
    half = np.maximum(0.5 * np.abs(angle), _NEAREST)
    return np.asarray(0.5 * (np.sin(half) / half) ** 2)


def _c(angle: np.ndarray) -> np.ndarray:
    """(a - sin a) / a^3"""
    a = np.maximum(np.abs(angle), _SERIES_BELOW)
    return _blend(np.abs(angle), _C1, (a - np.sin(a)) / a**3)


def _d(angle: np.ndarray) -> np.ndarray:
    """(1 - a / 2 cot(a / 2)) / a^2, for |a| < 2 pi"""
    a = np.maximum(np.abs(angle), _SERIES_BELOW)
    return _blend(np.abs(angle), _INVERSE, (1 - 0.5 * a / np.tan(0.5 * a)) / a**2)


def so3_exp(w: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Rotation matrices of rotation vectors."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = hat(w)
    return np.eye(3) + np.sinc(angle / np.pi) * K + _b(angle) * (K @ K)


def so3_log(R: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Rotation vectors, of length 0 to pi. By the quaternion's largest component: accurate at 0 and at pi."""
    d = np.diagonal(R, axis1=-2, axis2=-1)
    products = np.empty((*R.shape[:-2], 4, 4))  # 4 q q', q = (x, y, z, w)
    trace = d.sum(axis=-1)
    for i in range(3):
        products[..., i, i] = 1 + 2 * d[..., i] - trace
        for j in range(i):
            products[..., i, j] = products[..., j, i] = R[..., i, j] + R[..., j, i]
    products[..., 3, 3] = 1 + trace
    skew = np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]],
        axis=-1,
    )
    products[..., 3, :3] = products[..., :3, 3] = skew
    largest = np.asarray(np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1))
    q = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    q = q * np.where(q[..., 3:] < 0, -1.0, 1.0)
    length = np.linalg.norm(q[..., :3], axis=-1)
    half = np.arctan2(length, q[..., 3])
    norm = np.linalg.norm(q, axis=-1)
    # 2 half / length for a unit quaternion; the limit where there is no axis is 2
    scale = np.where(length > _NEAREST * norm, 2 * half / np.where(length > 0, length, 1.0), 2 / norm)
    return np.asarray(q[..., :3] * scale[..., None])


def so3_left_jacobian(w: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """J with Exp(w + d) = Exp(J d) Exp(w) to first order. The right Jacobian is that of -w."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = hat(w)
    return np.eye(3) + _b(angle) * K + _c(angle) * (K @ K)


def so3_left_jacobian_inverse(w: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Inverse of `so3_left_jacobian`, for rotations of less than 2 pi."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    K = hat(w)
    return np.eye(3) - 0.5 * K + _d(angle) * (K @ K)


def _pose(R: np.ndarray, p: np.ndarray) -> Float[np.ndarray, "*n 4 4"]:
    T = np.zeros((*p.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, p, 1
    return T


def se3_exp(d: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """Transforms of tangent vectors (translation, rotation)."""
    p = so3_left_jacobian(d[..., 3:]) @ d[..., :3, None]
    return _pose(so3_exp(d[..., 3:]), p[..., 0])


def se3_log(T: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 6"]:
    """Tangent vectors (translation, rotation) of transforms."""
    w = so3_log(T[..., :3, :3])
    v = so3_left_jacobian_inverse(w) @ T[..., :3, 3:]
    return np.concatenate([v[..., 0], w], axis=-1)


def se3_inverse(T: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """Inverse transforms."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return _pose(R, -(R @ T[..., :3, 3:])[..., 0])


def se3_adjoint(T: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 6 6"]:
    """Ad with T Exp(d) = Exp(Ad d) T."""
    R = T[..., :3, :3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return A


def _coupling(d: np.ndarray) -> Float[np.ndarray, "*n 3 3"]:
    """Barfoot's Q: how a rotation's change moves the translation (equation 7.86)."""
    V, W = hat(d[..., :3]), hat(d[..., 3:])
    angle = np.linalg.norm(d[..., 3:], axis=-1)[..., None, None]
    a = np.maximum(angle, _SERIES_BELOW)
    c2 = _blend(angle, _C2, (0.5 * a**2 + np.cos(a) - 1) / a**4)
    c3 = _blend(angle, _C3, (2 * a - 3 * np.sin(a) + a * np.cos(a)) / (2 * a**5))
    WV, VW = W @ V, V @ W
    WVW = WV @ W
    return np.asarray(
        0.5 * V + _c(angle) * (WV + VW + WVW) + c2 * (W @ WV + VW @ W - 3 * WVW) + c3 * (WVW @ W + W @ WVW)
    )


def se3_left_jacobian(d: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 6 6"]:
    """J with Exp(d + x) = Exp(J x) Exp(d) to first order. The right Jacobian is that of -d."""
    J = np.zeros((*d.shape, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = so3_left_jacobian(d[..., 3:])
    J[..., :3, 3:] = _coupling(d)
    return J


def se3_left_jacobian_inverse(d: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 6 6"]:
    """Inverse of `se3_left_jacobian`; of the right Jacobian: that of -d."""
    inverse = so3_left_jacobian_inverse(d[..., 3:])
    J = np.zeros((*d.shape, 6))
    J[..., :3, :3] = J[..., 3:, 3:] = inverse
    J[..., :3, 3:] = -inverse @ _coupling(d) @ inverse
    return J


def wrapped(angle: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """The same angles in [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _turned(yaw: np.ndarray, xy: np.ndarray) -> Float[np.ndarray, "*n 2"]:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], axis=-1)


def se2_compose(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*k 3"]:
    """a b; the yaws are added, not wrapped, so that tracks stay continuous."""
    xy = a[..., :2] + _turned(np.asarray(a[..., 2]), b[..., :2])
    return np.concatenate([xy, (a[..., 2] + b[..., 2])[..., None]], axis=-1)


def se2_inverse(a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Inverse poses."""
    return np.concatenate([-_turned(np.asarray(-a[..., 2]), a[..., :2]), -a[..., 2:]], axis=-1)


def se2_exp(d: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Planar poses of tangent vectors."""
    angle = np.asarray(d[..., 2])
    s, c = np.sinc(angle / np.pi), _b(angle) * angle
    x, y = d[..., 0], d[..., 1]
    return np.stack([s * x - c * y, c * x + s * y, angle], axis=-1)


def se2_log(a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Tangent vectors of planar poses; yaws are wrapped."""
    angle = wrapped(np.asarray(a[..., 2]))
    along, half = 1 - _d(angle) * angle**2, 0.5 * angle
    x, y = a[..., 0], a[..., 1]
    return np.stack([along * x + half * y, along * y - half * x, angle], axis=-1)


def se2_adjoint(a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Ad with a Exp(d) = Exp(Ad d) a."""
    A = np.zeros((*a.shape, 3))
    A[..., 0, 0] = A[..., 1, 1] = np.cos(a[..., 2])
    A[..., 1, 0] = np.sin(a[..., 2])
    A[..., 0, 1] = -A[..., 1, 0]
    A[..., 0, 2], A[..., 1, 2], A[..., 2, 2] = a[..., 1], -a[..., 0], 1
    return A


def se2_left_jacobian(d: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """J with Exp(d + x) = Exp(J x) Exp(d) to first order. The right Jacobian is that of -d."""
    x, y, angle = d[..., 0], d[..., 1], np.asarray(d[..., 2])
    b, c = _b(angle), _c(angle) * angle
    J = np.zeros((*d.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = np.sinc(angle / np.pi)
    J[..., 1, 0] = b * angle
    J[..., 0, 1] = -b * angle
    J[..., 0, 2], J[..., 1, 2], J[..., 2, 2] = c * x + b * y, c * y - b * x, 1
    return J


def se2_left_jacobian_inverse(d: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Inverse of `se2_left_jacobian`; of the right Jacobian: that of -d."""
    angle = np.asarray(d[..., 2])
    column = se2_left_jacobian(d)[..., :2, 2]
    along, half = 1 - _d(angle) * angle**2, 0.5 * angle
    J = np.zeros((*d.shape, 3))
    J[..., 0, 0] = J[..., 1, 1] = along
    J[..., 0, 1], J[..., 1, 0], J[..., 2, 2] = half, -half, 1
    J[..., 0, 2] = -(along * column[..., 0] + half * column[..., 1])
    J[..., 1, 2] = -(along * column[..., 1] - half * column[..., 0])
    return J


def se2_to_se3(a: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 4 4"]:
    """Planar poses as transforms, on the floor z = 0."""
    T = np.zeros((*a.shape[:-1], 4, 4))
    T[..., 0, 0] = T[..., 1, 1] = np.cos(a[..., 2])
    T[..., 1, 0] = np.sin(a[..., 2])
    T[..., 0, 1] = -T[..., 1, 0]
    T[..., 0, 3], T[..., 1, 3] = a[..., 0], a[..., 1]
    T[..., 2, 2] = T[..., 3, 3] = 1
    return T
