"""Depth -> colour registration, 512x424 -> 960x540 on one core, against two other ways in the same run.

The alternatives: a sort by depth with plain assignment (far to near, so that the nearest stays), and OpenCV's
projectPoints with the same z-buffer. Neither drops background that shows through the gaps of a near surface.
"""

from __future__ import annotations

import cv2
import numpy as np
from common import milliseconds, report

from understudy.camera import Camera, RGBDCamera
from understudy.geometry import rigid
from understudy.registration import DepthRegistration

LENS = (0.33, -2.49, -1.6e-4, -1.3e-4, 1.45, 0.21, -2.3, 1.38)  # like an Azure Kinect's colour camera


def main() -> None:
    cv2.setNumThreads(1)
    depth = camera(512, 424, 365.5)
    T = rigid(np.eye(3), np.array([0.052, 0.0, 0.0]))
    z = scene(depth)
    rows = []
    for lens, color in (
        ("none", camera(960, 540, 540.7)),
        ("rational", Camera(960, 540, camera(960, 540, 540.7).K, "rational", LENS)),
    ):
        ours = DepthRegistration(RGBDCamera(color, depth, T))
        points = depth.unproject(grid(depth), 1.0).reshape(-1, 3)
        sort = milliseconds(lambda color=color, points=points: by_sorting(color, points, T, z))
        opencv = milliseconds(lambda color=color, points=points: by_opencv(color, points, T, z), repeat=10)
        own = milliseconds(lambda ours=ours: ours(z))
        rows.append([lens, f"{own:.1f}", f"{sort:.1f}", f"{opencv:.1f}", f"{sort / own:.1f}", f"{opencv / own:.1f}"])
    heads = ["colour lens", "ours ms", "sort ms", "projectPoints ms", "sort / ours", "projectPoints / ours"]
    report("registration", heads, rows, "512x424 -> 960x540, all depth pixels valid, one core, target <= 6 ms.")


def camera(width: int, height: int, f: float) -> Camera:
    return Camera(width, height, np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1.0]]))


def grid(c: Camera) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(c.width), np.arange(c.height)), -1).astype(np.float64)


def scene(c: Camera) -> np.ndarray:
    """A wall at 4 m and a bumpy thing at 2 m before it."""
    x, y = np.moveaxis(c.normalized(grid(c)), -1, 0)
    thing = (np.abs(x) < 0.2) & (np.abs(y) < 0.4)
    return np.where(thing, 2 + 0.1 * np.sin(9 * x) * np.cos(7 * y), 4.0).astype(np.float32)


def by_sorting(color: Camera, rays: np.ndarray, T: np.ndarray, z: np.ndarray) -> np.ndarray:
    p = rays * z.reshape(-1, 1) @ T[:3, :3].T + T[:3, 3]
    return assign(color, color.project(p), p[:, 2])


def by_opencv(color: Camera, rays: np.ndarray, T: np.ndarray, z: np.ndarray) -> np.ndarray:
    p = rays * z.reshape(-1, 1) @ T[:3, :3].T + T[:3, 3]
    uv, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), color.K, np.array(color.distortion or [0.0] * 4))
    return assign(color, uv[:, 0], p[:, 2])


def assign(color: Camera, uv: np.ndarray, z: np.ndarray) -> np.ndarray:
    inside = color.contains(uv) & (z > 0)
    uv, z = np.rint(uv[inside]).astype(np.int64), z[inside]
    far_to_near = np.argsort(-z)
    out = np.zeros((color.height, color.width), np.float32)
    out[uv[far_to_near, 1], uv[far_to_near, 0]] = z[far_to_near]
    return out


if __name__ == "__main__":
    main()
