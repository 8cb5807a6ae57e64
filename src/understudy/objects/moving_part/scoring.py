"""How well points of a part, moved to where a hypothesis says, agree with depth images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from understudy.geometry import inverse
from understudy.objects.articulation import Articulation
from understudy.objects.moving_part.stack import UNIT, DepthStack, Reference

UNEXPLAINED: Final = 0.6
"""cost of a point that is hidden by something that has no explanation"""
HIDDEN: Final = 0.6
"""worth of a point that a person hides"""
OLD: Final = 0.0
"""worth of finding a surface where there was one from the start: nothing moves into other things"""
_FAR: Final = 0.1  # metres along the optical axis
_HOME: Final = 0.015  # metres


@dataclass(frozen=True, eq=False)
class PartModel:
    """Points of the part at rest, world frame: of its front, which is a plane, and of what stands out of it."""

    points: Float[np.ndarray, "n 3"]
    flat: Bool[np.ndarray, " n"]
    """on the front's plane"""
    normal: Float[np.ndarray, "3"]
    """of the front, outwards"""
    thickness_m: float = 0.02
    """of the front; what a camera sees that looks at its back"""

    def part(self, which: np.ndarray) -> PartModel:
        return replace(self, points=self.points[which], flat=self.flat[which])

    def thinned(self, n: int, rng: np.random.Generator) -> PartModel:
        """At most n points; of those that stand out, up to a third of them."""
        out, flat = np.flatnonzero(~self.flat), np.flatnonzero(self.flat)
        out = rng.permutation(out)[: n // 3]
        flat = rng.permutation(flat)[: n - len(out)]
        return self.part(np.sort(np.concatenate([out, flat])))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Residuals of n poses with m points each."""

    gap: Float[np.ndarray, "n m"]
    """metres along the surface's normal; positive: something is in front of the predicted surface; 0 if not seen"""
    seen: Bool[np.ndarray, "n m"]
    """there is a measurement, and the point's surface faces the camera"""
    explained: Bool[np.ndarray, "n m"]
    """what is measured there was there from the start"""
    person: Bool[np.ndarray, "n m"]
    """or may be a person"""
    home: Bool[np.ndarray, "n m"]
    """the point is in the plane where the front rests: it may find itself there"""


class Scorer:
    """Compares parts with the depth images of a recording."""

    def __init__(self, stack: DepthStack, ref: Reference, T_world_cam: Float[np.ndarray, "4 4"]):
        self.stack = stack
        self._T_cam_world = inverse(T_world_cam)
        rays = stack.rays().astype(np.float32)
        self._rays = np.ascontiguousarray(rays.reshape(-1, 3))
        self._z = _marked(stack, ref).reshape(len(stack), -1)

    def from_behind(self, model: PartModel, motion: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, " n"]:
        """Whether the camera looks at the back of the front."""
        T = self._T_cam_world @ motion
        middle = T[:, :3, :3] @ model.points.mean(0) + T[:, :3, 3]
        return np.asarray(np.einsum("ni,ni->n", T[:, :3, :3] @ model.normal, middle) > 0)

    def compare(
        self, model: PartModel, motion: Float[np.ndarray, "n 4 4"], frames: Int[np.ndarray, " n"]
    ) -> Comparison:
        """motion: takes the part's points (world, at rest) to where they should be in that frame (world)."""
        camera = self.stack.camera
        T = (self._T_cam_world @ motion).astype(np.float32)
        front = float(model.points[model.flat].mean(0) @ model.normal) if model.flat.any() else np.inf
        height = (model.normal @ motion[:, :3, :3]) @ model.points.T + (motion[:, :3, 3] @ model.normal)[:, None]
        home = np.abs(height - front) < _HOME
        normal = T[:, :3, :3] @ model.normal.astype(np.float32)
        away = self.from_behind(model, motion)
        points = model.points.astype(np.float32).T
        p = T[:, :3, :3] @ points + T[:, :3, 3, None]  # (n, 3, m)
        p -= (away * np.float32(model.thickness_m))[:, None, None] * normal[:, :, None]
        x, y, z = p[:, 0], p[:, 1], p[:, 2]
        z = np.maximum(z, np.float32(0.05))
        u, v = x / z, y / z
        if camera.distorted:
            u, v = camera.distort_xy(u, v)
            u, v = np.nan_to_num(u, nan=-9.0), np.nan_to_num(v, nan=-9.0)
        u = u * np.float32(camera.fx) + np.float32(camera.cx + 0.5)
        v = v * np.float32(camera.fy) + np.float32(camera.cy + 0.5)
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        pixel = v.astype(np.int32) * camera.width + u.astype(np.int32)
        pixel[~inside] = 0
        measured = self._z[frames[:, None], pixel]
        seen = inside & (measured > 3)
        seen &= model.flat[None] | ~away[:, None]
        d = measured * UNIT
        gap = z - d  # of what has no known normal: along the optical axis
        flat = model.flat
        ray = self._rays[pixel[:, flat]]
        n = np.where(away, -1, 1).astype(np.float32)[:, None] * normal
        offset = np.einsum("ni,nim->nm", n, p[:, :, flat], optimize=True)
        along = ray[..., 0] * n[:, 0, None] + ray[..., 1] * n[:, 1, None] + ray[..., 2] * n[:, 2, None]
        across = along * d[:, flat] - offset
        # seen at a grazing angle, the distance from the plane says nothing about what is far before or behind it
        gap[:, flat] = np.where(np.abs(gap[:, flat]) > _FAR, gap[:, flat], across)
        return Comparison(
            np.where(seen, gap, np.float32(0)), seen, (measured & 1).astype(bool), (measured & 2).astype(bool), home
        )

    def agreement(
        self,
        model: PartModel,
        articulation: Articulation,
        q: Float[np.ndarray, " n"],
        frames: Int[np.ndarray, " n"],
        sigma_m: float,
    ) -> Float[np.ndarray, " n"]:
        """Mean over the points of: 1 where the surface is there, 0 where something hides it or nothing was measured,
        -1 where the camera sees through it.
        """
        return point_scores(self.compare(model, motions(articulation, q), frames), sigma_m, hidden=HIDDEN).mean(1)


def point_scores(
    c: Comparison, sigma_m: float, unexplained: float = UNEXPLAINED, hidden: float = 0.0
) -> Float[np.ndarray, "n m"]:
    """1 = there, -1 = seen through, `-unexplained` = hidden by what has no explanation, `hidden` = by a person, else 0.

    To compare places of a part, what a person hides must not count for less than what is seen, or parts would flee from
    people; to judge points, it must not count at all. What is found where a person may be counts as much as what is
    hidden: less, and parts would hide behind people.
    """
    there = np.exp(np.float32(-0.5 / sigma_m**2) * c.gap * c.gap)
    old = np.where(c.explained, np.float32(OLD), np.float32(1))
    worth = np.where(c.home, np.float32(1), np.where(c.person, np.float32(hidden), old))
    covered = np.where(c.person, np.float32(hidden), np.where(c.explained, np.float32(0), np.float32(-unexplained)))
    s = there * worth + (1 - there) * np.where(c.gap < 0, np.float32(-1), covered)
    return np.where(c.seen, s, np.float32(0.5 * hidden))


def _marked(stack: DepthStack, ref: Reference) -> UInt16[np.ndarray, "t h w"]:
    """The depth images; the last bit of a pixel tells whether its surface was always there, the one before whether it
    may be a person's.
    """
    out = stack.z & np.uint16(0xFFFC)
    was = (ref.z / UNIT).astype(np.float32)
    tolerance = np.maximum(0.02, 6 * ref.spread).astype(np.float32) / UNIT
    for i in range(len(out)):
        known = (np.abs(out[i] - was) < tolerance) | (ref.z == 0)
        out[i] |= known + 2 * stack.person[i].astype(np.uint16)
    return out


def motions(articulation: Articulation, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """Takes points of the part at rest to where they are at q."""
    return articulation.pose(q) @ inverse(articulation.T_rest)


def in_part(articulation: Articulation, q: np.ndarray, positions: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Points that are on the part at q, brought back to where they are at rest (world)."""
    T = np.linalg.inv(motions(articulation, q))
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], positions) + T[:, :3, 3])
