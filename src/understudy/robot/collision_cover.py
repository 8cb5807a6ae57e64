"""Balls that contain the links' collision shapes: pairs whose balls are apart cannot touch and need no exact test.

Nearly all pairs of links are far apart nearly always, and an exact test of every pair (Coal) costs most of what inverse
kinematics takes. The balls only ever rule out: what they leave is tested exactly, so the answer is the same.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from understudy.robot.chain import compiled, frames

_BALL_M: Final = 0.07
"""radius below which a ball is not divided further"""
_SAMPLE_M: Final = 0.015
"""between points on a surface: balls are larger by the farthest that a point of it is from all of these"""
_BETWEEN: Final = 0.58
"""of a triangle's longest side: no point of it is farther from all corners"""


class Cover:
    """Balls of all shapes; a shape moves with one joint of the chain (see `chain`; -1: it stands still)."""

    def __init__(
        self,
        shapes: list[tuple[Float[np.ndarray, "n 3"], float]],
        joints: Int[np.ndarray, " s"],
        pairs: Int[np.ndarray, "p 2"],
    ):
        """shapes: points in the frame of the joint, and how far any point of the shape is from the nearest of them, at
        most (metres). pairs: numbers of shapes.
        """
        balls = [_balls(points, spare) for points, spare in shapes]
        self.first = np.concatenate([[0], np.cumsum([len(b) for b in balls])])
        self.balls = np.concatenate(balls)
        self.whole = np.array([_ball(points, spare) for points, spare in shapes])
        self.joints, self.pairs = joints, pairs

    def near(self, fixed: Float[np.ndarray, "j 3 4"], x: Float[np.ndarray, "m k"]) -> Bool[np.ndarray, "m p"]:
        """Pairs that may touch; x: torso and arm (`Robot.stack`)."""
        return np.asarray(
            _near(fixed, np.ascontiguousarray(x), self.joints, self.pairs, self.whole, self.balls, self.first)
        )


def covered(geometry: Any) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Points of a shape in its own frame, and how far any point of it is from the nearest of them, at most.

    Of a triangle mesh, which is hollow, points on its surface; of a convex shape, which is not, points in its box.
    """
    if hasattr(geometry, "tri_indices"):
        corners = np.asarray(geometry.vertices(), float).reshape(-1, 3)
        triangles = np.array([[t[0], t[1], t[2]] for t in map(geometry.tri_indices, range(geometry.num_tris))])
        return _on_triangles(corners[triangles]), _BETWEEN * _SAMPLE_M
    geometry.computeLocalAABB()
    low, high = geometry.aabb_local.min_, geometry.aabb_local.max_
    counts = np.maximum(np.ceil((high - low) / (2 * _SAMPLE_M)).astype(int), 1)
    cell = (high - low) / counts
    axes = [low[a] + cell[a] * (np.arange(counts[a]) + 0.5) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), 0.5 * float(np.linalg.norm(cell))


def _on_triangles(faces: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "m 3"]:
    """The corners of the small triangles that these are divided into, none with a side above `_SAMPLE_M`."""
    sides = np.linalg.norm(faces - np.roll(faces, 1, axis=1), axis=2).max(axis=1)
    found = [faces.reshape(-1, 3)]
    for face, side in zip(faces, sides, strict=True):
        n = int(np.ceil(side / _SAMPLE_M))
        if n > 1:
            i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
            u, v = i[i + j <= n] / n, j[i + j <= n] / n
            found.append(np.stack([1 - u - v, u, v], axis=1) @ face)
    return np.concatenate(found)


def _ball(points: Float[np.ndarray, "n 3"], spare: float) -> Float[np.ndarray, "4"]:
    """Centre and radius of a ball around all points."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return np.append(middle, np.linalg.norm(points - middle, axis=1).max() + spare)


def _balls(points: Float[np.ndarray, "n 3"], spare: float) -> Float[np.ndarray, "m 4"]:
    """Around parts of the points, divided at the middle of their longest side until they are small."""
    ball = _ball(points, spare)
    side = np.ptp(points, axis=0)
    if ball[3] <= _BALL_M + spare or side.max() <= 0:
        return ball[None]
    axis = int(side.argmax())
    low = points[:, axis] <= points[:, axis].min() + 0.5 * side[axis]
    return np.concatenate([_balls(points[low], spare), _balls(points[~low], spare)])


@compiled
def _place(work, joint, ball, out):  # type: ignore[no-untyped-def]
    """out (3) = where a ball of a joint's frame is in the base's."""
    for a in range(3):
        if joint < 0:
            out[a] = ball[a]
        else:
            T = work[joint]
            out[a] = T[a, 0] * ball[0] + T[a, 1] * ball[1] + T[a, 2] * ball[2] + T[a, 3]


@compiled
def _apart(a, ra, b, rb):  # type: ignore[no-untyped-def]
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2 > (ra + rb) ** 2


@compiled
def _near(fixed, x, joints, pairs, whole, balls, first):  # type: ignore[no-untyped-def]
    m, k = x.shape
    out = np.zeros((m, len(pairs)), np.bool_)
    work, tmp = np.empty((k + 1, 3, 4)), np.empty((3, 4))
    middles, placed = np.empty((len(whole), 3)), np.empty((len(balls), 3))
    done, near = np.empty(len(whole), np.bool_), np.empty(len(balls), np.int64)
    for i in range(m):
        frames(fixed, x[i], work, tmp)
        for s in range(len(whole)):
            _place(work, joints[s], whole[s], middles[s])
            done[s] = False
        for p in range(len(pairs)):
            a, b = pairs[p, 0], pairs[p, 1]
            if _apart(middles[a], whole[a, 3], middles[b], whole[b, 3]):
                continue
            for s in (a, b):
                if not done[s]:
                    for o in range(first[s], first[s + 1]):
                        _place(work, joints[s], balls[o], placed[o])
                    done[s] = True
            n = 0  # of b's balls that are near to a
            for u in range(first[b], first[b + 1]):
                if not _apart(placed[u], balls[u, 3], middles[a], whole[a, 3]):
                    near[n] = u
                    n += 1
            for o in range(first[a], first[a + 1]):
                if n == 0 or out[i, p]:
                    break
                if _apart(placed[o], balls[o, 3], middles[b], whole[b, 3]):
                    continue
                for u in near[:n]:
                    if not _apart(placed[o], balls[o, 3], placed[u], balls[u, 3]):
                        out[i, p] = True
                        break
    return out
