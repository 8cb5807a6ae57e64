"""A marker's corners, to a few hundredths of a pixel, by fitting the whole pattern to the image.

Where the corners are, how light black and white are, and how blurred the picture is (by a lens out of focus, or by a
hand that moves) are found together, by least squares on all pixels of the marker.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

_SUBPIXELS: Final = 4  # along each side of a pixel, when a pattern is drawn
_STEPS: Final = 12  # at most, of Gauss and Newton
_STRIDE_PX: Final = 1.5  # at most, of a step
_FARTHEST: Final = 0.15  # of the side, that a corner may move from where it was found: less is an error of the finder
_FARTHEST_PX: Final = 2.0  # the same, at least
_SETTLED_PX: Final = 0.02
_BLUR_PX: Final = 0.6  # standard deviation at the start
_BLURS_PX: Final = (0.3, 4.0)  # that are believed
_LEAST_PIXELS: Final = 30
_LEAST_CLEAR: Final = 0.6  # of the pattern's pixels
_COVERED: Final = 0.25  # of the contrast: pixels that are off by more show something else
_LEAST_LIKE: Final = 0.85  # correlation of pattern and image, below which it is not taken
_ROUGH_PX: Final = 0.5  # standard deviation of corners that could not be fitted
_UNMODELLED_PX: Final = 0.015  # of every corner: lens, compression, how a pixel adds up its light
_CORRELATED: Final = 2.0  # pixels that share one error: compressed pictures


@dataclass(frozen=True, eq=False)
class Corners:
    """Of one marker in one image."""

    uv: Float[np.ndarray, "4 2"]
    """pixels: left above, right above, right below, left below"""
    covariance: Float[np.ndarray, "8 8"]
    """of u, v of the first, then of the second ..."""
    blur: Float[np.ndarray, "2 2"] | None
    """covariance of the blur in the image, pixels^2; None where the pattern could not be fitted"""


@dataclass(frozen=True, eq=False)
class _Fit:
    corners: Float[np.ndarray, "4 2"]
    blur: Float[np.ndarray, "3"]
    """xx, xy, yy"""


def fit_corners(
    gray: UInt8[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], pattern: UInt8[np.ndarray, "cells cells"]
) -> Corners:
    """Corners (pixels) that are roughly known, refined. Where that fails they come back as they were, as rough ones.

    pattern: black and white, a pixel per cell, with the black border; the marker has a white rim of one cell at least.
    Pixels that show something else (a thumb) are left out. The covariance follows from what is left of the residuals.
    """
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
    low = np.maximum(np.floor(corners.min(axis=0) - side / 4 - 2).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(axis=0) + side / 4 + 3).astype(int), gray.shape[::-1])
    image = gray[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    found = _fitted(image, corners - low, pattern, most=max(_FARTHEST_PX, _FARTHEST * side))
    if found is None:
        return Corners(corners, _ROUGH_PX**2 * np.eye(8), None)
    fit, covariance = found
    xx, xy, yy = fit.blur
    return Corners(fit.corners + low, covariance, np.array([[xx, xy], [xy, yy]]))


def _fitted(
    image: Float[np.ndarray, "h w"], corners: Float[np.ndarray, "4 2"], pattern: np.ndarray, most: float
) -> tuple[_Fit, Float[np.ndarray, "8 8"]] | None:
    """By Gauss and Newton's method; None where it fails, or leads further than `most` pixels away."""
    fit = _Fit(corners, np.array([1.0, 0, 1.0]) * _BLUR_PX**2)
    clear: np.ndarray | None = None
    for _ in range(_STEPS):
        on = _inside(fit.corners, len(pattern), image.shape)
        least = max(_LEAST_PIXELS, _LEAST_CLEAR * on.sum())
        if clear is not None:
            on &= clear
        if on.sum() < least:
            return None
        J, like, r = _linearised(image[on], _drawn(pattern, fit, image.shape), on, fit)
        spread = np.linalg.pinv(J.T @ J, hermitian=True)
        step = spread @ (J.T @ r)
        moved = np.clip(step[:8].reshape(4, 2), -_STRIDE_PX, _STRIDE_PX)
        fit = _Fit(fit.corners + moved, _believable(fit.blur + step[8:11]))
        if not np.isfinite(fit.corners).all() or np.abs(fit.corners - corners).max() > most:
            return None
        last = float(np.abs(moved).max())
        if last < _SETTLED_PX:
            if clear is not None:
                break
            clear = _clear(r, on, float(np.ptp(image[on])))
            if clear.all():
                break
    if like < _LEAST_LIKE:
        return None
    left = r - J @ step
    covariance = spread[:8, :8] * (left @ left) / max(len(left) - J.shape[1], 1) * _CORRELATED
    doubt = _UNMODELLED_PX**2 + (0.0 if last < _SETTLED_PX else last**2)
    return fit, covariance + doubt * np.eye(8)


def _inside(corners: Float[np.ndarray, "4 2"], cells: int, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """Pixels on the marker and on half of its white rim."""
    middle = corners.mean(axis=0)
    around = middle + (corners - middle) * (1 + 1.0 / cells)
    return cv2.fillConvexPoly(np.zeros(shape, np.uint8), around.round().astype(np.int32), 1).astype(bool)


def _clear(r: Float[np.ndarray, " n"], on: Bool[np.ndarray, "h w"], contrast: float) -> Bool[np.ndarray, "h w"]:
    """Where the picture is not quite another than the pattern, nor beside such pixels."""
    covered = np.zeros(on.shape, np.uint8)
    covered[on] = np.abs(r) > _COVERED * contrast
    return cv2.dilate(covered, np.ones((3, 3), np.uint8)) == 0


def _drawn(pattern: UInt8[np.ndarray, "cells cells"], fit: _Fit, shape: tuple[int, ...]) -> Float32[np.ndarray, "h w"]:
    """The pattern with its white rim as a camera sees it, 0 to 1: averaged over pixels, blurred."""
    cells, fine = len(pattern), _SUBPIXELS
    side = float(np.linalg.norm(fit.corners - np.roll(fit.corners, 1, axis=0), axis=1).max())
    cell = max(2, round(fine * side / cells))
    sharp = np.kron(np.pad(pattern, 1, constant_values=255), np.ones((cell, cell), np.uint8))
    a, b = np.array([cell, cell * (cells + 1)]) - 0.5
    square = np.array([[a, a], [b, a], [b, b], [a, b]], np.float32)
    H = cv2.getPerspectiveTransform(square, ((fit.corners + 0.5) * fine - 0.5).astype(np.float32))
    size = (shape[1] * fine, shape[0] * fine)
    seen = cv2.warpPerspective(sharp, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    small = cv2.resize(seen.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA) / 255
    return np.asarray(cv2.filter2D(small, -1, _kernel(fit.blur), borderType=cv2.BORDER_REPLICATE))


def _kernel(blur: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k k"]:
    reach = int(np.ceil(3.5 * np.sqrt(max(blur[0], blur[2]))))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    xx, xy, yy = blur
    kernel = np.exp(-0.5 * (yy * u**2 - 2 * xy * u * v + xx * v**2) / (xx * yy - xy**2))
    return np.asarray(kernel / kernel.sum())


def _believable(blur: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    values, axes = np.linalg.eigh(np.array([[blur[0], blur[1]], [blur[1], blur[2]]]))
    B = axes @ np.diag(np.clip(values, _BLURS_PX[0] ** 2, _BLURS_PX[1] ** 2)) @ axes.T
    return np.array([B[0, 0], B[0, 1], B[1, 1]])


def _linearised(
    seen: Float[np.ndarray, " n"], drawn: Float32[np.ndarray, "h w"], on: Bool[np.ndarray, "h w"], fit: _Fit
) -> tuple[Float[np.ndarray, "n 13"], float, Float[np.ndarray, " n"]]:
    """Derivatives of the drawn pixels by corners, blur and brightness; correlation with the image; residuals."""
    T = drawn.astype(np.float64)
    Ty, Tx = np.gradient(T, axis=0), np.gradient(T, axis=1)
    Txy, Txx = np.gradient(Tx, axis=0), np.gradient(Tx, axis=1)
    Tyy = np.gradient(Ty, axis=0)
    t = T[on]
    A = np.column_stack([t, np.ones(len(t))])
    gain, offset = np.linalg.solve(A.T @ A + 1e-9 * np.eye(2), A.T @ seen)
    v, u = np.nonzero(on)
    along, down = _displacements(np.column_stack([u, v]).astype(np.float64), fit.corners)
    by_corner = -gain * (Tx[on][:, None] * along + Ty[on][:, None] * down)
    by_blur = gain / 2 * np.column_stack([Txx[on], 2 * Txy[on], Tyy[on]])
    like = float(np.corrcoef(t, seen)[0, 1]) if t.std() > 0 and seen.std() > 0 else 0.0
    return np.column_stack([by_corner, by_blur, A]), like, seen - gain * t - offset


def _displacements(
    uv: Float[np.ndarray, "n 2"], corners: Float[np.ndarray, "4 2"]
) -> tuple[Float[np.ndarray, "n 8"], Float[np.ndarray, "n 8"]]:
    """How the image of the pattern moves along u and along v at pixels, per pixel that one of the corners' coordinates
    moves: the infinitesimal homographies that move one corner and keep the others.
    """
    middle, scale = corners.mean(axis=0), float(np.ptp(corners))
    at_corners = np.stack(_fields((corners - middle) / scale), axis=1).reshape(8, 8)
    combined = np.linalg.inv(at_corners)
    along, down = _fields((uv - middle) / scale)
    return along @ combined, down @ combined


def _fields(uv: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 8"], Float[np.ndarray, "n 8"]]:
    """A basis of the infinitesimal homographies, as displacements along u and along v."""
    u, v = uv.T
    one, zero = np.ones(len(uv)), np.zeros(len(uv))
    along = np.stack([one, u, v, zero, zero, zero, u * u, u * v], axis=1)
    down = np.stack([zero, zero, zero, one, u, v, u * v, v * v], axis=1)
    return along, down
