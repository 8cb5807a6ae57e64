"""Hair: a thick cap over the scalp, or a chin-length bob around the head."""

from __future__ import annotations

import numpy as np
from bodies import Body
from layout import Array, Person
from meshes import Piece, border, grid_faces, normals, smooth, subdivide, submesh, wave_noise


def _landmarks(body: Body) -> tuple[float, float, float]:
    """Eye height, ear y and eye y at rest."""
    eye = 0.5 * (body.coco["left_eye"] + body.coco["right_eye"])
    ear = 0.5 * (body.coco["left_ear"] + body.coco["right_ear"])
    return float(eye[2]), float(ear[1]), float(eye[1])


def short_hair(body: Body, person: Person, seed: int) -> Piece:
    """The scalp moved outward by one to two and a half centimetres."""
    z_eye, y_ear, _ = _landmarks(body)
    v = body.vertices
    head = np.zeros(len(v), bool)
    head[body.faces[body.parts["head"]].ravel()] = True
    azimuth = np.degrees(np.abs(np.arctan2(v[:, 0], -(v[:, 1] - y_ear))))
    line = np.interp(
        azimuth,
        [0, 28, 50, 66, 76, 90, 108, 122, 150, 180],
        [0.062, 0.064, 0.052, 0.030, 0.012, 0.030, 0.022, -0.030, -0.055, -0.060],
    )
    mask = head & (v[:, 2] > z_eye + line - 0.012)
    used, faces = submesh(body.faces, mask[body.faces].all(1))
    arrays = [v[used], normals(v, body.faces)[used], (v[:, 2] - z_eye - line)[used][:, None]]
    for _ in range(2):
        arrays, faces = subdivide(arrays, faces)
    used, faces = submesh(faces, (arrays[2][:, 0] > 0)[faces].any(1))
    base, normal = arrays[0][used], arrays[1][used]
    edge = border(len(base), faces)
    inner = np.clip(smooth(np.where(edge, 0.0, 1.0)[:, None], faces, 24), 0, 1)[:, 0]
    top = np.clip((base[:, 2] - z_eye - 0.02) / 0.09, 0, 1)
    thick = (0.003 + (0.006 + 0.012 * top) * inner)[:, None]
    out = smooth(base + normal * thick, faces, 14, 0.5, edge)
    gap = ((out - base) * normal).sum(1, keepdims=True)
    out += normal * np.clip(0.0035 - gap, 0, None)
    out += normals(out, faces) * (0.0022 * wave_noise(out, 0.022, seed) * inner)[:, None]
    return _piece(body, person, out, faces, seed)


def bob(body: Body, person: Person, seed: int) -> Piece:
    """Rows from the crown down; the face is left open."""
    z_eye, _y_ear, _ = _landmarks(body)
    v = body.vertices
    head = np.zeros(len(v), bool)
    head[body.faces[body.parts["head"]].ravel()] = True
    skull = v[head & (v[:, 2] > z_eye + 0.035)]
    low, high = skull.min(0), skull.max(0)
    centre = np.array([0.0, 0.5 * (low[1] + high[1]), z_eye + 0.022])
    half = np.array([0.5 * (high[0] - low[0]) + 0.014, 0.5 * (high[1] - low[1]) + 0.017, high[2] - centre[2] + 0.018])
    rows, cols = 46, 120
    azimuth = np.linspace(-np.pi, np.pi, cols)  # 0 is the face
    drop = 0.18  # below the widest row
    pts = np.zeros((rows, cols, 3))
    cap = 22
    for r in range(rows):
        if r < cap:
            polar = 0.5 * np.pi * (0.02 + 0.98 * r / (cap - 1))
            ring, z = np.sin(polar) ** 0.92, centre[2] + half[2] * np.cos(polar)
        else:
            s = (r - cap + 1) / (rows - cap)
            ring, z = 1.0 + 0.20 * np.sin(np.pi * min(s, 1.0) * 0.72) - 0.10 * s**3, centre[2] - drop * s
        pts[r, :, 0] = half[0] * ring * np.sin(azimuth)
        pts[r, :, 1] = centre[1] - half[1] * ring * np.cos(azimuth)
        pts[r, :, 2] = z
        if r >= cap:  # the neck side hangs closer in
            s = (r - cap + 1) / (rows - cap)
            rear = np.clip(-np.cos(azimuth), 0, 1)
            pts[r, :, 1] -= 0.030 * s * rear
    flat = pts.reshape(-1, 3)
    strands = np.repeat(np.arange(rows), cols)
    turn = np.tile(azimuth, rows)
    out_dir = (flat - centre) * np.array([1, 1, 0.3])
    out_dir /= np.linalg.norm(out_dir, axis=1, keepdims=True)
    amount = np.clip(strands / cap, 0.05, 1.0)
    groove = np.sin(turn * 23 + 2 * wave_noise(flat, 0.09, seed)) * 0.0016 + 0.002 * wave_noise(flat, 0.05, seed + 1)
    flat = flat + out_dir * (groove * amount)[:, None]
    faces = grid_faces(rows, cols)
    mid = flat[faces].mean(1)
    phi = np.degrees(np.abs(np.arctan2(mid[:, 0] / half[0], -(mid[:, 1] - centre[1]) / half[1])))
    rel = mid[:, 2] - z_eye
    part = 0.006 * np.sign(mid[:, 0] + 0.02)  # parted on one side
    open_at = np.interp(rel, [-0.15, -0.08, -0.03, 0.02, 0.045, 0.062, 0.073, 0.079], [50, 56, 62, 60, 51, 36, 16, 0])
    keep = (phi > open_at + 700 * part * np.clip(rel / 0.06, 0, 1)) & (rel < 0.079) | (rel >= 0.079)
    used, faces = submesh(faces, keep)
    return _piece(body, person, flat[used], faces, seed)


def _piece(body: Body, person: Person, points: Array, faces: Array, seed: int) -> Piece:
    weights = np.zeros((len(points), len(body.bones)))
    weights[:, body.bones.index("head")] = 1.0
    streak = 1.0 + 0.35 * wave_noise(points * np.array([3.0, 3.0, 0.6]), 0.05, seed + 7)
    color = np.array(person.hair) * np.clip(streak, 0.4, 2.0)[:, None]
    return Piece("hair", points, faces, "hair", color, weights)


def make_hair(body: Body, person: Person, seed: int) -> Piece:
    """The hair piece of a person."""
    return (bob if person.hair_style == "bob" else short_hair)(body, person, seed)
