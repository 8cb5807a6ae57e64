"""The pose of one square marker: corners to a few hundredths of a pixel, and the plane that the depth shows.

Marker frame: origin at its middle, x to its right, y up, z out of it, towards who looks at it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.spatial.transform import Rotation

from understudy.camera import Camera
from understudy.geometry import rigid
from understudy.types import RegisteredDepth

_CORNER_PX: Final = 0.02  # standard deviation of an aligned corner; measured on rendered tags (docs/objects.md)
_SHARP_PX: Final = 30.0  # height of a tag in the image, below which corners become worse: with its square, measured
_UNSETTLED_PX: Final = 0.3  # of one whose alignment still moved at the end
_ROUGH_PX: Final = 0.5  # of one that could not be aligned
_BLUR_PX: Final = 0.7  # standard deviation of a lens's blur, colour pixels
_SUBPIXELS: Final = 4  # along each side of a pixel, when a pattern is drawn
_ALIGNMENTS: Final = 16  # at most, each to a pattern drawn where the last one put it
_SETTLED_PX: Final = 0.01
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


def aligned_corners(
    gray: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], pattern: UInt8[np.ndarray, "cells cells"]
) -> tuple[Float[np.ndarray, "4 2"], float]:
    """Corners (pixels) from aligning the tag's whole pattern to the image, and their standard deviation.

    Enhanced correlation coefficient maximisation (Evangelidis & Psarakis 2008): all edges in the tag count, not four
    corners alone. Where it fails the corners come back as they were, with the standard deviation of rough ones.
    """
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
    low = np.maximum(np.floor(corners.min(axis=0) - side / 4).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(axis=0) + side / 4).astype(int) + 1, gray.shape[::-1])
    image = gray[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    middle = corners.mean(axis=0)
    around = middle + (corners - middle) * (1 + 1.0 / len(pattern)) - low  # half of the white border
    mask = cv2.fillConvexPoly(np.zeros(image.shape, np.uint8), around.round().astype(np.int32), 255)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-6)
    found, settled = corners - low, False
    try:
        for _ in range(_ALIGNMENTS):
            template = _as_seen(pattern, found, image.shape)
            identity = np.eye(3, dtype=np.float32)
            _, H = cv2.findTransformECC(template, image, identity, cv2.MOTION_HOMOGRAPHY, stop, mask, 1)
            before, found = found, cv2.perspectiveTransform(found[None], H.astype(np.float64))[0]
            settled = float(np.abs(found - before).max()) < _SETTLED_PX
            if settled:  # the image was compared as it is, not interpolated
                break
    except cv2.error:  # does not converge: blurred, covered, cut by the image's edge
        return corners, _ROUGH_PX
    found = found + low
    if not np.isfinite(found).all() or np.abs(found - corners).max() > max(2.0, 0.08 * side):
        return corners, _ROUGH_PX
    if not settled:
        return found, _UNSETTLED_PX
    height = float(cv2.contourArea(corners.astype(np.float32))) / side  # what a slanted tag shows of its other edge
    return found, _CORNER_PX * max(1.0, (_SHARP_PX / max(height, 1.0)) ** 2)


def _as_seen(
    pattern: UInt8[np.ndarray, "cells cells"], corners: Float[np.ndarray, "4 2"], shape: tuple[int, ...]
) -> Float32[np.ndarray, "h w"]:
    """The pattern with its white border as a camera sees it with its corners there: averaged over pixels, blurred."""
    cells, fine = len(pattern), _SUBPIXELS
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
    cell = max(2, round(fine * side / cells))
    sharp = np.kron(np.pad(pattern, 1, constant_values=255), np.ones((cell, cell), np.uint8))
    edge = np.array([cell, cell * (cells + 1)]) - 0.5
    square = np.array([[edge[0], edge[0]], [edge[1], edge[0]], [edge[1], edge[1]], [edge[0], edge[1]]])
    target = (corners + 0.5) * fine - 0.5
    H = cv2.getPerspectiveTransform(square.astype(np.float32), target.astype(np.float32))
    size = (shape[1] * fine, shape[0] * fine)
    seen = cv2.warpPerspective(sharp, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    small = cv2.resize(seen.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), _BLUR_PX))


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
    camera: Camera, corners: Float[np.ndarray, "4 2"], sigma_px: float, size_m: float, plane: Plane | None
) -> list[Solution]:
    """Poses of a square, the likelier first: both minima of the reprojection error (infinitesimal plane-based pose
    estimation, Collins & Bartoli 2014), each refined jointly with the plane. Empty where a corner has no ray.
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
    sigma = sigma_px / np.sqrt(camera.fx * camera.fy)
    return sorted((_refined(T, xy, sigma, model, plane) for T in starts), key=lambda s: s.cost)


def _refined(
    T: Float[np.ndarray, "4 4"], xy: Float[np.ndarray, "4 2"], sigma: float, model: np.ndarray, plane: Plane | None
) -> Solution:
    """Levenberg-Marquardt on corners and plane together."""
    whitener = None if plane is None else np.linalg.inv(np.linalg.cholesky(plane.covariance))
    damping = 1e-6
    r, J = _linearised(T, xy, sigma, model, plane, whitener)
    for _ in range(_STEPS):
        H, g = J.T @ J, J.T @ r
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        trial = T.copy()
        trial[:3, 3] += step[:3]
        trial[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ T[:3, :3]
        trial_r, trial_J = _linearised(trial, xy, sigma, model, plane, whitener)
        gain = float(r @ r - trial_r @ trial_r)
        if gain > 0:
            T, r, J, damping = trial, trial_r, trial_J, damping / 10
            if gain < 1e-6:
                break
        else:
            damping *= 100
    return Solution(T, np.linalg.pinv(J.T @ J, hermitian=True), float(r @ r) / 2)


def _linearised(
    T: np.ndarray, xy: np.ndarray, sigma: float, model: np.ndarray, plane: Plane | None, whitener: np.ndarray | None
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 6"]]:
    """Residuals in standard deviations (model - measured), and their derivatives by (dp, dr)."""
    arm = model @ T[:3, :3].T
    X = arm + T[:3, 3]
    z = np.maximum(X[:, 2], 1e-6)
    r = ((X[:, :2] / z[:, None] - xy) / sigma).ravel()
    by_point = np.zeros((4, 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / z
    by_point[:, :, 2] = -X[:, :2] / z[:, None] ** 2
    by_pose = np.concatenate([np.tile(np.eye(3), (4, 1, 1)), -np.stack([_cross(a) for a in arm])], axis=2)
    J = (by_point @ by_pose).reshape(8, 6) / sigma
    if plane is None or whitener is None:
        return r, J
    n, p = T[:3, 2], T[:3, 3]
    d = float(n @ p)
    turned = -_cross(n)  # of n by dr
    by_d = np.concatenate([n, p @ turned])
    by_h = np.hstack([np.zeros((3, 3)), turned]) / d - np.outer(n, by_d) / d**2
    return np.concatenate([r, whitener @ (n / d - plane.h)]), np.vstack([J, whitener @ by_h])


def _cross(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0.0]])
