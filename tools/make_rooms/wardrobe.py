"""More kinds of clothes than make_sample's: shorts, skirts, dresses, open jackets, coats, loose sweaters."""

from __future__ import annotations

from dataclasses import dataclass

import common  # noqa: F401
import numpy as np
from bodies import Body
from clothes import face_colors, pattern_st, regions, shell, shoe
from common import Array
from layout import Person
from meshes import Mask, Piece, adjacency, grid_faces, smooth, subdivide, submesh
from scipy.spatial import ConvexHull, cKDTree


@dataclass(frozen=True)
class Outfit:
    """What a person wears: upper `top`, lower `bottom`, and an `over` garment or ''."""

    top: str  # shirt, sweater
    bottom: str  # trousers, wide, shorts, skirt, dress
    over: str  # '', jacket, coat
    over_color: tuple[float, float, float]
    hem: float  # hem of a skirt or of shorts: 0 at the hip, 1 at the ankle
    loose: float  # factor on the thickness of the top


def _section(points: Array, z: float, half: float) -> Array:
    """Outline of the points near a height, as 64 radii about the x, y origin (convex)."""
    near = points[np.abs(points[:, 2] - z) < half][:, :2]
    hull = near[ConvexHull(near).vertices]
    angle = np.linspace(-np.pi, np.pi, 64, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    a, b = hull, np.roll(hull, -1, 0)
    normal = np.stack([(b - a)[:, 1], -(b - a)[:, 0]], 1)
    offset = (normal * a).sum(1)
    slope = direction @ normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(slope > 1e-9, offset / slope, np.inf)
    return radius.min(1)


def skirt(body: Body, top: float, hem: float, flare: float, margin: float, seed: int, slit: bool) -> tuple:
    """A tube round the hips and both legs; weights are those of the nearest body, evened out."""
    rng = np.random.default_rng(seed)
    arm = body.weight_of("upperarm", "lowerarm", "wrist", "finger", "metacarpal") > 0.3
    v = body.vertices[~arm]
    w = body.weights[~arm]
    centre = np.array([0.0, v[np.abs(v[:, 2] - top) < 0.03][:, 1].mean()])
    flat = v - np.array([0.0, centre[1], 0.0])
    rows, cols = 30, 65
    heights = np.linspace(top, hem, rows)
    angle = np.linspace(-np.pi, np.pi, cols)
    folds = int(rng.integers(5, 11))
    phase = rng.uniform(0, 6.28, 2)
    pts = np.zeros((rows, cols, 3))
    widest = np.zeros(64)
    for r, z in enumerate(heights):
        t = r / (rows - 1)
        radius = _section(flat, z, 0.025) + margin
        widest = np.maximum(radius, 0.985 * widest)  # cloth hangs straight down from the widest place
        radius = np.append(widest, widest[0])
        wave = np.sin(folds * angle + phase[0]) + 0.5 * np.sin((folds - 3) * angle + phase[1])
        radius = radius * (1 + flare * t) + (0.006 + 0.03 * flare) * t * wave
        pts[r] = np.stack([radius * np.cos(angle), radius * np.sin(angle) + centre[1], np.full(cols, z)], 1)
    pts = pts.reshape(-1, 3)
    faces = grid_faces(rows, cols)
    dist, index = cKDTree(v).query(pts, k=10)
    near = 1.0 / (dist + 0.01)
    weights = (w[index] * near[:, :, None]).sum(1) / near.sum(1)[:, None]
    ring = weights.reshape(rows, cols, -1)
    ring[:, 0] = ring[:, -1] = 0.5 * (ring[:, 0] + ring[:, -1])
    weights = smooth(ring.reshape(rows * cols, -1), faces, 12, 0.6)
    ring = weights.reshape(rows, cols, -1)
    ring[:, 0] = ring[:, -1] = 0.5 * (ring[:, 0] + ring[:, -1])
    weights = ring.reshape(rows * cols, -1)
    if slit:
        mid = pts[faces].mean(1)
        open_at = 0.02 + 0.10 * (top - mid[:, 2]) / (top - hem)
        faces = faces[~((mid[:, 1] < centre[1]) & (np.abs(mid[:, 0]) < open_at))]
    return pts, faces, weights / weights.sum(1, keepdims=True)


def _skin(body: Body, person: Person, covered: Mask, foot: Mask) -> Piece:
    """The skin that clothes leave bare, with a coloured face."""
    v = body.vertices
    adj = adjacency(len(v), body.faces)
    deep = covered.astype(float)
    for _ in range(3):
        deep = np.where(adj @ deep > 0.999, deep, 0.0)
    ankle = body.head_of("foot.L")[2]
    hidden = (deep[body.faces] > 0.5).all(1)
    hidden |= foot[body.faces].all(1) & (v[body.faces][:, :, 2].max(1) < ankle - 0.035)
    hidden |= body.parts["tongue"]
    (v2, w2), f2 = subdivide([v, body.weights], body.faces)
    parts = {k: np.tile(m, 4) for k, m in body.parts.items()}
    color = face_colors(body, person, v2, f2, parts)
    used, f3 = submesh(f2, ~np.tile(hidden, 4))
    return Piece("skin", v2[used], f3, "skin", color[used], w2[used])


def dress(body: Body, person: Person, outfit: Outfit, seed: int) -> list[Piece]:
    """All clothes and the bare skin, at rest."""
    v = body.vertices
    reg = regions(body, person)
    hip, ankle = body.head_of("upperleg01.L")[2], body.head_of("foot.L")[2]
    rng = np.random.default_rng(seed)
    pieces: list[Piece] = []

    def piece(name: str, mesh: tuple, material: str, color: tuple[float, float, float]) -> Piece:
        out, faces, weights = mesh
        made = Piece(name, out, faces, material, np.tile(np.array(color), (len(out), 1)), weights)
        pieces.append(made)
        return made

    covered = reg["shirt"].copy()
    hem = hip + (ankle - hip) * outfit.hem
    room = person.trouser_room * (2.0 if outfit.bottom == "wide" else 1.0)
    if outfit.bottom in ("trousers", "wide", "shorts"):
        mask = reg["trousers"] & (v[:, 2] > hem if outfit.bottom == "shorts" else True)
        low = hem if outfit.bottom == "shorts" else ankle
        thick = room * np.interp(
            v[:, 2], [low, low + 0.12, 0.5 * (low + hip), hip, hip + 0.2], [0.026, 0.022, 0.016, 0.010, 0.006]
        )
        piece("trousers", shell(body, mask, thick, 0.0028, 0.11, seed, 12), "cloth", person.trousers)
        covered |= mask
    else:
        top = hip + (0.22 if outfit.bottom == "dress" else 0.10)
        mesh = skirt(body, top, hem, float(rng.uniform(0.02, 0.22)), 0.026, seed, False)
        piece("skirt", mesh, "cloth", person.shirt if outfit.bottom == "dress" else person.trousers)
        pants = ~reg["arm"] & (v[:, 2] < hip + 0.10) & (v[:, 2] > hip - 0.12)
        piece("pants", shell(body, pants, np.full(len(v), 0.005), 0.0, 0.1, seed, 3), "cloth", person.trousers)

    drop = np.interp(v[:, 2], [hip - 0.02, hip + 0.10, hip + 0.25, hip + 0.5], [0.027, 0.023, 0.019, 0.010])
    if outfit.bottom in ("skirt", "dress"):
        drop = np.minimum(drop, np.interp(v[:, 2], [hip - 0.02, hip + 0.2, hip + 0.5], [0.008, 0.012, 0.010]))
    thick = outfit.loose * np.where(reg["arm"], 0.014, drop)
    out, faces, weights = shell(body, reg["shirt"], thick, 0.003 * outfit.loose, 0.10, seed + 1, 14)
    arm = weights[:, [b.startswith(("upperarm", "lowerarm")) for b in body.bones]].sum(1)
    made = piece("shirt", (out, faces, weights), f"shirt_{person.pattern}_{person.name}", person.shirt)
    made.st = pattern_st(body, out, faces, arm)

    if outfit.over:
        arm_share = reg["arm"] & ~(body.weight_of("wrist", "finger", "metacarpal") > 0.4)
        long = regions(body, Person(**{**person.__dict__, "sleeve": float(rng.uniform(1.8, 1.95))}))["shirt"]
        mask = long & (v[:, 2] > hip - 0.05)
        neck = body.head_of("neck01")
        gap = float(rng.uniform(0.015, 0.07))
        front = (v[:, 1] < neck[1] + 0.02) & ~arm_share
        mask &= ~(front & (np.abs(v[:, 0]) < gap + 0.03 * np.clip((v[:, 2] - neck[2] + 0.12) / 0.12, 0, 1)))
        mask &= v[:, 2] < neck[2] + 0.005 + 0.35 * (v[:, 1] - neck[1])
        more = float(rng.uniform(0.010, 0.028))
        thick = np.where(reg["arm"], outfit.loose * 0.014 + 0.6 * more, outfit.loose * drop + more)
        piece("jacket", shell(body, mask, thick, 0.0045, 0.13, seed + 3, 10), "cloth", outfit.over_color)
        if outfit.over == "coat":
            mesh = skirt(body, hip + 0.08, hip - float(rng.uniform(0.2, 0.45)), 0.06, 0.05, seed + 4, True)
            piece("coat", mesh, "cloth", outfit.over_color)

    for side in "LR":
        out, faces, weights = shoe(body, side)
        made = piece(f"shoe.{side}", (out, faces, weights), "leather", person.shoes)
        made.color[out[:, 2] < 0.004] = (0.30, 0.29, 0.28) if seed % 2 else (0.015, 0.013, 0.012)
    pieces.insert(0, _skin(body, person, covered, reg["foot"]))
    return pieces
