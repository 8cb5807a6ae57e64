"""Shoes: a rounded outline per slice of the foot, flat below."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from understudy.stage.appearance_mesh import grid
from understudy.stage.appearance_pieces import Color, Garment, Piece
from understudy.stage.body import SOLE, Body

_SLICES, _RING = 26, 22


def shoe(body: Body, side: str, color: Color) -> Garment:
    """A lofted shoe around one foot; the front bends with the toes."""
    left = (body.vertices[:, 1] > 0) == (side == "left")
    v = body.vertices[(body.weight_of("foot", "toe") > 0.5) & left & (body.vertices[:, 2] < 0.10)]
    low, high = v.min(0), v.max(0)
    angle = np.linspace(0, 2 * np.pi, _RING, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    rows = []
    for x in np.linspace(high[0] + 0.012, low[0] - 0.010, _SLICES):
        near = v[np.abs(v[:, 0] - np.clip(x, low[0] + 0.01, high[0] - 0.012)) < 0.018]
        right, left_most = near[:, 1].min() - 0.007, near[:, 1].max() + 0.007
        t = (high[0] - x) / (high[0] - low[0])  # 0 at the toes, 1 at the heel
        tip = 1 - max(0.0, (0.15 - t) / 0.21) ** 2
        heel = 1 - max(0.0, (t - 0.88) / 0.17) ** 2
        round_ends = np.sqrt(max(tip, 0.02) * max(heel, 0.02))
        width = 0.5 * (left_most - right) * (0.25 + 0.75 * round_ends) * (1 - 0.12 * np.clip((t - 0.4) / 0.3, 0, 1))
        top = (0.058 + 0.060 * np.clip((t - 0.38) / 0.34, 0, 1) ** 1.2) * (0.45 + 0.55 * round_ends)
        y = 0.5 * (left_most + right) + np.sign(c) * np.abs(c) ** 0.6 * width
        z = np.where(s > 0, np.abs(s) ** 0.8 * top, -SOLE * np.abs(s) ** 0.25)
        rows.append(np.stack([np.full(_RING, x), y, z], 1))
    rows = [np.tile(rows[0].mean(0), (_RING, 1)), *rows, np.tile(rows[-1].mean(0), (_RING, 1))]
    points = np.stack([np.concatenate([row, row[:1]]) for row in rows]).reshape(-1, 3)
    faces = grid(len(rows), _RING + 1)
    weights = sparse.lil_matrix((len(points), len(body.skeleton.labels)))
    ball = body.skeleton.head("toe2-1", side)[0]
    toe = np.clip(0.5 + (points[:, 0] - ball) / 0.05, 0.0, 1.0)
    weights[:, body.skeleton.bone("foot", side)] = (1 - toe)[:, None]
    weights[:, body.skeleton.bone("toe2-1", side)] = toe[:, None]
    return Garment(Piece(f"shoe_{side}", _outward(points, faces), color), points, weights.tocsr())


def _outward(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces turned so that the enclosed volume is positive."""
    a, b, c = (points[faces[:, k]] - points.mean(0) for k in range(3))
    inside_out = np.sum(a * np.cross(b, c)) < 0
    return (faces[:, ::-1] if inside_out else faces).astype(np.int32)
