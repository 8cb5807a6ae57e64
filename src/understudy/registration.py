"""Depth -> colour registration: depth pixels become points, are moved to the colour camera, and z-buffered there.

What the colour camera cannot see must not show through. Seen from a second viewpoint a near surface is a net of
samples with gaps, and samples of what lies behind it fall into the gaps. A closing of the z-buffer (a dilation, then
an erosion, of nearness) bridges the gaps inside a surface but does not widen its outline; samples clearly behind the
bridged surface are dropped. No value is made up: each value in the result is the z of one measured point, in the
pixel that it projects to, and pixels that no point meets stay 0.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float32

from understudy.camera import RGBDCamera
from understudy.types import Frame, RegisteredDepth, RegisteredFrame

HIDDEN_MARGIN = 0.03
"""a sample is hidden when it lies this share of its distance (plus 2 cm) behind the bridged surface"""

_FAR = np.float32(1e9)
_BLOCK = 32768  # samples at a time: temporaries stay in the cache


class DepthRegistration:
    """Registers depth images of one pair of cameras; rays are computed once."""

    def __init__(self, camera: RGBDCamera):
        self.camera = camera
        depth = camera.depth
        u, v = np.meshgrid(np.arange(depth.width, dtype=np.float64), np.arange(depth.height, dtype=np.float64))
        xy = depth.normalized(np.stack([u, v], axis=-1).reshape(-1, 2))
        R, t = camera.T_color_depth[:3, :3], camera.T_color_depth[:3, 3]
        rays = np.column_stack([xy, np.ones(len(xy))]) @ R.T
        self._rays = np.ascontiguousarray(rays.T, dtype=np.float32)  # NaN where the lens model has no ray
        self._t = t.tolist()
        # colour pixels between neighbouring depth samples
        spacing = max(camera.color.fx / depth.fx, camera.color.fy / depth.fy)
        size = int(np.ceil(spacing)) + 1
        self._bridge = np.ones((size, size), np.uint8)
        n = self._rays.shape[1]
        self._blocks = [slice(i, i + _BLOCK) for i in range(0, n, _BLOCK)]

    def __call__(self, depth: Float32[np.ndarray, "hd wd"]) -> Float32[np.ndarray, "h w"]:
        """Depth (metres, depth camera) -> z (metres, colour camera) in the colour image; 0 = no measurement."""
        color, d = self.camera.color, depth.ravel()
        nearest = np.full(color.height * color.width + 1, _FAR, np.float32)  # the last cell takes what is outside
        for block in self._blocks:
            z, pixel = self._project(d[block], self._rays[:, block])
            np.minimum.at(nearest, pixel, z)
        return self._without_hidden(nearest[:-1].reshape(color.height, color.width))

    def _project(self, d: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """z in the colour camera and flat pixel index of each sample. Float32, in place: the hot path."""
        color, (tx, ty, tz) = self.camera.color, self._t
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            z = rays[2] * d
            z += tz
            x = rays[0] * d
            x += tx
            x /= z
            y = rays[1] * d
            y += ty
            y /= z
            if color.distorted:
                x, y = color.distort_xy(x, y)
            x *= color.fx
            x += color.cx + 0.5  # +0.5 and truncation = nearest pixel
            y *= color.fy
            y += color.cy + 0.5
            # NaN fails the comparisons, as does what is outside
            inside = (d > 0) & (z > 0) & (x >= 0) & (y >= 0) & (x < color.width) & (y < color.height)
            pixel = y.astype(np.int32)
            pixel *= color.width
            pixel += x.astype(np.int32)
        pixel[~inside] = color.height * color.width
        return z, pixel.astype(np.int64)

    def _without_hidden(self, nearest: np.ndarray) -> np.ndarray:
        """Zero where nothing was measured, and where what was measured lies behind the bridged surface."""
        # Erode then dilate distance = dilate then erode nearness. Opposite anchors: with cv2.morphologyEx a bridge of
        # even size would shift the surface by a pixel.
        end = len(self._bridge) - 1
        bridged = cv2.dilate(cv2.erode(nearest, self._bridge, anchor=(0, 0)), self._bridge, anchor=(end, end))
        limit = bridged * np.float32(1 + HIDDEN_MARGIN) + np.float32(0.02)
        nearest[(nearest > limit) | (nearest == _FAR)] = 0
        return nearest


@lru_cache(maxsize=8)
def _registration(camera: RGBDCamera) -> DepthRegistration:
    return DepthRegistration(camera)


def register(frame: Frame) -> RegisteredFrame:
    """The frame with its depth in the colour camera's frame and pixels. Registered depth passes through."""
    if frame.camera.registered:
        depth = RegisteredDepth(frame.depth, frame.camera.depth)
    else:
        depth = RegisteredDepth(_registration(frame.camera)(frame.depth), frame.camera.color)
    return RegisteredFrame(frame.color, frame.camera.color, depth, frame.index, frame.timestamp_s)
