"""Coloured points from a registered frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.spatial import cKDTree

from understudy.camera import Camera
from understudy.skeleton import BONES
from understudy.types import Person, RegisteredFrame

MAX_POINTS = 60_000
NEAR_PERSON_M = 0.3
"""points this near to a joint or to the middle of a bone count as the person's"""

FINEST_M = 0.008
_MAX_SAMPLES = 400_000


@dataclass(frozen=True, eq=False)
class Cloud:
    """Coloured points in the colour camera's frame."""

    points: Float32[np.ndarray, "n 3"]
    """metres"""
    colors: UInt8[np.ndarray, "n 3"]
    """RGB"""
    spacing_m: float
    """distance between neighbours on a surface"""

    def __len__(self) -> int:
        return len(self.points)


def make_cloud(frame: RegisteredFrame, max_points: int = MAX_POINTS) -> Cloud:
    """The measured points, thinned to at most `max_points` of even density."""
    depth = frame.depth
    v, u = np.nonzero(depth.z > 0)
    step = max(1, len(u) // _MAX_SAMPLES)
    v, u = v[::step], u[::step]
    points = _rays(depth.camera)[v, u] * depth.z[v, u][:, None]
    known = np.isfinite(points).all(axis=1)
    points, u, v = points[known], u[known], v[known]
    chosen, spacing = thin(points, max_points)
    scale = depth.scale_to(frame.camera)
    height, width = frame.color.shape[:2]
    cu = np.clip(np.rint((u[chosen] + 0.5) / scale - 0.5).astype(int), 0, width - 1)
    cv = np.clip(np.rint((v[chosen] + 0.5) / scale - 0.5).astype(int), 0, height - 1)
    return Cloud(points[chosen], frame.color[cv, cu], spacing)


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> Float32[np.ndarray, "h w 3"]:
    """(X/Z, Y/Z, 1) of each pixel."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    xy = camera.normalized(np.stack([u, v], axis=-1))
    return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1).astype(np.float32)


def thin(
    points: Float32[np.ndarray, "n 3"], max_points: int | None = None, cell: float = FINEST_M
) -> tuple[np.ndarray, float]:
    """Rows of the first point in each cell of a grid, and how wide its cells are.

    They are `cell` metres wide, or as much wider as `max_points` asks.
    """
    while True:
        cells = np.floor(points / cell).astype(np.int64)
        cells -= cells.min(axis=0, initial=0)
        key = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
        rows = np.unique(key, return_index=True)[1]
        if max_points is None or len(rows) <= max_points:
            return rows, cell
        cell *= max(1.1, (len(rows) / max_points) ** 0.5)  # surfaces: points go with the square of the cell


def near_people(points: Float32[np.ndarray, "n 3"], people: Sequence[Person]) -> Bool[np.ndarray, " n"]:
    """Which points belong to people: within `NEAR_PERSON_M` of their bodies."""
    centres = []
    for person in people:
        ends = person.keypoints[np.array(BONES)]  # 18 bones x 2 ends x 3
        centres += [person.keypoints, *(ends[:, 0] * (1 - s) + ends[:, 1] * s for s in (0.25, 0.5, 0.75))]
    body = np.concatenate(centres) if centres else np.zeros((0, 3))
    body = body[np.isfinite(body).all(axis=1)]
    if not len(body) or not len(points):
        return np.zeros(len(points), dtype=bool)
    return np.isfinite(cKDTree(body).query(points, distance_upper_bound=NEAR_PERSON_M)[0])


def smaller(image: UInt8[np.ndarray, "h w 3"], max_width: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The image, at most `max_width` wide."""
    h, w = image.shape[:2]
    if w <= max_width:
        return image
    return cv2.resize(image, (max_width, max(1, round(h * max_width / w))), interpolation=cv2.INTER_AREA)
