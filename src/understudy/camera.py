"""Pinhole cameras with lens distortion, and the pair that an RGB-D sensor is (frames and pixels: CONVENTIONS.md).

The distortion formulas are OpenCV's (documentation of the calib3d module): with x = X/Z, y = Y/Z, r2 = x^2 + y^2,
x'' = x * radial + 2 p1 x y + p2 (r2 + 2 x^2) and y'' = y * radial + p1 (r2 + 2 y^2) + 2 p2 x y, where radial is
1 + k1 r2 + k2 r2^2 + k3 r2^3, divided by 1 + k4 r2 + k5 r2^2 + k6 r2^3 in the rational model.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from understudy.errors import CameraError, one_of
from understudy.geometry import is_rigid

DISTORTION_MODELS = {"none": 0, "brown_conrady": 5, "rational": 8}
"""Distortion model -> number of coefficients (OpenCV's order)."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with distortion."""

    width: int
    """pixels"""
    height: int
    """pixels"""
    K: Float[np.ndarray, "3 3"]
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels; pixel centres at integer coordinates"""
    distortion_model: str = "none"
    """none, brown_conrady (k1 k2 p1 p2 k3) or rational (k1 k2 p1 p2 k3 k4 k5 k6)"""
    distortion: tuple[float, ...] = field(default=())
    """coefficients in OpenCV's order"""

    def __post_init__(self) -> None:
        try:
            width, height = operator.index(self.width), operator.index(self.height)
            K = np.array(self.K, dtype=np.float64)  # a copy: the caller's array stays the caller's
            coefficients = tuple(float(c) for c in self.distortion)
        except (TypeError, ValueError) as e:
            raise CameraError(f"width and height must be whole numbers, K 3x3 and distortion numbers: {e}") from e
        if not (width > 0 and height > 0):
            raise CameraError(f"width and height must be positive, got {width} x {height}")
        if K.shape != (3, 3):
            raise CameraError(f"K must be a 3x3 matrix, got shape {K.shape}")
        if not np.isfinite(K).all():
            raise CameraError(f"K must hold numbers only, got {K.tolist()}")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise CameraError(f"K: focal lengths must be positive, got fx = {K[0, 0]:g}, fy = {K[1, 1]:g}")
        if not (K[[0, 1], [0, 1]].min() > 0.1 and np.abs(K).max() < 1e6):
            raise CameraError(f"K: focal lengths and centre must be in pixels (0.1 to 1e6), got {K[:2].tolist()}")
        if abs(K[0, 1]) > 1e-9 or np.abs(K[[1, 2, 2], [0, 0, 1]]).max() > 1e-9 or abs(K[2, 2] - 1) > 1e-9:
            raise CameraError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if not isinstance(self.distortion_model, str) or self.distortion_model not in DISTORTION_MODELS:
            raise CameraError(f"distortion_model {self.distortion_model!r}: must be {one_of(DISTORTION_MODELS)}")
        n = DISTORTION_MODELS[self.distortion_model]
        if len(coefficients) != n or not np.isfinite(coefficients).all():
            raise CameraError(
                f"distortion: {self.distortion_model} needs {n} finite coefficients, got {list(coefficients)}"
            )
        K.setflags(write=False)
        object.__setattr__(self, "width", width)
        object.__setattr__(self, "height", height)
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", coefficients)

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov: float) -> Camera:
        """An ideal camera with the given horizontal field of view (radians), centred."""
        f = width / 2 / np.tan(horizontal_fov / 2)
        return cls(width, height, np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1.0]]))

    @property
    def fx(self) -> float:
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        return float(self.K[1, 2])

    @property
    def distorted(self) -> bool:
        return any(self.distortion)

    # --- projection ---

    def project(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Points (metres, camera frame) -> pixels (u, v). NaN where z <= 0 or beyond the lens model's range."""
        z = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # z may be tiny
            xy = np.where((z > 0)[..., None], points[..., :2] / z[..., None], np.nan)
            return self.distort(xy) * (self.fx, self.fy) + (self.cx, self.cy)

    def unproject(self, uv: Float[np.ndarray, "*n 2"], z: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n 3"]:
        """Pixels (u, v) and their z (metres) -> points (metres, camera frame)."""
        xy = self.normalized(uv)
        depth = np.broadcast_to(np.asarray(z, dtype=np.float64), xy.shape[:-1])
        return np.concatenate([xy * depth[..., None], depth[..., None]], axis=-1)

    def normalized(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels -> undistorted (X/Z, Y/Z). NaN where no ray of the lens model meets the pixel."""
        return self.undistort((np.asarray(uv, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy))

    def contains(self, uv: Float[np.ndarray, "*n 2"]) -> np.ndarray:
        """Whether pixels lie inside the image; shape (*n), bool. NaN is outside."""
        u, v = uv[..., 0], uv[..., 1]
        return (u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5)

    # --- lens ---

    @cached_property
    def _k(self) -> tuple[float, ...]:
        """k1 k2 p1 p2 k3 k4 k5 k6, zeros for what the model has not. Python floats: float32 arrays stay float32."""
        return self.distortion + (0.0,) * (8 - len(self.distortion))

    @cached_property
    def max_radius(self) -> float:
        """Largest undistorted radius (X/Z) before the radial mapping folds back or has a pole; inf if never."""
        if not self.distorted:
            return float("inf")
        k1, k2, _, _, k3, k4, k5, k6 = self._k
        P = np.polynomial.Polynomial
        num, den = P([1, k1, k2, k3]), P([1, k4, k5, k6])  # in s = r^2
        # d/dr [r num(s) / den(s)] = 0   <=>   num den + 2 s (num' den - num den') = 0
        slope = num * den + P([0, 2]) * (num.deriv() * den - num * den.deriv())
        # Tiny leading coefficients put roots near infinity (r > 10) and overflow on the way there.
        roots = np.concatenate([slope.trim(1e-12).roots(), den.trim(1e-12).roots()])
        real = roots[np.abs(roots.imag) < 1e-9].real
        real = real[real > 1e-12]
        return float(np.sqrt(real.min())) if len(real) else float("inf")

    def distort(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Undistorted normalized coordinates -> distorted ones; NaN beyond `max_radius`."""
        if not self.distorted:
            return xy
        x, y = np.atleast_1d(xy[..., 0], xy[..., 1])  # a single point too
        return np.stack(self.distort_xy(x, y), axis=-1).reshape(xy.shape)

    def distort_xy(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`distort` on separate coordinates, in their own precision."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._k
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if self.distortion_model == "rational":
            radial /= 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        if np.isfinite(self.max_radius):
            radial = np.where(r2 <= self.max_radius**2, radial, radial.dtype.type(np.nan))
        xy2 = 2 * x * y
        return (
            x * radial + p1 * xy2 + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + p2 * xy2,
        )

    def undistort(self, xy: Float[np.ndarray, "*n 2"], iterations: int = 30) -> Float[np.ndarray, "*n 2"]:
        """Inverse of `distort`: damped Newton steps from a radial start; NaN where it has no solution within 1e-9."""
        if not self.distorted:
            return xy
        target = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        estimate = target * self._inverse_radial(np.linalg.norm(target, axis=-1))[..., None]
        residual = self.distort(estimate) - target
        for _ in range(iterations):
            if not (np.abs(residual) > 1e-13).any():  # NaN compares false: such rows are given up
                break
            step = _solve_2x2(self._distortion_jacobian(estimate), residual)
            candidate = estimate - step
            for _ in range(8):  # halve the steps that leave the model's range or do not help
                new = self.distort(candidate) - target
                worse = ~(np.abs(new).max(-1) <= np.abs(residual).max(-1))
                if not worse.any():
                    break
                step = np.where(worse[..., None], step / 2, step)
                candidate = estimate - step
            keep = (np.abs(new).max(-1) <= np.abs(residual).max(-1))[..., None]
            estimate, residual = np.where(keep, candidate, estimate), np.where(keep, new, residual)
        return np.where((np.abs(residual).max(-1) < 1e-9)[..., None], estimate, np.nan).reshape(xy.shape)

    def _inverse_radial(self, distorted_radius: np.ndarray) -> np.ndarray:
        """Undistorted over distorted radius from a table of the (monotone) radial part alone."""
        k1, k2, _, _, k3, k4, k5, k6 = self._k
        r = np.linspace(0, min(self.max_radius * 0.999, 5.0), 2048)
        s = r * r
        rd = r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        undistorted = np.interp(distorted_radius, rd, r)
        return np.divide(undistorted, distorted_radius, out=np.ones_like(undistorted), where=distorted_radius > 1e-9)

    def _distortion_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """d distort / d (x, y), shape (*n, 2, 2)."""
        x, y = xy[..., 0], xy[..., 1]
        k1, k2, p1, p2, k3, k4, k5, k6 = self._k
        s = x * x + y * y
        num, dnum = 1 + s * (k1 + s * (k2 + s * k3)), k1 + s * (2 * k2 + s * 3 * k3)
        den, dden = 1 + s * (k4 + s * (k5 + s * k6)), k4 + s * (2 * k5 + s * 3 * k6)
        radial, slope = num / den, 2 * (dnum * den - num * dden) / den**2  # slope: d radial / d x = slope * x
        mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
        return np.stack(
            [
                np.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, mixed], axis=-1),
                np.stack([mixed, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], axis=-1),
            ],
            axis=-2,
        )

    # --- images of other sizes ---

    def scale(self, factor: float) -> Camera:
        """The camera of an image resized by `factor` (the size is rounded)."""
        return self.resize(round(self.width * factor), round(self.height * factor))

    def resize(self, width: int, height: int) -> Camera:
        """The camera of an image resized to width x height."""
        sx, sy = width / self.width, height / self.height
        K = self.K.copy()
        K[0] = sx * self.fx, 0, (self.cx + 0.5) * sx - 0.5
        K[1] = 0, sy * self.fy, (self.cy + 0.5) * sy - 0.5
        return replace(self, width=width, height=height, K=K)

    def crop(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of the part of the image that starts at pixel (left, top)."""
        K = self.K.copy()
        K[:2, 2] -= left, top
        return replace(self, width=width, height=height, K=K)

    # --- files ---

    @classmethod
    def from_json(cls, data: Any, where: str) -> Camera:
        """Camera of a `recording.json` block. `where` names it in errors, e.g. 'recording.json: color'."""
        if not isinstance(data, dict):
            raise CameraError(f"{where}: must be an object")
        for key in ("width", "height", "K"):
            if key not in data:
                raise CameraError(f"{where}: field {key!r} is missing")
        for key in ("width", "height"):
            if not isinstance(data[key], int) or isinstance(data[key], bool):
                raise CameraError(f"{where}: {key} must be a whole number, got {data[key]!r}")
        coefficients = data.get("distortion") or []
        if not isinstance(coefficients, Sequence) or isinstance(coefficients, str):
            raise CameraError(f"{where}: distortion must be a list, got {coefficients!r}")
        try:
            K = np.array(data["K"], dtype=np.float64)
            return cls(data["width"], data["height"], K, data.get("distortion_model") or "none", tuple(coefficients))
        except (TypeError, ValueError) as e:
            raise CameraError(f"{where}: {e}") from e

    def to_json(self) -> dict[str, Any]:
        """The block of `recording.json` (without the depth camera's own fields)."""
        return {
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "distortion_model": self.distortion_model,
            "distortion": list(self.distortion),
        }


def _solve_2x2(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        det = A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0]
        x = (A[..., 1, 1] * b[..., 0] - A[..., 0, 1] * b[..., 1]) / det
        y = (A[..., 0, 0] * b[..., 1] - A[..., 1, 0] * b[..., 0]) / det
    return np.stack([x, y], axis=-1)


@dataclass(frozen=True, eq=False)
class RGBDCamera:
    """A colour camera, a depth camera, and where they are to each other."""

    color: Camera
    depth: Camera
    T_color_depth: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """takes points (metres) in the depth camera's frame to the colour camera's frame"""
    registered: bool = False
    """True: the depth image is already in the colour camera's pixels, up to a uniform scale"""

    def __post_init__(self) -> None:
        T = np.array(self.T_color_depth, dtype=np.float64)  # a copy
        if T.shape != (4, 4) or not is_rigid(T) or np.abs(T).max() > 1e3:
            raise CameraError(
                "T_color_depth must be a 4x4 rigid transform (orthonormal rotation, metres, last row 0 0 0 1)"
            )
        T.setflags(write=False)
        object.__setattr__(self, "T_color_depth", T)
        if self.registered:
            if self.color.distorted and not self.depth.distorted:  # its pixels are the colour camera's
                model, lens = self.color.distortion_model, self.color.distortion
                object.__setattr__(self, "depth", replace(self.depth, distortion_model=model, distortion=lens))
            check_registered(self.color, self.depth)
            if np.abs(T - np.eye(4)).max() > 1e-6:
                raise CameraError("T_color_depth must be the identity when depth.registered is true")

    def to_json(self) -> dict[str, Any]:
        """Both cameras and where they are to each other, as numbers."""
        return {
            "color": self.color.to_json(),
            "depth": {**self.depth.to_json(), "registered": self.registered},
            "T_color_depth": self.T_color_depth.tolist(),
        }

    @classmethod
    def aligned(cls, camera: Camera) -> RGBDCamera:
        """A sensor whose depth images come in the colour camera's pixels."""
        return cls(camera, camera, registered=True)


def check_registered(color: Camera, depth: Camera) -> None:
    """Raises CameraError unless `depth` is `color` resized by a uniform scale (0.5 %, one pixel)."""
    ideal = color.resize(depth.width, depth.height)
    ratio = (depth.width / color.width) / (depth.height / color.height)
    tolerance = np.array([0.005 * ideal.fx, 0.005 * ideal.fy, 1.0, 1.0])
    difference = np.abs([depth.fx - ideal.fx, depth.fy - ideal.fy, depth.cx - ideal.cx, depth.cy - ideal.cy])
    if abs(ratio - 1) > 0.01 or (difference > tolerance).any():
        raise CameraError(
            "depth.registered is true, so depth's K must be color's K scaled uniformly: expected about "
            f"fx {ideal.fx:.1f} fy {ideal.fy:.1f} cx {ideal.cx:.1f} cy {ideal.cy:.1f}, "
            f"got fx {depth.fx:.1f} fy {depth.fy:.1f} cx {depth.cx:.1f} cy {depth.cy:.1f}"
        )
    if np.abs(np.subtract(color._k, depth._k)).max() > 1e-6:
        raise CameraError(
            "depth.registered is true, so depth's distortion must be color's "
            f"({list(color.distortion)}) or none, got {list(depth.distortion)}"
        )
