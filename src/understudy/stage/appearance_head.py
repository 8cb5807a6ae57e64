"""A painted face, eyes, and hair. Pictures of face and eyes are projected along the body's x axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.ndimage import gaussian_filter

from understudy.stage.appearance_mesh import (
    averaging,
    border,
    edges,
    grid,
    normals,
    part,
    smooth,
    subdivision,
    waves,
)
from understudy.stage.appearance_pieces import Color, Garment, Looks, Piece
from understudy.stage.body import Body

_WIDE, _BELOW, _ABOVE = 0.085, 0.14, 0.10  # metres of the face's picture beside the nose, below and above the eyes
_PIXEL: Final = 0.0007  # metres
_EYE_M: Final = 0.034  # side of an eye's picture


@dataclass(frozen=True, eq=False)
class Face:
    """The front of the head."""

    garment: Garment
    faces: Bool[np.ndarray, " f"]
    """which faces of the body it is"""


def _spots(body: Body) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Left and right eye, middle of the lips, tip of the nose, at rest."""
    eyes = np.stack([body.vertices[np.unique(body.faces[body.parts[f"eye_front.{s}"]])].mean(0) for s in "LR"])
    mouth = body.vertices[np.unique(body.faces[body.parts["mouth_cavity"]])]
    lips = mouth[np.argsort(-mouth[:, 0])[:60]]
    return eyes, np.array([lips[:, 0].max(), 0.0, np.median(lips[:, 2])]), body.skeleton.face[0]


def face(body: Body, looks: Looks, rng: np.random.Generator) -> Face:
    """The part of the head that looks forward, with brows, lips, nostrils and shades painted on."""
    eyes, _, _ = _spots(body)
    level = eyes[:, 2].mean()
    middle = body.vertices[body.faces].mean(1)
    facing = normals(body.vertices, body.faces)[body.faces].mean(1)[:, 0] > 0.1
    ear = body.skeleton.face[3, 0]
    inside = (np.abs(middle[:, 1]) < _WIDE - 0.008) & (middle[:, 2] > level - _BELOW + 0.008)
    inside &= (middle[:, 2] < level + _ABOVE - 0.008) & (middle[:, 0] > ear + 0.02)
    chosen = body.parts["head"] & facing & inside
    used, faces = part(body.faces, chosen)
    points = body.vertices[used]
    uv = np.column_stack([0.5 - points[:, 1] / (2 * _WIDE), (level + _ABOVE - points[:, 2]) / (_ABOVE + _BELOW)])
    piece = Piece("face", faces.astype(np.int32), looks.skin, _face_picture(body, looks, rng), np.clip(uv, 0, 1))
    return Face(Garment(piece, points, body.weights[used]), chosen)


def _face_picture(body: Body, looks: Looks, rng: np.random.Generator) -> np.ndarray:
    """Seen along +x, so the person's left (+y) is on the picture's left."""
    eyes, lips, nose = _spots(body)
    level = eyes[:, 2].mean()
    h, w = round((_ABOVE + _BELOW) / _PIXEL), round(2 * _WIDE / _PIXEL)
    y = _WIDE - (np.arange(w) + 0.5)[None] * _PIXEL
    z = level + _ABOVE - (np.arange(h) + 0.5)[:, None] * _PIXEL
    skin = np.array(looks.skin)
    picture = np.tile(skin, (h, w, 1))

    def paint(mask: np.ndarray, color: np.ndarray, blur: float, strength: float = 1.0) -> None:
        soft = strength * gaussian_filter(mask.astype(float), blur)[..., None]
        picture[:] = picture * (1 - soft) + soft * color

    cheeks = np.exp(-(((np.abs(y) - 0.042) / 0.018) ** 2) - ((z - lips[2] - 0.035) / 0.018) ** 2)
    paint(cheeks, skin * [1.0, 0.78, 0.75], 1, 0.35)
    for eye, sign in zip(eyes, (1, -1), strict=True):
        u, v = (y - eye[1]) * sign, z - eye[2]
        paint((u / 0.021) ** 2 + ((v - 0.002) / 0.014) ** 2 < 1, skin * 0.62, 3, 0.6)
        paint((u / 0.0175) ** 2 + (v / 0.0085) ** 2 < 1, skin * 0.25, 1, 0.9)
        arch = 0.0195 + 0.004 * np.cos((u - 0.004) / 0.018) - 0.25 * np.clip(u - 0.016, 0, None)
        thick = np.interp(u, [-0.02, -0.012, 0.028], [0.0036, 0.0044, 0.0022])
        brow = (np.abs(v - arch) < thick) & (u > -0.019) & (u < 0.028)
        paint(brow, 0.8 * np.array(looks.hair) + 0.1 * skin, 1.2, 0.95)
        paint(((y - sign * 0.0075) / 0.0048) ** 2 + ((z - nose[2] + 0.010) / 0.0032) ** 2 < 1, skin * 0.3, 1.5, 0.8)
        side = np.exp(-(((y - sign * 0.013) / 0.004) ** 2) - ((z - nose[2] - 0.012) / 0.022) ** 2)
        paint(side, skin * 0.7, 1, 0.35)
    dz = z - lips[2]
    bow = np.where(dz > 0, 0.0080, 0.0100) * np.sqrt(np.clip(1 - (y / 0.026) ** 2, 0, 1))
    red = skin * [0.82, 0.52, 0.52] if rng.random() < 0.7 else skin * [0.85, 0.42, 0.45]
    paint(np.abs(dz) < bow, red, 1)
    paint((np.abs(dz) < 0.0011) & (np.abs(y) < 0.025), skin * 0.25, 0.8)
    paint((np.abs(dz + 0.015) < 0.003) & (np.abs(y) < 0.014), skin * 0.75, 3, 0.4)
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def eyes(body: Body, looks: Looks) -> Garment:
    """Both eyeballs' fronts: white, iris and pupil."""
    points, faces, weights, uv = [], [], [], []
    count = 0
    for side in "LR":
        used, own = part(body.faces, body.parts[f"eye_front.{side}"])
        spots = body.vertices[used]
        off = (spots - spots.mean(0)) / _EYE_M
        points.append(spots)
        faces.append(own + count)
        weights.append(body.weights[used])
        uv.append(np.clip(np.column_stack([0.5 - off[:, 1], 0.5 - off[:, 2]]), 0, 1))
        count += len(used)
    n = 96
    at = ((np.arange(n) + 0.5) / n - 0.5) * _EYE_M
    radius = np.hypot(at[None], at[:, None])
    picture = np.tile(np.array([0.90, 0.88, 0.86]), (n, n, 1))
    picture[radius < 0.0066] = looks.eyes
    picture[radius < 0.0032] = 0.02
    texture = np.round(255 * np.stack([gaussian_filter(picture[..., k], 0.8) for k in range(3)], -1)).astype(np.uint8)
    piece = Piece("eyes", np.concatenate(faces).astype(np.int32), (0.9, 0.88, 0.86), texture, np.concatenate(uv))
    return Garment(piece, np.concatenate(points), sparse.vstack(weights).tocsr())


def hair(body: Body, looks: Looks, rng: np.random.Generator) -> Garment:
    """A thick cap over the scalp, or hair down to the chin all around but the face."""
    return _bob(body, looks.hair, rng) if looks.long_hair else _short_hair(body, looks.hair, rng)


def _short_hair(body: Body, color: Color, rng: np.random.Generator) -> Garment:
    """The scalp moved outward by one to two centimetres."""
    v, level, ear = body.vertices, _spots(body)[0][:, 2].mean(), body.skeleton.face[3, 0]
    head = np.zeros(len(v), bool)
    head[body.faces[body.parts["head"]].ravel()] = True
    azimuth = np.degrees(np.abs(np.arctan2(v[:, 1], v[:, 0] - ear)))  # 0 is the face
    line = np.interp(
        azimuth,
        [0, 28, 50, 66, 76, 90, 108, 122, 150, 180],
        [0.062, 0.064, 0.052, 0.030, 0.012, 0.030, 0.022, -0.030, -0.055, -0.060],
    )
    above = v[:, 2] - level - line
    used, faces = part(body.faces, (head & (above > -0.012))[body.faces].all(1))
    values = np.column_stack([v[used], normals(v, body.faces)[used], above[used]])
    split, faces = subdivision(len(used), faces)
    values = split @ values
    keep, faces = part(faces, (values[:, 6] > 0)[faces].any(1))
    base, normal = values[keep, :3], values[keep, 3:6]
    edge, mean = border(len(base), faces), averaging(len(base), edges(faces))
    inner = np.clip(smooth(np.where(edge, 0.0, 1.0)[:, None], mean, 12), 0, 1)
    top = np.clip((base[:, 2:] - level - 0.02) / 0.09, 0, 1)
    out = smooth(base + normal * (0.003 + (0.006 + 0.012 * top) * inner), mean, 6, 0.5, edge)
    out += normal * np.clip(0.0035 - ((out - base) * normal).sum(1, keepdims=True), 0, None)
    out += normals(out, faces) * (0.002 * waves(out, 0.03, rng))[:, None] * inner
    return Garment(Piece("hair", faces.astype(np.int32), color), out, _on_head(body, len(out)))


def _bob(body: Body, color: Color, rng: np.random.Generator) -> Garment:
    """Rings from the crown down to the chin; the faces before the face are left out."""
    v, level = body.vertices, _spots(body)[0][:, 2].mean()
    head = np.zeros(len(v), bool)
    head[body.faces[body.parts["head"]].ravel()] = True
    skull = v[head & (v[:, 2] > level + 0.035)]
    low, high = skull.min(0), skull.max(0)
    middle = np.array([0.5 * (low[0] + high[0]), 0.0, level + 0.022])
    half = np.array([0.5 * (high[0] - low[0]) + 0.017, high[1] + 0.014, high[2] - middle[2] + 0.018])
    rows, columns, cap, drop = 30, 64, 14, rng.uniform(0.14, 0.24)
    azimuth = np.linspace(-np.pi, np.pi, columns)  # 0 is the face
    points = np.empty((rows, columns, 3))
    for r in range(rows):
        down = max(0.0, (r - cap + 1) / (rows - cap))
        polar = 0.5 * np.pi * (0.02 + 0.98 * min(r / (cap - 1), 1.0))
        ring = np.sin(polar) ** 0.92 + 0.20 * np.sin(0.72 * np.pi * down) - 0.10 * down**3
        points[r, :, 0] = middle[0] + half[0] * ring * np.cos(azimuth) + 0.03 * down * np.clip(-np.cos(azimuth), 0, 1)
        points[r, :, 1] = half[1] * ring * np.sin(azimuth)
        points[r, :, 2] = middle[2] + half[2] * np.cos(polar) - drop * down
    flat = points.reshape(-1, 3)
    outward = (flat - middle) * [1, 1, 0.3]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    flat = flat + outward * (0.0025 * waves(flat * [1, 1, 0.3], 0.03, rng))[:, None]
    faces = grid(rows, columns)
    at = flat[faces].mean(1)
    phi = np.degrees(np.abs(np.arctan2(at[:, 1] / half[1], (at[:, 0] - middle[0]) / half[0])))
    rise = at[:, 2] - level
    open_at = np.interp(rise, [-0.15, -0.08, -0.03, 0.02, 0.045, 0.062, 0.073, 0.079], [50, 56, 62, 60, 51, 36, 16, 0])
    used, faces = part(faces, (phi > open_at) | (rise >= 0.079))
    inside = np.sum(normals(flat[used], faces) * outward[used]) < 0
    piece = Piece("hair", (faces[:, ::-1] if inside else faces).astype(np.int32), color)
    return Garment(piece, flat[used], _on_head(body, len(used)))


def _on_head(body: Body, count: int) -> sparse.csr_matrix:
    rows, bone = np.arange(count), np.full(count, body.skeleton.bone("head"))
    return sparse.csr_matrix((np.ones(count), (rows, bone)), shape=(count, len(body.skeleton.labels)))
