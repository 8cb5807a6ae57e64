"""The handle: what stands out of the front near where the hand held it, before the hand came."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from understudy.geometry import rigid
from understudy.objects.articulation import Handle
from understudy.objects.moving_part.stack import Reference

_NEAR: Final = 0.25  # metres between the hand's middle place and the handle's
_OUT: Final = (0.012, 0.13)  # metres in front of the panel
_LONG: Final = 1.4  # times as long as wide: a bar with a direction
KNOB: Final = 0.06
"""metres: what is shorter has no direction that one could see, and counts as level"""
_LEVEL: Final = 0.5  # vertical component of a bar's direction up to which it counts as level
_STRAIGHT: Final = float(np.cos(np.radians(35)))
_LEAST: Final = 4  # pixels
_PALM: Final = 0.03  # metres from the grip's middle to the palm's


def find_handle(
    ref: Reference,
    normal: Float[np.ndarray, "3"],
    front: float,
    hand: Float[np.ndarray, "3"],
    ray: Float[np.ndarray, "3"],
    pixel_m: float,
    moved: Bool[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "4 4"], Handle, bool]:
    """T_world_handle at rest, the handle, and whether it was seen (else it is put where the hand was).

    normal, front: the panel is n . p = front (world, metres). hand: where the hand was, brought back to rest. ray: from
    the camera to it (unit). pixel_m: size of a pixel there. moved: pixels whose surface does
    not stay when the part goes.
    """
    grip = hand - _PALM * normal
    height = ref.points @ normal - front
    near = moved & (ref.z > 0) & (height > _OUT[0]) & (height < _OUT[1])
    near &= np.linalg.norm(ref.points - grip, axis=-1) < _NEAR
    piece = _piece(near, ref.points, grip)
    up = np.array([0, 0, 1.0]) - normal * normal[2]
    up /= np.linalg.norm(up)
    if piece is None:
        out = float(np.clip(grip @ normal - front, 0.02, 0.08))
        grip = grip + normal * (front + out - grip @ normal)
        return rigid(np.column_stack([normal, np.cross(up, normal), up]), grip), Handle(0.12, 0.01, out), False
    middle, along, length, width = _bar(ref.points[piece], normal, up)
    radius = float(np.clip((width - pixel_m) / 2, 0.004, 0.03))
    length = max(length - pixel_m / 2, 2 * radius)
    standing = piece & (height > 0.6 * np.percentile(height[piece], 80))  # not its posts
    out = float(np.median(height[standing]))
    # what the camera sees is the surface; the middle lies a radius farther along the ray
    out = max(out + radius * float(ray @ normal), 0.01)
    middle = middle + normal * (front + out - middle @ normal)
    for axis in (up, np.cross(up, normal)):  # bars are upright or level: what is nearly so is
        if abs(along @ axis) > _STRAIGHT:
            along = axis * np.sign(along @ axis)
    level = abs(along @ up) < _LEVEL
    upwards = np.cross(along, normal) if level else along  # y of a level bar, z of others
    along = along * np.sign(upwards @ up or 1.0)
    return rigid(np.column_stack([normal, np.cross(along, normal), along]), middle), Handle(length, radius, out), True


def _piece(near: np.ndarray, points: np.ndarray, grip: np.ndarray) -> np.ndarray | None:
    """The connected piece nearest to the hand, size in mind."""
    joined = cv2.dilate(near.astype(np.uint8), np.ones((5, 5), np.uint8))
    n, labels = cv2.connectedComponents(joined)
    best, least = None, np.inf
    for k in range(1, n):
        piece = near & (labels == k)
        size = int(piece.sum())
        if size < _LEAST:
            continue
        distance = float(np.linalg.norm(points[piece].mean(0) - grip)) + 0.3 / size
        if distance < least:
            best, least = piece, distance
    return best


def _bar(points: np.ndarray, normal: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Middle, direction in the panel's plane, length and width of a bar's visible points."""
    side = np.cross(up, normal)
    center = np.median(points, axis=0)
    flat = np.column_stack([(points - center) @ side, (points - center) @ up])
    if len(flat) > 5:
        values, vectors = np.linalg.eigh(np.cov(flat.T))
        elongated = values[1] > max(_LONG**2 * values[0], KNOB**2 / 12)
        main = vectors[:, 1] if elongated else np.array([1.0, 0.0])
    else:
        main = np.array([1.0, 0.0])
    cross = np.array([-main[1], main[0]])
    along, across = flat @ main, flat @ cross
    low, high = np.percentile(along, (1, 99))
    left, right = np.percentile(across, (8, 92))
    middle = center + side * (main[0] * (low + high) / 2 + cross[0] * (left + right) / 2)
    middle = middle + up * (main[1] * (low + high) / 2 + cross[1] * (left + right) / 2)
    return middle, side * main[0] + up * main[1], float(high - low), float(right - left)
