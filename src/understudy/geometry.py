"""Rigid transforms as 4x4 matrices. `T_a_b` takes points in frame b to frame a (CONVENTIONS.md)."""

import numpy as np
from jaxtyping import Float


def transform_points(T_a_b: Float[np.ndarray, "4 4"], points_b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Points (metres) in frame b -> the same points in frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def inverse(T_a_b: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """`T_b_a`."""
    R_ba = T_a_b[:3, :3].T
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = R_ba
    T_b_a[:3, 3] = -R_ba @ T_a_b[:3, 3]
    return T_b_a


def rigid(R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """4x4 transform of a rotation and a translation (metres)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def is_rigid(T: Float[np.ndarray, "4 4"], tolerance: float = 1e-4) -> bool:
    """Whether T is finite, its rotation orthonormal and right-handed, and its last row 0 0 0 1."""
    R = T[:3, :3]
    return bool(
        np.isfinite(T).all()
        and np.abs(R @ R.T - np.eye(3)).max() < tolerance
        and np.linalg.det(R) > 0
        and np.abs(T[3] - (0, 0, 0, 1)).max() < tolerance
    )


def angle_between(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Angle (radians, 0 to pi) between vectors. Exact for small angles too, unlike arccos of the cosine."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(a * b, axis=-1)))


def plane_normal(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Unit normal, either way, of the plane that points lie on best (least squares); for hot paths, see `along`."""
    away = (points - points.mean(axis=0)).T
    normal: np.ndarray = np.linalg.eigh((away[:, None] * away).sum(axis=2))[1][:, 0]
    return normal


def along(points: Float[np.ndarray, "*n 3"], directions: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "*n k"]:
    """How far each point is along each direction (dot products), for hot paths.

    einsum, not @: BLAS would wake its threads for it, which then spin for a while and hold up the networks that come
    next on the same cores. Turned round in memory first, since einsum is quick where the last axis is long.
    """
    x = np.ascontiguousarray(np.moveaxis(points, -1, 0))
    out: np.ndarray = np.einsum("i...,ik->...k", x, np.ascontiguousarray(directions.T))
    return out
