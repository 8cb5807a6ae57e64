"""BlazePose's two networks: images in, decoded numbers out. Knows nothing of people, windows or depth.

The networks are MediaPipe's (Bazarevsky et al., "BlazePose: On-device Real-time Body Pose tracking", 2020). The
decoding follows the graph files published with them: SSD anchors on strides 8, 16, 32, 32, 32, weighted
non-maximum suppression, a rotated square region from two keypoints, heatmap refinement of the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from understudy.runtime import load

DETECTOR_SIZE, LANDMARK_SIZE, HEATMAP_SIZE = 224, 256, 64
N_LANDMARKS = 33
_AUXILIARY = (33, 34)  # landmarks that give the next region: its centre, and a point that sets its size and direction
_REGION_SCALE = 1.25
# left and right exchanged: eyes (inner, middle, outer), ears, mouth corners, then pairs from shoulders to toes
_MIRROR = [0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9] + [i + 1 if i % 2 else i - 1 for i in range(11, N_LANDMARKS)]


@dataclass(frozen=True)
class Region:
    """A rotated square in the image."""

    center: tuple[float, float]
    """pixels"""
    size: float
    """side, pixels"""
    angle: float
    """radians, clockwise in the image: the direction 'up in the crop' is (sin, -cos) of it"""

    @classmethod
    def from_points(cls, center: np.ndarray, rim: np.ndarray) -> Region:
        """The region around `center` whose circle passes through `rim`, with `rim` above the centre in the crop."""
        dx, dy = (rim - center).tolist()
        return cls(
            (float(center[0]), float(center[1])),
            2 * float(np.hypot(dx, dy)) * _REGION_SCALE,
            float(np.arctan2(dx, -dy)),
        )

    def to_image(self, size: int) -> Float[np.ndarray, "2 3"]:
        """Affine map from pixels of the size x size crop to image pixels (pixel centres at integers on both sides)."""
        s = self.size / size
        c, n = np.cos(self.angle) * s, np.sin(self.angle) * s
        A = np.array([[c, -n], [n, c]])
        middle = np.array([(size - 1) / 2, (size - 1) / 2])
        return np.column_stack([A, np.array(self.center) - A @ middle])

    def crop(self, image: np.ndarray, size: int, fill: Any = 0) -> np.ndarray:
        """The region, resized to size x size."""
        return cv2.warpAffine(
            image,
            self.to_image(size),
            (size, size),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=fill,
        )


@dataclass(frozen=True)
class Landmarks:
    """What the landmark network says of one region, in image pixels."""

    uv: Float[np.ndarray, "33 2"]
    visibility: Float[np.ndarray, "33"]
    """probability of being in the image and not hidden"""
    presence: Float[np.ndarray, "33"]
    """probability of being in the image"""
    score: float
    """probability that the region holds a person"""
    next_region: Region
    """a better region, from the landmarks"""


def _anchors() -> Float[np.ndarray, "2254 2"]:
    """Centres of the SSD anchors, in [0, 1]; 2 a cell at strides 8 and 16, 6 a cell at stride 32."""
    grids = []
    for stride, per_cell in ((8, 2), (16, 2), (32, 6)):
        n = DETECTOR_SIZE // stride
        y, x = np.mgrid[:n, :n]
        grids.append(np.repeat((np.stack([x, y], -1).reshape(-1, 2) + 0.5) / n, per_cell, axis=0))
    return np.concatenate(grids)


_ANCHORS = _anchors()


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(x, -60, 60)))


class BlazePoseNets:
    """Runs the networks. Calls from several threads are computed at the same time, one a thread."""

    def __init__(self, detector: Path, landmarks: Path, threads: int = 2):
        # one crop a thread: as fast as batches, or as all threads on one crop, and faster where other programs run
        self._detector = load(detector, threads=threads, streams=threads, outputs=("Identity", "Identity_1"))
        wanted = ("Identity", "Identity_1", "Identity_3")  # not: a mask of the person, positions in metres
        self._landmarker = load(landmarks, threads=threads, streams=threads, outputs=wanted)

    def detect(self, crop: UInt8[np.ndarray, "224 224 3"]) -> Float[np.ndarray, "n 9"]:
        """Person candidates in a crop: rows (score, then x, y of mid hip, hip circle, mid shoulder, upper circle).

        Coordinates are pixels of the crop.
        """
        boxes, logits = self._detector(crop[None].astype(np.float32) / 127.5 - 1)
        score = sigmoid(logits[0, :, 0])
        keep = np.flatnonzero(score > 0.5)
        raw, anchors = boxes[0, keep].astype(np.float64) / DETECTOR_SIZE, _ANCHORS[keep]
        center, size = raw[:, 0:2] + anchors, raw[:, 2:4]
        corners = np.concatenate([center - size / 2, center + size / 2], axis=1)
        keypoints = raw[:, 4:12].reshape(-1, 4, 2) + anchors[:, None]
        return weighted_suppression(score[keep], corners, keypoints * DETECTOR_SIZE - 0.5)

    def landmarks(self, crop: UInt8[np.ndarray, "256 256 3"], region: Region, mirrored: bool = False) -> Landmarks:
        """Landmarks of the person in a crop, in image pixels.

        region: the part of the image that the crop shows. mirrored: let the network look at the mirror image; the
        result is mirrored back and left and right exchanged, so that it compares with a plain one.
        """
        image = crop[:, ::-1] if mirrored else crop
        raw, score, heatmaps = self._landmarker(image[None].astype(np.float32) / 255)
        rows = raw.reshape(-1, 5).astype(np.float64)
        xy = _refine(rows[:, :2] / LANDMARK_SIZE, heatmaps[0])
        if mirrored:
            xy[:, 0] = 1 - xy[:, 0]
            xy[:N_LANDMARKS], rows[:N_LANDMARKS] = xy[_MIRROR], rows[_MIRROR]
        A = region.to_image(LANDMARK_SIZE)
        uv = (xy * LANDMARK_SIZE - 0.5) @ A[:, :2].T + A[:, 2]
        return Landmarks(
            uv=uv[:N_LANDMARKS],
            visibility=sigmoid(rows[:N_LANDMARKS, 3]),
            presence=sigmoid(rows[:N_LANDMARKS, 4]),
            score=float(score[0, 0]),
            next_region=Region.from_points(uv[_AUXILIARY[0]], uv[_AUXILIARY[1]]),
        )


def weighted_suppression(score: np.ndarray, corners: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Merges boxes that overlap (IoU > 0.3) into the score-weighted mean of their keypoints, best first."""
    area = np.prod(np.clip(corners[:, 2:] - corners[:, :2], 0, None), axis=1)
    left, out = np.argsort(-score), []
    while len(left):
        best = left[0]
        low, high = np.maximum(corners[best, :2], corners[left, :2]), np.minimum(corners[best, 2:], corners[left, 2:])
        inter = np.prod(np.clip(high - low, 0, None), axis=1)
        same = inter > 0.3 * np.maximum(area[best] + area[left] - inter, 1e-12)
        same[0] = True
        group = left[same]
        merged = np.average(keypoints[group], axis=0, weights=score[group])
        out.append(np.concatenate([[score[best]], merged.ravel()]))
        left = left[~same]
    return np.array(out).reshape(-1, 1 + 2 * keypoints.shape[1])


def _refine(xy: Float[np.ndarray, "39 2"], heatmaps: Float32[np.ndarray, "64 64 39"]) -> Float[np.ndarray, "39 2"]:
    """Moves each landmark ([0, 1]) to the centre of its 7x7 heatmap neighbourhood, where that is confident."""
    n, half = len(xy), 3
    cell = np.floor(xy * HEATMAP_SIZE).astype(int)  # column, row
    offsets = np.arange(-half, half + 1)
    rows, cols = cell[:, 1, None] + offsets, cell[:, 0, None] + offsets
    inside_r, inside_c = (rows >= 0) & (rows < HEATMAP_SIZE), (cols >= 0) & (cols < HEATMAP_SIZE)
    rows, cols = rows.clip(0, HEATMAP_SIZE - 1), cols.clip(0, HEATMAP_SIZE - 1)
    patch = sigmoid(heatmaps[rows[:, :, None], cols[:, None, :], np.arange(n)[:, None, None]])
    patch = patch * inside_r[:, :, None] * inside_c[:, None, :]
    total = patch.sum((1, 2))
    confident = (patch.max((1, 2)) >= 0.5) & ((cell >= 0) & (cell < HEATMAP_SIZE)).all(1)
    safe = np.where(confident, total, 1.0)
    x = (patch * cols[:, None, :]).sum((1, 2)) / safe / HEATMAP_SIZE
    y = (patch * rows[:, :, None]).sum((1, 2)) / safe / HEATMAP_SIZE
    return np.where(confident[:, None], np.column_stack([x, y]), xy)
