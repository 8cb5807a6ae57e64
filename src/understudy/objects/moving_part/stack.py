"""A recording's depth in memory: small, with the people marked, and what stood there before anything moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from understudy.camera import Camera
from understudy.errors import FrameError, UnderstudyError
from understudy.geometry import transform_points
from understudy.skeleton import BONES, JOINT
from understudy.types import Person, RegisteredDepth, RegisteredFrame

UNIT: Final = np.float32(0.00025)
"""metres per step of the stored depth: a quarter of a millimetre, up to 16 m"""
_WIDTH: Final = 480  # pixels of the working image, at most
_LIMB, _HEAD, _HAND = 0.11, 0.17, 0.20  # metres: half widths that are masked; the hand's reach beyond the wrist
_BEHIND: Final = 0.22  # metres: how far behind a bone the surface may be to count as the person's
_LIKE_THE_FIRST: Final = 0.5  # pixels of K


@runtime_checkable
class Frames(Protocol):
    """Frames of a recording, decoded when they are asked for. Raises FrameError for one that cannot be read."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> RegisteredFrame: ...


@dataclass(frozen=True, eq=False)
class DepthStack:
    """Depth of t frames in one working camera (the colour camera, smaller), and which pixels may be people."""

    camera: Camera
    z: UInt16[np.ndarray, "t h w"]
    """in steps of UNIT; 0 = no measurement"""
    person: Bool[np.ndarray, "t h w"]
    usable: Bool[np.ndarray, " t"]
    """false for frames that could not be read"""

    def __len__(self) -> int:
        return len(self.z)

    @classmethod
    def read(cls, frames: Frames, people: Sequence[Sequence[Person]]) -> DepthStack:
        """Reads every frame once. Frames that raise FrameError are left empty; UnderstudyError if all do."""
        stack: DepthStack | None = None
        for i in range(len(frames)):
            try:
                depth = frames[i].depth
            except FrameError:
                continue
            if stack is None:
                stack = cls._empty(len(frames), depth)
                source = depth.camera
            elif depth.z.shape != (source.height, source.width) or np.abs(depth.camera.K - source.K).max() > 0.5:
                continue  # another camera: cannot be compared with the others
            stack._put(i, depth, people[i])
        if stack is None:
            raise UnderstudyError("moving part: no frame of the recording can be read")
        return stack

    @classmethod
    def _empty(cls, t: int, depth: RegisteredDepth) -> DepthStack:
        cell = -(-depth.camera.width // _WIDTH)
        h, w = depth.camera.height // cell, depth.camera.width // cell
        camera = depth.camera.crop(0, 0, w * cell, h * cell).resize(w, h)
        return cls(camera, np.zeros((t, h, w), np.uint16), np.zeros((t, h, w), bool), np.zeros(t, bool))

    def _put(self, i: int, depth: RegisteredDepth, people: Sequence[Person]) -> None:
        h, w = self.z.shape[1:]
        cell = depth.camera.width // w
        far = np.float32(65535)
        scaled = np.where(depth.z > 0, depth.z * (1 / UNIT), far).astype(np.float32)
        nearest = scaled[0 : h * cell : cell, 0 : w * cell : cell].copy()
        for a in range(cell):
            for b in range(cell):
                np.minimum(nearest, scaled[a : h * cell : cell, b : w * cell : cell], out=nearest)
        nearest[nearest >= far] = 0
        self.z[i] = nearest
        self.person[i] = person_mask(self.camera, nearest * UNIT, people)
        self.usable[i] = True

    def rays(self) -> Float[np.ndarray, "h w 3"]:
        """Through the pixel centres, z = 1."""
        h, w = self.z.shape[1:]
        u, v = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
        return np.nan_to_num(self.camera.unproject(np.stack([u, v], -1), 1.0))


def person_mask(camera: Camera, z: Float[np.ndarray, "h w"], people: Sequence[Person]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose surface is near a person's bones, generously (joints may be off by 10 cm)."""
    bones = np.zeros(z.shape, np.float32)  # depth of the hindmost bone that covers the pixel
    for person in people:
        joints = person.keypoints
        known = np.isfinite(joints).all(1) & (np.nan_to_num(joints[:, 2]) > 0.2)
        segments = [(joints[a], joints[b], _LIMB) for a, b in BONES if known[a] and known[b]]
        for side in ("left", "right"):
            e, w = JOINT[f"{side}_elbow"], JOINT[f"{side}_wrist"]
            s, h = JOINT[f"{side}_shoulder"], JOINT[f"{side}_hip"]
            if known[e] and known[w]:
                along = (joints[w] - joints[e]) / max(float(np.linalg.norm(joints[w] - joints[e])), 1e-6)
                segments.append((joints[w], joints[w] + _HAND * along, _LIMB))
            if known[s] and known[h]:
                segments.append((joints[s], joints[h], 0.2))
        if known[JOINT["nose"]]:
            segments.append((joints[JOINT["nose"]], joints[JOINT["nose"]], _HEAD))
        for a, b, width in segments:
            _draw(bones, camera, a, b, width)
    return np.asarray((bones > 0) & (z < bones + _BEHIND))


def _draw(image: np.ndarray, camera: Camera, a: np.ndarray, b: np.ndarray, width: float) -> None:
    """A thick line at its ends' mean depth; the farther of overlapping ones stays."""
    ends = np.stack([a, b])
    if (ends[:, 2] < 0.2).any():
        return
    uv = camera.project(ends)
    if not np.isfinite(uv).all() or np.abs(uv).max() > 10_000:
        return
    z = float(ends[:, 2].max())
    thickness = max(1, round(2 * width * camera.fx / float(ends[:, 2].mean())))
    (p, q) = (tuple(round(float(x)) for x in e) for e in uv)
    line = np.zeros(image.shape, np.uint8)
    left, right = sorted((p[0], q[0]))
    top, bottom = sorted((p[1], q[1]))
    rows = slice(max(top - thickness, 0), max(bottom + thickness, 0))
    columns = slice(max(left - thickness, 0), max(right + thickness, 0))
    cv2.line(line, p, q, 1, min(thickness, 255))
    window = image[rows, columns]
    np.maximum(window, line[rows, columns] * np.float32(z), out=window)


@dataclass(frozen=True, eq=False)
class Reference:
    """What stood there before anything moved: per pixel the median of the frames without people."""

    z: Float[np.ndarray, "h w"]
    """metres, 0 = never seen"""
    spread: Float[np.ndarray, "h w"]
    """metres: half of the distance between the quartiles"""
    points: Float[np.ndarray, "h w 3"]
    """world"""
    seen: Int[np.ndarray, "h w"]
    """frames behind it"""


def reference(stack: DepthStack, frames: Int[np.ndarray, " k"], T_world_cam: Float[np.ndarray, "4 4"]) -> Reference:
    """The reference from some frames (at most 15 of them, evenly)."""
    usable = frames[stack.usable[frames]]
    if not len(usable):
        raise UnderstudyError("moving part: no frame before the motion can be read")
    picked = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), 15)).astype(int))]
    z = stack.z[picked].copy()
    z[stack.person[picked] | (z == 0)] = 65535
    values = np.sort(np.ascontiguousarray(np.moveaxis(z, 0, -1)), axis=-1)
    seen = (values < 65535).sum(-1)

    def quantile(share: float) -> np.ndarray:
        at = np.minimum((seen - 1).clip(0) * share + 0.5, len(picked) - 1).astype(np.int64)
        return np.where(seen > 0, np.take_along_axis(values, at[..., None], -1)[..., 0] * UNIT, 0)

    median = quantile(0.5)
    points = transform_points(T_world_cam, stack.rays() * median[..., None])
    return Reference(median, (quantile(0.75) - quantile(0.25)) / 2, points, seen)


def changed(stack: DepthStack, ref: Reference, frames: Int[np.ndarray, " k"]) -> Bool[np.ndarray, "h w"]:
    """Reference surface that is not where it was, in most of these frames in which no person hides it."""
    picked = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), 12)).astype(int))]
    z = stack.z[picked].astype(np.float32) * UNIT
    seen = (z > 0) & ~stack.person[picked]
    tolerance = np.maximum(0.015, 6 * ref.spread)
    same = (np.abs(z - ref.z) < tolerance) & seen
    n = seen.sum(0)
    return np.asarray((ref.z > 0) & (n >= 2) & (same.sum(0) < 0.25 * n))


def left(stack: DepthStack, ref: Reference, frames: Int[np.ndarray, " k"]) -> Bool[np.ndarray, "h w"]:
    """Reference surface that does not stay in these frames: what no frame says anything about may have gone, too."""
    picked = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), 12)).astype(int))]
    z = stack.z[picked].astype(np.float32) * UNIT
    seen = (z > 0) & ~stack.person[picked]
    same = (np.abs(z - ref.z) < np.maximum(0.015, 4 * ref.spread)) & seen
    return np.asarray((ref.z > 0) & (same.sum(0) <= 0.5 * seen.sum(0)))
