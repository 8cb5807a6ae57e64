"""Binning of poses for the reachability map, compiled."""

from __future__ import annotations

from typing import Final

import numpy as np

from understudy.robot.chain import compiled, frames

CELL: Final = 0.08
"""metres"""
_SPLIT: Final = 3
_ROLLS: Final = 8
ORIENTATIONS: Final = 6 * _SPLIT * _SPLIT * _ROLLS


@compiled
def cell_of(R):  # type: ignore[no-untyped-def]
    """Index of a rotation's bin: the face of a cube that its x axis goes through, where, and the roll about x.

    The roll is measured from a direction that belongs to the face, so that it is defined well wherever x points.
    """
    face = 0
    for i in range(1, 3):
        if abs(R[i, 0]) > abs(R[face, 0]):
            face = i
    a, b = (face + 1) % 3, (face + 2) % 3
    size = abs(R[face, 0])
    u = int(_SPLIT * (0.5 + np.arctan(R[a, 0] / size) * (2 / np.pi)))
    v = int(_SPLIT * (0.5 + np.arctan(R[b, 0] / size) * (2 / np.pi)))
    u, v = min(max(u, 0), _SPLIT - 1), min(max(v, 0), _SPLIT - 1)
    roll = np.arctan2(R[a, 2], R[a, 1]) / (2 * np.pi) + 0.5
    k = min(int(_ROLLS * roll), _ROLLS - 1)
    side = 2 * face + (1 if R[face, 0] < 0 else 0)
    return ((side * _SPLIT + u) * _SPLIT + v) * _ROLLS + k


@compiled
def count_samples(fixed, low, high, n, rng, origin, counts):  # type: ignore[no-untyped-def]
    """Adds n uniform samples to counts (x, y, z, o), which saturate."""
    k = low.shape[0]
    q, work, tmp = np.empty(k), np.empty((k + 1, 3, 4)), np.empty((3, 4))
    for _ in range(n):
        for j in range(k):
            q[j] = low[j] + (high[j] - low[j]) * rng.random()
        frames(fixed, q, work, tmp)
        tool = work[k]
        x = int(np.round((tool[0, 3] - origin[0]) / CELL))
        y = int(np.round((tool[1, 3] - origin[1]) / CELL))
        z = int(np.round((tool[2, 3] - origin[2]) / CELL))
        if 0 <= x < counts.shape[0] and 0 <= y < counts.shape[1] and 0 <= z < counts.shape[2]:
            o = cell_of(tool)
            if counts[x, y, z, o] < 65535:
                counts[x, y, z, o] += 1


@compiled
def scores(score, origin, T, torso):  # type: ignore[no-untyped-def]
    """Scores (0 ... 1) of poses T (n, 4, 4), trilinear in position."""
    out = np.zeros(T.shape[0])
    nx, ny, nz = score.shape[0], score.shape[1], score.shape[2]
    for i in range(T.shape[0]):
        px, py = (T[i, 0, 3] - origin[0]) / CELL, (T[i, 1, 3] - origin[1]) / CELL
        pz = (T[i, 2, 3] - torso[i] - origin[2]) / CELL
        x, y, z = int(np.floor(px)), int(np.floor(py)), int(np.floor(pz))
        if x < 0 or y < 0 or z < 0 or x >= nx - 1 or y >= ny - 1 or z >= nz - 1:
            continue
        o = cell_of(T[i])
        fx, fy, fz = px - x, py - y, pz - z
        s = 0.0
        for dx in range(2):
            for dy in range(2):
                for dz in range(2):
                    w = (fx if dx else 1 - fx) * (fy if dy else 1 - fy) * (fz if dz else 1 - fz)
                    s += w * score[x + dx, y + dy, z + dz, o]
        out[i] = s / 255.0
    return out
