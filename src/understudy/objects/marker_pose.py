"""The pose of one square marker: from its corners (`marker_corners`) and the plane that the depth shows.

Marker frame: origin at its middle, x to its right, y up, z out of it, towards who looks at it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from understudy.camera import Camera
from understudy.geometry import rigid
from understudy.types import RegisteredDepth

_SCALE: Final = 0.0003  # relative error of distances: of the lens's and the marker's measured sizes
_DEPTH_BIAS_M: Final = 0.002  # of depth over a whole tag
_CORRELATED_PX: Final = 8.0  # depth pixels that share one error: sensors smooth (4 pi sigma^2 at sigma = 0.8 pixels)
_AROUND: Final = 1.4  # of a tag's size: depth pixels so far out count if they lie in its plane
_LEAST_PIXELS: Final = 6
_STEPS: Final = 10


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane seen by a depth camera: 1/z = h . (x, y, 1) on the ray (x, y, 1)."""

    h: Float[np.ndarray, "3"]
    """1 / metres: the unit normal divided by the distance from the camera"""
    covariance: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Solution:
    """A pose that explains the corners (and the plane)."""

    T_cam_marker: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    """of (dp, dr), metres and radians, along the camera's axes"""
    cost: float
    """half the squared residuals, in standard deviations"""


def model_corners(size_m: float) -> Float[np.ndarray, "4 3"]:
    """In the marker's frame, in OpenCV's order: left above, right above, right below, left below."""
    return np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * size_m / 2


def depth_plane(depth: RegisteredDepth, corners: Float[np.ndarray, "4 2"], scale: float) -> Plane | None:
    """The plane of the depth pixels on a tag and around it; None without enough of them, or where they are no plane.

    corners: colour pixels; scale: depth pixels per colour pixel. Noise: sigma = 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2
    (Nguyen, Izadi & Lovell 2012), smoothed over a few pixels, and a bias of 2 mm.
    """
    quad = (corners + 0.5) * scale - 0.5
    middle = quad.mean(axis=0)
    wide = middle + (quad - middle) * _AROUND
    size = (depth.camera.width, depth.camera.height)
    low = np.maximum(np.ceil(wide.min(axis=0)).astype(int), 0)
    high = np.minimum(np.floor(wide.max(axis=0)).astype(int) + 1, size)
    if (high <= low).any():
        return None
    v, u = (x.ravel() for x in np.mgrid[low[1] : high[1], low[0] : high[0]])
    pixels = np.column_stack([u, v]).astype(np.float64)
    z = depth.z[v, u].astype(np.float64)
    seen = (z > 0) & _inside(pixels, wide)
    pixels, z = pixels[seen], z[seen]
    on = _inside(pixels, quad)
    if on.sum() < _LEAST_PIXELS:
        return None
    rays = np.column_stack([depth.camera.normalized(pixels), np.ones(len(z))])
    sigma = (0.0012 + 0.0019 * (z - 0.4) ** 2) / z**2  # of 1/z
    return _fitted_plane(rays, 1 / z, sigma, on)


def _inside(points: Float[np.ndarray, "n 2"], quad: Float[np.ndarray, "4 2"]) -> np.ndarray:
    """Which points lie in a convex polygon; shape (n,), bool."""
    side = np.roll(quad, -1, axis=0) - quad
    offset = points[:, None] - quad
    cross = side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0]
    return np.asarray((cross >= 0).all(axis=1) | (cross <= 0).all(axis=1))


def _fitted_plane(rays: np.ndarray, inverse_z: np.ndarray, sigma: np.ndarray, on: np.ndarray) -> Plane | None:
    """Least squares on 1/z, reweighted by Tukey's function; first on the tag alone, then around it too."""
    w = np.where(on, 1.0, 0.0)
    deviation = np.abs(inverse_z - np.median(inverse_z[on]))
    w *= deviation < 0.1 * np.median(inverse_z[on]) + 5 * sigma  # holes' edges and what stands before the tag
    h = np.zeros(3)
    for step in range(8):
        weight = (w / sigma**2)[:, None]
        H = rays.T @ (weight * rays)
        if np.count_nonzero(w) < _LEAST_PIXELS or np.linalg.cond(H) > 1e12:
            return None
        h = np.linalg.solve(H, rays.T @ (weight[:, 0] * inverse_z))
        r = (inverse_z - rays @ h) / sigma
        reach = 4.0 * max(1.0, float(np.median(np.abs(r[on]))) / 0.6745)
        w = np.where(np.abs(r) < reach, (1 - (r / reach) ** 2) ** 2, 0.0)
        if step < 4:
            w = np.where(on, w, 0.0)
    if w[on].mean() < 0.4 or not h[2] > 0:
        return None
    H = rays.T @ ((w / sigma**2)[:, None] * rays)
    excess = max(1.0, float((w * r**2).sum() / w.sum()))
    covariance = np.linalg.inv(H) * excess * _CORRELATED_PX
    bias = _DEPTH_BIAS_M * float(np.mean(inverse_z[on])) * h
    return Plane(h, covariance + np.outer(bias, bias))


def solve_square(
    camera: Camera,
    corners: Float[np.ndarray, "4 2"],
    covariance: Float[np.ndarray, "8 8"],
    size_m: float,
    plane: Plane | None,
) -> list[Solution]:
    """Poses of a square, the likelier first: both minima of the reprojection error (infinitesimal plane-based pose
    estimation, Collins & Bartoli 2014), each refined jointly with the plane. Empty where a corner has no ray.

    covariance: of the corners, pixels^2.
    """
    xy = camera.normalized(corners)
    if not np.isfinite(xy).all():
        return []
    model = model_corners(size_m)
    found, rotations, places, *_ = cv2.solvePnPGeneric(
        model, xy[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    starts = [
        rigid(Rotation.from_rotvec(np.ravel(r)).as_matrix(), np.ravel(t))
        for r, t in zip(rotations, places, strict=True)
        if found and np.isfinite(r).all() and np.ravel(t)[2] > 0
    ]
    scale = np.tile([camera.fx, camera.fy], 4)
    whitener = np.linalg.inv(np.linalg.cholesky(covariance)) * scale
    return sorted((_refined(T, xy, whitener, model, plane) for T in starts), key=lambda s: s.cost)


def _refined(
    T: Float[np.ndarray, "4 4"],
    xy: Float[np.ndarray, "4 2"],
    by_corners: Float[np.ndarray, "8 8"],
    model: np.ndarray,
    plane: Plane | None,
) -> Solution:
    """Levenberg-Marquardt on corners and plane together."""
    by_plane = None if plane is None else np.linalg.inv(np.linalg.cholesky(plane.covariance))
    damping = 1e-6
    r, J = _linearised(T, xy, by_corners, model, plane, by_plane)
    for _ in range(_STEPS):
        H, g = J.T @ J, J.T @ r
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        trial = T.copy()
        trial[:3, 3] += step[:3]
        trial[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
        trial_r, trial_J = _linearised(trial, xy, by_corners, model, plane, by_plane)
        gain = float(r @ r - trial_r @ trial_r)
        if gain > 0:
            T, r, J, damping = trial, trial_r, trial_J, damping / 10
            if gain < 1e-6:
                break
        else:
            damping *= 100
    covariance = np.linalg.pinv(J.T @ J, hermitian=True)
    covariance[:3, :3] += np.outer(T[:3, 3], T[:3, 3]) * _SCALE**2
    return Solution(T, covariance, float(r @ r) / 2)


def _linearised(
    T: np.ndarray,
    xy: np.ndarray,
    by_corners: np.ndarray,
    model: np.ndarray,
    plane: Plane | None,
    by_plane: np.ndarray | None,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 6"]]:
    """Residuals in standard deviations (model - measured), and their derivatives by (dp, dr)."""
    arm = model @ T[:3, :3].T
    X = arm + T[:3, 3]
    z = np.maximum(X[:, 2], 1e-6)
    r = by_corners @ (X[:, :2] / z[:, None] - xy).ravel()
    by_point = np.zeros((4, 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
    by_point[:, :, 2] = -X[:, :2] / z[:, None] ** 2
    by_pose = np.concatenate([np.tile(np.eye(3), (4, 1, 1)), -np.stack([_cross(a) for a in arm])], axis=2)
    J = by_corners @ (by_point @ by_pose).reshape(8, 6)
    if plane is None or by_plane is None:
        return r, J
    n, p = T[:3, 2], T[:3, 3]
    d = float(n @ p)
    turned = -_cross(n)  # of n by dr
    by_d = np.concatenate([n, p @ turned])
    by_h = np.hstack([np.zeros((3, 3)), turned]) / d - np.outer(n, by_d) / d**2
    return np.concatenate([r, by_plane @ (n / d - plane.h)]), np.vstack([J, by_plane @ by_h])


def _cross(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0.0]])
