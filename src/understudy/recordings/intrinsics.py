"""Cameras from plain numbers, as a person types them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from understudy.camera import Camera
from understudy.errors import CameraError

Numbers = Sequence[float] | Sequence[Sequence[float]] | np.ndarray
"""A list of numbers, or rows of them."""

_MODELS = {0: "none", 4: "brown_conrady", 5: "brown_conrady", 8: "rational"}


def camera_from_numbers(width: int, height: int, K: Numbers, distortion: Numbers, where: str) -> Camera:
    """A camera from K as 4 numbers (fx fy cx cy, pixels) or 3x3, and 0, 4, 5 or 8 coefficients in OpenCV's order.

    `where` names the argument in errors. Raises CameraError.
    """
    try:
        k = np.asarray(K, dtype=np.float64)
        coefficients = np.asarray(distortion, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError, OverflowError) as e:
        raise CameraError(f"{where}: K and distortion must be numbers: {e}") from e
    if k.shape == (4,):
        fx, fy, cx, cy = k
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    elif k.shape != (3, 3):
        raise CameraError(f"{where}: K must be 4 numbers (fx fy cx cy) or 3x3, got shape {k.shape}")
    if len(coefficients) not in _MODELS:
        raise CameraError(
            f"{where}: distortion must have 0 (none), 4 (k1 k2 p1 p2), 5 (k1 k2 p1 p2 k3) or "
            f"8 (k1 k2 p1 p2 k3 k4 k5 k6) coefficients, got {len(coefficients)}"
        )
    model = _MODELS[len(coefficients)]
    if len(coefficients) == 4:
        coefficients.append(0.0)
    try:
        return Camera(width, height, k, model, tuple(coefficients))
    except CameraError as e:
        raise CameraError(f"{where}: {e}") from e
