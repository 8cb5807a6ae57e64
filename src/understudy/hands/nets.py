"""MediaPipe's two hand networks: images in, decoded numbers out. Knows nothing of bodies or depth.

The networks are those of Zhang et al., "MediaPipe Hands: On-device Real-time Hand Tracking", 2020. The decoding follows
the graph files published with them: SSD anchors on strides 8, 16, 16, 16, weighted non-maximum suppression, a rotated
square region around a palm, 21 landmarks in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

from understudy.assets import model_path
from understudy.detectors.blazepose_nets import Region, sigmoid, weighted_suppression
from understudy.runtime import load

PALM_SIZE, HAND_SIZE = 192, 224
N_LANDMARKS: Final = 21
WRIST, INDEX, MIDDLE, PINKY = 0, 5, 9, 17
"""Landmarks: the wrist and three knuckles (MCP)"""
PALM_WRIST: Final = slice(5, 7)
"""Where a row of `HandNets.palms` has the wrist"""
_Z_UNIT = 2.5  # crop pixels a unit of the network's z


@dataclass(frozen=True, eq=False)
class HandLandmarks:
    """What the landmark network says of one region."""

    uv: Float[np.ndarray, "21 2"]
    """image pixels"""
    z: Float[np.ndarray, "21"]
    """image pixels away from the camera, relative to the wrist (weak perspective)"""
    world: Float[np.ndarray, "21 3"]
    """metres from the hand's centre; x right, y down in the image, z along the view of the hand"""
    presence: float
    """probability that the region holds a hand"""
    right: float
    """probability that it is a right hand"""


def _anchors() -> Float[np.ndarray, "2016 2"]:
    """Centres of the SSD anchors, in [0, 1]; 2 a cell at stride 8, 6 a cell at stride 16."""
    grids = []
    for stride, per_cell in ((8, 2), (16, 6)):
        n = PALM_SIZE // stride
        y, x = np.mgrid[:n, :n]
        grids.append(np.repeat((np.stack([x, y], -1).reshape(-1, 2) + 0.5) / n, per_cell, axis=0))
    return np.concatenate(grids)


_ANCHORS = _anchors()


def palm_region(palm: Float[np.ndarray, "19"], to_image: Float[np.ndarray, "2 3"]) -> Region:
    """The hand's region (image) for a row of `HandNets.palms`: fingers upwards, 2.6 times the palm.

    to_image: affine map from the crop in which the palm was found.
    """
    points = palm[1:].reshape(9, 2) @ to_image[:, :2].T + to_image[:, 2]
    scale = float(np.sqrt(abs(np.linalg.det(to_image[:, :2]))))
    side = scale * float(np.abs(palm[3:5] - palm[1:3]).max())
    (x, y), (dx, dy) = points[:2].mean(0), points[4] - points[2]  # wrist -> middle knuckle
    angle = float(np.arctan2(dx, -dy))
    return Region((float(x + 0.5 * side * np.sin(angle)), float(y - 0.5 * side * np.cos(angle))), 2.6 * side, angle)


class HandNets:
    """Runs the networks, several crops at a time."""

    def __init__(self, palms: Path, landmarks: Path, threads: int = 2):
        self._detector = load(palms, threads=threads, streams=threads, outputs=("Identity", "Identity_1"))
        wanted = ("Identity", "Identity_1", "Identity_2", "Identity_3")
        self._landmarker = load(landmarks, threads=threads, streams=threads, outputs=wanted)
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="hands")

    def palms(self, crops: Sequence[UInt8[np.ndarray, "192 192 3"]]) -> list[Float[np.ndarray, "n 19"]]:
        """Palms in each crop, best first: rows (score, then x, y of two corners of the box around the palm, wrist,
        knuckles of index, middle, ring and little finger, two joints of the thumb).

        Coordinates are pixels of the crop.
        """
        return list(self._pool.map(self._palms, crops))

    def _palms(self, crop: np.ndarray) -> np.ndarray:
        boxes, logits = self._detector(crop[None].astype(np.float32) / 255)
        score = sigmoid(logits[0, :, 0])
        keep = np.flatnonzero(score > 0.5)
        raw, anchors = boxes[0, keep].astype(np.float64) / PALM_SIZE, _ANCHORS[keep]
        center, size = raw[:, 0:2] + anchors, raw[:, 2:4]
        corners = np.concatenate([center - size / 2, center + size / 2], axis=1)
        keypoints = raw[:, 4:].reshape(-1, 7, 2) + anchors[:, None]
        points = np.concatenate([corners.reshape(-1, 2, 2), keypoints], axis=1)
        return weighted_suppression(score[keep], corners, points * PALM_SIZE - 0.5)

    def landmarks(
        self,
        crops: Sequence[UInt8[np.ndarray, "224 224 3"]],
        regions: Sequence[Region],
        mirrored: Sequence[bool] | bool = False,
    ) -> list[HandLandmarks]:
        """Landmarks of the hand in each crop.

        regions: the part of the image that each crop shows. mirrored: for all or for each, let the network look at the
        mirror image (a left hand then looks like a right one); the results are mirrored back.
        """
        flips = [mirrored] * len(crops) if isinstance(mirrored, bool) else mirrored
        return list(self._pool.map(self._landmarks, crops, regions, flips))

    def _landmarks(self, crop: np.ndarray, region: Region, mirrored: bool) -> HandLandmarks:
        image = crop[:, ::-1] if mirrored else crop
        screen, presence, right, world = self._landmarker(image[None].astype(np.float32) / 255)
        xyz = screen.reshape(N_LANDMARKS, 3).astype(np.float64)
        metres = world.reshape(N_LANDMARKS, 3).astype(np.float64)
        is_right = float(right[0, 0])
        if mirrored:
            xyz[:, 0] = HAND_SIZE - xyz[:, 0]
            metres[:, 0] *= -1
            is_right = 1 - is_right
        A, scale = region.to_image(HAND_SIZE), region.size / HAND_SIZE
        metres[:, :2] = metres[:, :2] @ (A[:, :2] / scale).T
        z = (xyz[:, 2] - xyz[WRIST, 2]) * scale * _Z_UNIT
        return HandLandmarks((xyz[:, :2] - 0.5) @ A[:, :2].T + A[:, 2], z, metres, float(presence[0, 0]), is_right)


def load_nets(threads: int = 2) -> HandNets:
    """The networks' files, fetched at first use. Raises ModelFileError where they cannot be had."""
    return HandNets(model_path("palm_detection_full"), model_path("hand_landmark_full"), threads)
