"""The hand's view: a crop of the depth around a hand, turned so that the forearm comes from below.

Everything is a right hand: left hands are looked at in a mirror (x -> -x in the colour camera's frame). Coordinates are
those of the crop view: z through the place where the hand is believed to be, y as near as possible along the believed
forearm towards the elbow (so fingers that go on from the forearm point to -y), x = y x z; relative to that place.
Metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

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
PIXELS: Final = 72
"""of the colour crop's edge, which covers what the depth crop covers"""
PIXEL: Final = 2 * HALF / PIXELS
"""metres at the crop's distance"""
GREY: Final = 128
"""of colour crops where nothing is seen"""
LIMIT: Final = 0.2
"""metres: depths are cut off so far from the crop's distance"""
BEYOND: Final = 0.07
"""metres from the wrist along the forearm to the crop's centre"""
SHORT: Final = 0.15
"""sine of the angle to the view below which a forearm has no direction in the image"""
CONTEXT: Final = (
    "wrist", "elbow", "shoulder", "other_shoulder", "neck", "hips", "nose", "other_elbow", "other_wrist", "knee",
    "other_knee",
)  # fmt: skip
"""Joints whose places the network is given; those without 'other' are of the hand's side, the hips between both"""

_OTHER = {"left": "right", "right": "left"}
SIGMA: Final = 0.06
"""metres: of joints whose uncertainty is not known, radius that holds 68 % of the errors"""
UNSURE: Final = ("wrist", "elbow")
"""Joints of whose uncertainty the network is told"""

_KNOTS = 13  # in a row, at which it is projected
_SHARPEST = 4  # times as fine as the colour crop at most: where it is averaged from
_NEAREST_Z = 0.1  # metres: nothing nearer to the camera is measured


@dataclass(frozen=True, eq=False)
class HandView:
    """Where one hand's crop stands in the colour camera's frame."""

    R: Float[np.ndarray, "3 3"]
    """colour camera's frame -> view; of a left hand the mirror is part of it (determinant -1)"""
    center: Float[np.ndarray, "3"]
    """metres, colour camera's frame"""
    context: Float[np.ndarray, "11 3"]
    """CONTEXT in view coordinates"""
    sigma: Float[np.ndarray, "2"]
    """metres, of UNSURE: radius of the ball that holds 68 % of the errors"""

    @classmethod
    def of(
        cls, joints: Float[np.ndarray, "18 3"], side: str, sigma_m: Float[np.ndarray, "18"] | None = None
    ) -> HandView | None:
        """The view of a person's hand; None when wrist or elbow are not known (NaN) or lie behind the camera.

        Other joints that are not known are taken to be in the middle of those that are. sigma_m: of the joints, as
        `Person` has it; SIGMA where it is not known.
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
        unsure = np.full(len(UNSURE), np.nan) if sigma_m is None else sigma_m[rows(*(f"{side}_{n}" for n in UNSURE))]
        return cls(R * mirror, center * mirror, seen @ R.T - middle, np.nan_to_num(unsure, nan=SIGMA))

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
        x, y, z = self.R @ points.T
        depth = z - self.distance
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = self.distance / CELL / z
            u, v = x * scale + CELLS / 2, y * scale + CELLS / 2
            inside = (z > _NEAREST_Z) & (u >= 0) & (u < CELLS) & (v >= 0) & (v < CELLS) & (depth > -LIMIT)
        near = np.full(CELLS * CELLS, EMPTY, np.float32)
        cell = v[inside].astype(np.int32) * CELLS + u[inside].astype(np.int32)
        np.minimum.at(near, cell, depth[inside].clip(max=LIMIT).astype(np.float32))
        return np.stack([near, (near < EMPTY).astype(np.float32)]).reshape(2, CELLS, CELLS)

    def color_crop(self, camera: Camera, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "72 72 3"]:
        """The colour image as it is seen along the view, `PIXELS` columns across `2 * HALF` at the centre's distance;
        GREY outside the image. camera: of the image.
        """
        finer = int(np.clip(round(PIXEL * camera.fx / self.distance), 1, _SHARPEST))
        knots = np.linspace(-HALF, HALF, _KNOTS) / self.distance
        x, y = np.meshgrid(knots, knots)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ self.R
        uv = np.nan_to_num(camera.project(rays), nan=-1e4).reshape(_KNOTS, _KNOTS, 2)
        fill = _between(finer * PIXELS)
        u, v = ((fill @ uv[..., i] @ fill.T).astype(np.float32) for i in range(2))
        grey = (GREY, GREY, GREY)
        seen = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=grey)
        small: np.ndarray = cv2.resize(seen, (PIXELS, PIXELS), interpolation=cv2.INTER_AREA)
        return small

    def points_near(self, depth: RegisteredDepth) -> Float[np.ndarray, "n 3"]:
        """The measured points that `depth_crop` needs: those in the crop's part of the image."""
        part = image_part(depth.camera, self.center, 1.5 * HALF)
        z = depth.z[part]
        rays = pixel_rays(depth.camera)[(slice(None), *part)]
        measured = z > 0
        chosen = z[measured].astype(np.float64)
        return np.stack([rays[0][measured] * chosen, rays[1][measured] * chosen, chosen], axis=1)


@cache
def _between(n: int) -> Float[np.ndarray, "n k"]:
    """Linear interpolation between the knots at the centres of n pixels."""
    at = (np.arange(n) + 0.5) * (_KNOTS - 1) / n
    return np.maximum(1 - np.abs(at[:, None] - np.arange(_KNOTS)), 0.0)


@cache
def context_rows(side: str) -> tuple[list[int], ...]:
    """Rows of COCO-18 joints of one side's CONTEXT; it is the mean of two where there are two."""
    out = []
    for name in CONTEXT:
        part = name.removeprefix("other_")
        own = side if part == name else _OTHER[side]
        if part in ("neck", "nose"):
            out.append([JOINT[part]])
        elif part == "hips":
            out.append([JOINT["left_hip"], JOINT["right_hip"]])
        else:
            out.append([JOINT[f"{own}_{part}"]])
    return tuple(out)


def arm_context(joints: Float[np.ndarray, "18 3"], side: str) -> Float[np.ndarray, "11 3"]:
    """CONTEXT of one side from COCO-18 joints, in their frame."""
    return np.stack([joints[rows].mean(axis=0) for rows in context_rows(side)])


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
