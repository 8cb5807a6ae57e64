"""Hands in pictures: thin bones, and arrows out of the palms.

An arrow that points at the camera, or away from it, is hardly more than a dot. So a small disc lies on the hand at the
arrow's foot: white where the camera looks into the palm, a ring where it sees the back of the hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from understudy.camera import Camera
from understudy.drawing import OUTLINE, WHITE, Canvas, Rgb
from understudy.skeleton import HAND_BONES, HAND_KEYPOINTS, JOINT
from understudy.types import Palm, Person

PALM_ARROW_M: Final = 0.15
"""length of a palm normal's arrow, metres"""
LOW_CONFIDENCE: Final = 0.5
"""below this confidence a palm is thin and faint"""

_CORNERS = [HAND_KEYPOINTS.index(name) for name in ("wrist", "index_1", "pinky_1")]
_FOOT_M = 0.022  # radius of the disc
_TURN = np.linspace(0, 2 * np.pi, 24, endpoint=False)
_SHORTEST = 25  # pixels: hands that look smaller get no bones
_SMALL = 60  # pixels: hands that look smaller get thinner outlines
_FAR = 1e5  # pixels: beyond, nothing is drawn


def palm_middle(person: Person, side: str) -> Float[np.ndarray, "3"] | None:
    """Where a palm's arrow starts, metres; None where there is no palm, or no place for it.

    The mean of the hand's wrist and its knuckles of index and little finger, of those that are known; else the body's
    wrist.
    """
    palm = person.hands.get(side)
    if palm is None:
        return None
    if palm.keypoints is not None:
        corners = palm.keypoints[_CORNERS]
        known = corners[np.isfinite(corners).all(axis=1)]
        if len(known):
            return known.mean(axis=0)
    wrist = person.keypoints[JOINT[f"{side}_wrist"]]
    return wrist if np.isfinite(wrist).all() else None


def sure(palm: Palm) -> bool:
    """Whether a palm is drawn in full strength."""
    return palm.confidence >= LOW_CONFIDENCE


@dataclass(frozen=True, eq=False)
class HandFigure:
    """A hand in pixels."""

    uv: Float[np.ndarray, "21 2"]
    """the 2D keypoints, else the 3D ones projected; NaN where neither is"""
    arrow: Float[np.ndarray, "2 2"] | None
    """from the palm along its normal; None where it cannot be seen"""
    foot: Float[np.ndarray, "n 2"] | None
    """the rim of the disc at the arrow's foot"""
    faces_camera: bool
    weak: bool
    """confidence below `LOW_CONFIDENCE`"""
    color: Rgb
    thickness: int
    """of the body's bones, pixels"""

    @classmethod
    def of(cls, person: Person, side: str, camera: Camera, color: Rgb, thickness: int) -> HandFigure | None:
        """None where the person has no such palm."""
        palm = person.hands.get(side)
        if palm is None:
            return None
        middle = palm_middle(person, side)
        arrow, foot, faces = None, None, False
        if middle is not None:
            pixel = max(float(middle[2]), 0.0) / camera.fx  # metres
            radius = float(np.clip(_FOOT_M, 1.5 * thickness * pixel, 2.5 * thickness * pixel))
            points = np.stack([middle, middle + PALM_ARROW_M * palm.normal, *_circle(middle, palm.normal, radius)])
            uv = camera.project(points)
            faces = bool(middle @ palm.normal < 0)
            if np.isfinite(uv).all() and np.abs(uv).max() < _FAR:
                arrow, foot = uv[:2], uv[2:]
        return cls(_keypoints(palm, camera), arrow, foot, faces, not sure(palm), color, thickness)

    def draw_bones(self, canvas: Canvas) -> None:
        """Thin lines in the side's colour; none where the hand is too small to show them."""
        known = np.isfinite(self.uv).all(axis=1)
        size = float(np.linalg.norm(np.ptp(self.uv[known], axis=0))) if known.any() else 0.0
        if size < _SHORTEST:
            return
        width = 1 if self.weak else max(1, self.thickness // 3)
        for color, stroke in ((OUTLINE, width + (1 if size < _SMALL else 2)), (self.color, width)):
            for a, b in HAND_BONES:
                if known[a] and known[b]:
                    canvas.line(self.uv[a], self.uv[b], color, stroke)

    def draw_palm(self, canvas: Canvas) -> None:
        """The arrow and the disc; what is nearer to the camera comes last."""
        if self.arrow is None or self.foot is None:
            return
        width = 1 if self.weak else max(1, self.thickness // 2)
        if self.faces_camera:
            _draw_disc(canvas, self.foot, WHITE, width)
        canvas.arrow(self.arrow[0], self.arrow[1], WHITE, width)
        if not self.faces_camera:
            _draw_disc(canvas, self.foot, self.color, width)


def _keypoints(palm: Palm, camera: Camera) -> Float[np.ndarray, "21 2"]:
    uv = np.full((len(HAND_KEYPOINTS), 2), np.nan)
    if palm.keypoints is not None:
        uv = camera.project(palm.keypoints)
    if palm.keypoints_2d is not None:
        found = palm.keypoints_2d[:, 2] > 0
        uv = np.where(found[:, None], palm.keypoints_2d[:, :2], uv)
    uv[~(np.abs(uv) < _FAR).all(axis=1)] = np.nan
    return uv


def _circle(middle: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], radius: float) -> Float[np.ndarray, "n 3"]:
    """Points of a circle (metres) around the normal."""
    a = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    a /= np.linalg.norm(a)
    return middle + radius * (np.cos(_TURN)[:, None] * a + np.sin(_TURN)[:, None] * np.cross(normal, a))


def _draw_disc(canvas: Canvas, rim: Float[np.ndarray, "n 2"], inside: Rgb, width: int) -> None:
    """A white ring and what is inside it."""
    points = [np.rint(16 * rim).astype(np.int32)]  # OpenCV draws at 1/16 pixel
    cv2.polylines(canvas.image, points, True, OUTLINE, width + 2, cv2.LINE_AA, 4)
    cv2.fillPoly(canvas.image, points, inside, cv2.LINE_AA, 4)
    cv2.polylines(canvas.image, points, True, WHITE, width, cv2.LINE_AA, 4)
