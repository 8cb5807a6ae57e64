"""The hand's view: a crop of the depth around a hand, turned so that the forearm comes from below.

Everything is a right hand: left hands are looked at in a mirror (x -> -x in the colour camera's frame). Coordinates are
those of the crop view: z through the place where the hand is believed to be, y as near as possible along the believed
forearm towards the elbow (so fingers that go on from the forearm point to -y), x = y x z; relative to that place.
Metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Float32

from understudy.camera import Camera
from understudy.skeleton import JOINT, rows
from understudy.types import RegisteredDepth
from understudy.voxels import pixel_rays

CELLS: Final = 48
HALF: Final = 0.18
"""metres at the crop's distance: half the edge of the depth crop"""
CELL: Final = 2 * HALF / CELLS
EMPTY: Final = 1.0
"""depth of cells without a measurement"""
LIMIT: Final = 0.2
"""metres: depths are cut off so far from the crop's distance"""
BEYOND: Final = 0.07
"""metres from the wrist along the forearm to the crop's centre"""
SHORT: Final = 0.15
"""sine of the angle to the view below which a forearm has no direction in the image"""
CONTEXT: Final = ("wrist", "elbow", "shoulder", "other_shoulder", "neck", "hips", "nose")
"""Joints whose places the network is given; the hand's own side first"""

_OTHER = {"left": "right", "right": "left"}
_NEAREST_Z = 0.1  # metres: nothing nearer to the camera is measured


@dataclass(frozen=True, eq=False)
class HandView:
    """Where one hand's crop stands in the colour camera's frame."""

    R: Float[np.ndarray, "3 3"]
    """colour camera's frame -> view; of a left hand the mirror is part of it (determinant -1)"""
    center: Float[np.ndarray, "3"]
    """metres, colour camera's frame"""
    context: Float[np.ndarray, "7 3"]
    """CONTEXT in view coordinates"""

    @classmethod
    def of(cls, joints: Float[np.ndarray, "18 3"], side: str) -> HandView | None:
        """The view of a person's hand; None when wrist or elbow are not known (NaN) or lie behind the camera.

        Other joints that are not known are taken to be in the middle of those that are.
        """
        known = arm_context(joints, side)
        if not np.isfinite(known[:2]).all() or known[0, 2] < _NEAREST_Z:
            return None
        known = np.where(np.isfinite(known), known, np.nanmean(known, axis=0))
        mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
        seen = known * mirror
        forearm = seen[0] - seen[1]
        forearm = forearm / max(float(np.linalg.norm(forearm)), 1e-6)
        center = seen[0] + BEYOND * forearm
        R = crop_rotation(center, -forearm)
        middle = np.array([0.0, 0.0, np.linalg.norm(center)])
        return cls(R * mirror, center * mirror, seen @ R.T - middle)

    @property
    def distance(self) -> float:
        """Metres from the camera to the crop's centre."""
        return float(np.linalg.norm(self.center))

    def directions_from_cam(self, vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Colour camera's frame -> view."""
        return vectors @ self.R.T

    def directions_to_cam(self, vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """View -> colour camera's frame."""
        return vectors @ self.R

    def to_cam(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """View coordinates -> colour camera's frame, metres."""
        return points @ self.R + self.center

    def depth_crop(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "2 48 48"]:
        """Nearest depth of each column relative to the centre (metres; EMPTY where nothing was measured), and 1 where
        something was. Rows are y, columns x.

        points: what the camera measured, colour camera's frame. `CELLS` columns across `2 * HALF` at the centre.
        """
        x, y, z = np.einsum("ij,nj->in", self.R, points)
        depth = z - self.distance
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = self.distance / CELL / z
            u, v = x * scale + CELLS / 2, y * scale + CELLS / 2
            inside = (z > _NEAREST_Z) & (u >= 0) & (u < CELLS) & (v >= 0) & (v < CELLS) & (depth > -LIMIT)
        near = np.full(CELLS * CELLS, EMPTY, np.float32)
        cell = v[inside].astype(np.int32) * CELLS + u[inside].astype(np.int32)
        np.minimum.at(near, cell, depth[inside].clip(max=LIMIT).astype(np.float32))
        return np.stack([near, (near < EMPTY).astype(np.float32)]).reshape(2, CELLS, CELLS)

    def points_near(self, depth: RegisteredDepth, margin: float = 0.0) -> Float[np.ndarray, "n 3"]:
        """The measured points that `depth_crop` needs: those in the crop's part of the image.

        margin: also those that views whose centres are up to so many metres away need.
        """
        part = image_part(depth.camera, self.center, 1.5 * HALF + margin)
        z = depth.z[part]
        rays = pixel_rays(depth.camera)[(slice(None), *part)]
        measured = z > 0
        chosen = z[measured].astype(np.float64)
        return np.stack([rays[0][measured] * chosen, rays[1][measured] * chosen, chosen], axis=1)


def arm_context(joints: Float[np.ndarray, "18 3"], side: str) -> Float[np.ndarray, "7 3"]:
    """CONTEXT of one side from COCO-18 joints, in their frame."""
    own = [f"{side}_{name}" for name in CONTEXT[:3]]
    trunk = joints[rows(*own, f"{_OTHER[side]}_shoulder", "neck")]
    hips = joints[rows("left_hip", "right_hip")].mean(axis=0)
    return np.vstack([trunk, hips, joints[JOINT["nose"]]])


def crop_rotation(center: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """R_view_cam: z through the centre, y as near as possible along `up` (from the hand to the elbow)."""
    z = center / np.linalg.norm(center)
    y = up - z * (up @ z)
    if np.linalg.norm(y) < SHORT:  # the forearm points at the camera: the image's own upright
        y = np.array([0.0, 1.0, 0.0]) - z * z[1]
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def image_part(camera: Camera, center: Float[np.ndarray, "3"], reach: float) -> tuple[slice, slice]:
    """Rows and columns of the image within `reach` metres of a point; empty where it lies outside."""
    corners = center + reach * np.array([[-1, -1, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0], [0, 0, 0]])
    corners[:, 2] = max(float(center[2]) - reach, _NEAREST_Z)
    uv = camera.project(corners)
    if not np.isfinite(uv).all():  # the lens model ends in between
        return slice(0, camera.height), slice(0, camera.width)
    low, high = np.floor(uv.min(axis=0)), np.ceil(uv.max(axis=0)) + 1
    size = np.array([camera.width, camera.height])
    (u0, v0), (u1, v1) = (np.clip(edge, 0, size).astype(int).tolist() for edge in (low, high))
    return slice(v0, v1), slice(u0, u1)
