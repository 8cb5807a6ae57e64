"""The lengths of a person's bones: learnt over a track, and kept by the joints."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.skeleton import BONES, N_JOINTS

N_BONES: Final = len(BONES)
FROM, TO = np.array(BONES).T
_INCIDENCE: Final = np.eye(N_JOINTS)[FROM] - np.eye(N_JOINTS)[TO]

USUAL_M: Final = np.array(
    [0.165, 0.28, 0.25, 0.165, 0.28, 0.25, 0.46, 0.41, 0.40, 0.46, 0.41, 0.40, 0.22, 0.21, 0.05, 0.09, 0.05, 0.09]
)
"""of adults, in the order of `skeleton.BONES`; rounded from simulated bodies"""
GIVE_M: Final = np.array(
    [
        0.01,
        0.005,
        0.005,
        0.01,
        0.005,
        0.005,
        0.02,
        0.005,
        0.005,
        0.02,
        0.005,
        0.005,
        0.01,
        0.02,
        0.003,
        0.003,
        0.003,
        0.003,
    ]
)
"""one sigma by which a length changes with the pose: spine and shoulders bend, limbs do not"""
SCALE: Final = 0.15
"""by which people's sizes differ, one sigma"""
_SHAPE: Final = 0.08  # by which a bone differs from what the person's size makes likely, one sigma
SHARED: Final = 0.45
"""of a joint's variance that its neighbours share: the bone between them does not know of it (measured)"""
_STEPS: Final = 5  # of Gauss and Newton
_SHORT: Final = 0.01  # metres: a bone this short has no direction


def lengths(keypoints: Float[np.ndarray, "*t 18 3"]) -> Float[np.ndarray, "*t n"]:
    """Of all bones, metres, in the order of `skeleton.BONES`; NaN where an end is missing."""
    return np.asarray(np.linalg.norm(keypoints[..., FROM, :] - keypoints[..., TO, :], axis=-1))


def variances(variance: Float[np.ndarray, "*t 18"]) -> Float[np.ndarray, "*t n"]:
    """Of the lengths, square metres, from those of the joints along each axis."""
    return np.asarray((1 - SHARED) * (variance[..., FROM] + variance[..., TO]))


def learn(
    length: Float[np.ndarray, "t n"], variance: Float[np.ndarray, "t n"], independent: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Lengths and their sigmas, metres, from lengths at t moments; those of most people where there is nothing better.

    The weighted median of the lengths, then the maximum a posteriori under the prior: a person's size, and bones that
    fit it. independent: how many moments have errors of their own; more moments do not make the lengths surer.
    """
    known = np.isfinite(length) & np.isfinite(variance)
    noise = np.where(known, variance + GIVE_M**2, np.inf)
    weight = 1 / noise
    measured = _medians(np.where(known, length, 0.0), weight)
    total = weight.sum(axis=0)
    any_ = total > 0
    count = np.where(any_, total**2 / np.maximum((weight**2).sum(axis=0), 1e-300), 1.0)
    spread = np.where(any_, count / np.maximum(total, 1e-300) / np.clip(independent, 1.0, count) * np.pi / 2, np.inf)
    relative = spread / USUAL_M**2 + _SHAPE**2
    ratio, sure = np.where(any_, measured / USUAL_M, 1.0), np.where(any_, 1 / relative, 0.0)
    scale = (1 / SCALE**2 + (sure * ratio).sum()) / (1 / SCALE**2 + sure.sum())
    prior, prior_sd = scale * USUAL_M, _SHAPE * USUAL_M
    w = prior_sd**2 / (prior_sd**2 + spread)
    return np.where(any_, w * measured + (1 - w) * prior, prior), prior_sd * np.sqrt(1 - w)


def _medians(values: Float[np.ndarray, "t n"], weight: Float[np.ndarray, "t n"]) -> Float[np.ndarray, " n"]:
    """Weighted median of each column."""
    order = np.argsort(values, axis=0)
    values, cumulative = np.take_along_axis(values, order, 0), np.cumsum(np.take_along_axis(weight, order, 0), axis=0)
    half = (cumulative >= 0.5 * cumulative[-1]).argmax(axis=0)
    return values[half, np.arange(values.shape[1])]


def enforce(
    position: Float[np.ndarray, "t 18 3"],
    variance: Float[np.ndarray, "t 18"],
    length: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "t 18 3"], Float[np.ndarray, "t 18"]]:
    """Joints moved, each as its uncertainty allows, until the bones have their lengths (up to `GIVE_M`); new variances.

    Least squares at each moment, by Gauss and Newton: sum |dp_j|^2 / variance_j + sum (|bone| - length)^2 / give^2.
    NaN rows stay; their bones do not count.
    """
    known = np.isfinite(position).all(axis=2) & np.isfinite(variance)
    start = np.where(known[..., None], position, 0.0)
    information = 1 / np.where(known, (1 - SHARED) * variance, 1.0)
    strength = np.where(known[:, FROM] & known[:, TO], 1 / (GIVE_M**2 + sigma**2), 0.0)
    p = start
    for _ in range(_STEPS):
        bone = _INCIDENCE @ p
        now = np.linalg.norm(bone, axis=2)
        u = bone / np.maximum(now, _SHORT)[..., None]
        H = _normal_matrix(information, strength, u)
        pull = (strength * (now - length))[..., None] * u
        gradient = information[..., None] * (p - start) + _INCIDENCE.T @ pull
        step = np.linalg.solve(H, gradient.reshape(len(p), -1, 1))
        p = p - step.reshape(p.shape)
    new = np.diagonal(np.linalg.inv(H), axis1=1, axis2=2).reshape(p.shape).mean(axis=2)
    return np.where(known[..., None], p, np.nan), np.where(known, SHARED * variance + new, np.nan)


def _normal_matrix(
    information: Float[np.ndarray, "t 18"], strength: Float[np.ndarray, "t n"], u: Float[np.ndarray, "t n 3"]
) -> Float[np.ndarray, "t 54 54"]:
    t = len(u)
    H = np.zeros((t, N_JOINTS, 3, N_JOINTS, 3))
    joints = np.arange(N_JOINTS)
    for axis in range(3):
        H[:, joints, axis, joints, axis] = information
    block = (strength[..., None, None] * u[..., :, None] * u[..., None, :]).swapaxes(0, 1)
    for k, (a, b) in enumerate(BONES):
        H[:, a, :, a] += block[k]
        H[:, b, :, b] += block[k]
        H[:, a, :, b] -= block[k]
        H[:, b, :, a] -= block[k]
    return H.reshape(t, 3 * N_JOINTS, 3 * N_JOINTS)
