"""Dresses a rest body: skin with a coloured face, shirt, trousers and shoes as skinned shells."""

from __future__ import annotations

import numpy as np
from bodies import Body
from layout import SOLE, Array, Person
from meshes import (
    Faces,
    Mask,
    Piece,
    adjacency,
    border,
    grid_faces,
    normals,
    smooth,
    subdivide,
    submesh,
    wave_noise,
)


def limb_share(body: Body, points: Array, side: str) -> Array:
    """0..1 from shoulder to elbow, 1..2 from elbow to wrist, by projection on the rest bones."""
    s, e, w = (body.head_of(f"{b}.{side}") for b in ("upperarm01", "lowerarm01", "wrist"))
    upper = ((points - s) @ (e - s)) / ((e - s) @ (e - s))
    lower = ((points - e) @ (w - e)) / ((w - e) @ (w - e))
    return np.where((upper > 1.0) | (lower > 0.12), 1.0 + np.clip(lower, 0.0, 3.0), np.clip(upper, 0.0, 1.0))


def regions(body: Body, person: Person) -> dict[str, Mask]:
    """Which vertices the clothes cover, at rest."""
    v = body.vertices
    arm = body.weight_of("upperarm", "lowerarm", "wrist", "finger", "metacarpal") > 0.5
    hip = body.head_of("upperleg01.L")[2]
    share = np.where(v[:, 0] > 0, limb_share(body, v, "L"), limb_share(body, v, "R"))
    head = body.weight_of("neck02", "neck03", "head", "eye") > 0.5
    neck = body.head_of("neck01")
    collar = v[:, 2] < neck[2] + 0.012 + 0.35 * (v[:, 1] - neck[1])
    hand = body.weight_of("wrist", "finger", "metacarpal") > 0.5
    shirt = (~head & collar & (v[:, 2] > hip - 0.015) & ~arm) | (arm & (share < person.sleeve) & ~hand)
    foot = body.weight_of("foot", "toe") > 0.5
    trousers = ~arm & (v[:, 2] < hip + 0.14) & (v[:, 2] > body.head_of("foot.L")[2] - 0.030)
    return {"shirt": shirt, "trousers": trousers, "arm": arm, "foot": foot, "head": head}


def smooth_hems(points: Array, faces: Faces) -> Array:
    """Straighten the open edges along themselves, and let the next rows follow."""
    e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, inverse, count = np.unique(np.sort(e, axis=1), axis=0, return_inverse=True, return_counts=True)
    rim = e[count[inverse.ravel()] == 1]
    chain = np.concatenate([rim, rim[:, :1]], 1)  # degenerate triangles: neighbours along the rim only
    edge = border(len(points), faces)
    moved = smooth(points, chain, 40, 0.5, ~edge) - points
    follow = np.where(edge[:, None], moved, 0.0)
    for share in (0.8, 0.6, 0.4):
        follow = np.where(edge[:, None], moved, share * smooth(follow, faces, 1, 1.0))
    return points + follow


def shell(
    body: Body, mask: Mask, thick: Array, wrinkle: float, scale: float, seed: int, rounds: int
) -> tuple[Array, Faces, Array]:
    """The masked surface moved outward by `thick`, smoothed, and kept outside the body."""
    used, faces = submesh(body.faces, mask[body.faces].all(1))
    base, weights = body.vertices[used], body.weights[used]
    normal = normals(body.vertices, body.faces)[used]
    (base, weights, thick, normal), faces = subdivide([base, weights, thick[used][:, None], normal], faces)
    edge = border(len(base), faces)
    out = base + normal * thick
    for _ in range(rounds):
        out = smooth(out, faces, 2, 0.5, edge)
        gap = ((out - base) * normal).sum(1, keepdims=True)
        out += normal * np.clip(0.7 * thick - gap, 0.0, None)
    out = smooth_hems(smooth(out, faces, 3, 0.4), faces)
    weights = smooth(weights, faces, 4, 0.5)
    bump = wave_noise(base * np.array([1.0, 1.0, 0.8]), scale, seed)
    out += normals(out, faces) * (wrinkle * bump * np.where(edge, 0.2, 1.0))[:, None]
    gap = ((out - base) * normal).sum(1, keepdims=True)
    out += normal * np.clip(np.maximum(0.005, 0.6 * thick) - gap, 0.0, None)
    return out, faces, weights / weights.sum(1, keepdims=True)


def pattern_st(body: Body, points: Array, faces: Faces, arm: Array) -> Array:
    """Pattern coordinates in metres per face corner: along and around the torso or the sleeve."""
    st = np.zeros((len(faces), 3, 2))
    on_arm = (arm[faces] > 0.5).mean(1) > 0.5
    around = np.arctan2(points[:, 0], -points[:, 1])
    st[~on_arm] = np.stack([points[:, 2], around * 0.155], 1)[faces[~on_arm]]
    for side, sign in (("L", 1), ("R", -1)):
        s, e, w = (body.head_of(f"{b}.{side}") for b in ("upperarm01", "lowerarm01", "wrist"))
        axis = (w - s) / np.linalg.norm(w - s)
        u = np.cross(axis, np.array([0.0, 1.0, 0.0]))
        u /= np.linalg.norm(u)
        bend = np.clip(((points - s) @ axis) / np.linalg.norm(w - s), 0, 1)
        mid = s + (w - s) * bend[:, None] + (e - (s + w) / 2) * (np.sin(np.pi * bend))[:, None]
        rel = points - mid
        angle = np.arctan2(rel @ np.cross(axis, u), rel @ u)
        pick = on_arm & (points[faces[:, 0], 0] * sign > 0)
        corners = angle[faces[pick]]
        corners = np.where((np.ptp(corners, axis=1) > np.pi)[:, None] & (corners < 0), corners + 2 * np.pi, corners)
        st[pick, :, 0] = ((points - s) @ axis)[faces[pick]]
        st[pick, :, 1] = corners * 0.055
    return st


def shoe(body: Body, side: str) -> tuple[Array, Faces, Array]:
    """A lofted shoe around the foot: a rounded outline per height, flat below, closed on top."""
    foot = body.weight_of(f"foot.{side}", "toe") > 0.5
    v = body.vertices[foot & ((body.vertices[:, 0] > 0) == (side == "L"))]
    v = v[v[:, 2] < 0.10]
    low, high = v.min(0), v.max(0)
    ys = np.linspace(low[1] - 0.012, high[1] + 0.010, 30)
    ring = 24
    rows = []
    for y in ys:
        near = v[np.abs(v[:, 1] - np.clip(y, low[1] + 0.012, high[1] - 0.01)) < 0.018]
        x0, x1 = near[:, 0].min() - 0.007, near[:, 0].max() + 0.007
        t = (y - low[1]) / (high[1] - low[1])
        top = 0.058 + 0.060 * np.clip((t - 0.38) / 0.34, 0, 1) ** 1.2
        pinch = np.sqrt(max(1 - max(0.0, (0.15 - t) / 0.21) ** 2, 0.02)) * np.sqrt(
            max(1 - max(0.0, (t - 0.88) / 0.17) ** 2, 0.02)
        )
        cx, half = 0.5 * (x0 + x1), 0.5 * (x1 - x0) * (0.25 + 0.75 * pinch)
        half *= 1.0 - 0.12 * np.clip((t - 0.4) / 0.3, 0, 1)
        a = np.linspace(0, 2 * np.pi, ring, endpoint=False)
        px = np.sign(np.cos(a)) * np.abs(np.cos(a)) ** 0.6 * half + cx
        pz = np.where(
            np.sin(a) > 0,
            np.abs(np.sin(a)) ** 0.8 * (top * (0.45 + 0.55 * pinch)),
            -SOLE * np.abs(np.sin(a)) ** 0.25,
        )
        rows.append(np.stack([px, np.full(ring, y), pz], 1))
    pts = np.stack([np.concatenate([r, r[:1]]) for r in rows])
    pts = np.concatenate(
        [pts[:1] * 0 + pts[:1].mean(1, keepdims=True), pts, pts[-1:] * 0 + pts[-1:].mean(1, keepdims=True)]
    )
    faces = grid_faces(len(pts), ring + 1)
    weights = np.zeros((pts.shape[0] * pts.shape[1], len(body.bones)))
    ball = body.head_of(f"toe2-1.{side}")[1]
    toe = np.clip(0.5 - (pts.reshape(-1, 3)[:, 1] - ball) / 0.05, 0.0, 1.0)
    weights[:, body.bones.index(f"foot.{side}")] = 1.0 - toe
    weights[:, body.bones.index(f"toe2-1.{side}")] = toe
    return pts.reshape(-1, 3), faces, weights


def face_colors(body: Body, person: Person, v: Array, faces: Faces, parts: dict[str, Mask]) -> Array:
    """Skin, lips, brows, lids and eyes per vertex, by position at rest."""
    color = np.tile(np.array(person.skin), (len(v), 1))
    color *= 1.0 + 0.05 * wave_noise(v, 0.05, 3)[:, None] * np.array([0.6, 1.0, 1.0])

    def of(name: str) -> Mask:
        m = np.zeros(len(v), bool)
        m[faces[parts[name]].ravel()] = True
        return m

    head = of("head")
    mouth = v[of("mouth_cavity")]
    lip = mouth[np.argsort(mouth[:, 1])[:60]]
    z_mouth, y_mouth = float(np.median(lip[:, 2])), float(lip[:, 1].min())
    dx, dz = v[:, 0] / 0.027, (v[:, 2] - z_mouth)
    bow = np.where(dz > 0, 0.0085, 0.0105) * np.sqrt(np.clip(1 - dx**2, 0, 1))
    lips = (head | of("mouth_cavity")) & (np.abs(dz) < bow) & (v[:, 1] < y_mouth + 0.025)
    skin = np.array(person.skin)
    cheeks = np.exp(-(((np.abs(v[:, 0]) - 0.045) / 0.02) ** 2) - ((v[:, 2] - z_mouth - 0.035) / 0.02) ** 2)
    color[:, 1:] *= 1 - 0.12 * (cheeks * head)[:, None]
    color[lips] = person.lips
    color[of("mouth_cavity") & ~lips] = (0.10, 0.03, 0.025)
    sock = v[:, 2] < body.head_of("foot.L")[2] + 0.10
    color[sock] = 0.35 * np.array(person.shoes)
    for side, sign in (("L", 1), ("R", -1)):
        eye = of(f"eye_front.{side}")
        c = v[eye].mean(0)
        rel = v - c
        u = rel[:, 0] * sign
        arch = 0.0195 + 0.004 * np.cos((u - 0.004) / 0.018) + np.where(u > 0.016, -0.25 * (u - 0.016), 0)
        thick = np.interp(u, [-0.02, -0.012, 0.026], [0.0048, 0.0055, 0.0030])
        brow = head & (np.abs(rel[:, 2] - arch) < thick) & (u > -0.020) & (u < 0.028) & (v[:, 1] < c[1] + 0.03)
        color[brow] = 0.75 * np.array(person.hair) + 0.25 * skin * 0.3
        color[of(f"eye_cavity.{side}") & ~eye] = skin * 0.22
        ball = eye | of(f"eye_back.{side}")
        color[ball] = (0.66, 0.63, 0.60)
        r = np.hypot(rel[:, 0], rel[:, 2])
        color[ball & (r < 0.0064)] = person.eyes
        color[ball & (r < 0.0030)] = (0.004, 0.004, 0.004)
    return color


def dress(body: Body, person: Person, seed: int) -> list[Piece]:
    """Skin, shirt, trousers and shoes of a person, at rest."""
    v = body.vertices
    reg = regions(body, person)
    hip = body.head_of("upperleg01.L")[2]
    pieces = []

    ankle_z = body.head_of("foot.L")[2]
    leg_thick = person.trouser_room * np.interp(
        v[:, 2], [ankle_z, ankle_z + 0.12, 0.5 * hip, hip, hip + 0.2], [0.026, 0.021, 0.015, 0.009, 0.006]
    )
    out, faces, weights = shell(body, reg["trousers"], leg_thick, 0.0028, 0.11, seed, 12)
    pieces.append(Piece("trousers", out, faces, "cloth", np.tile(np.array(person.trousers), (len(out), 1)), weights))

    loose = np.interp(v[:, 2], [hip - 0.02, hip + 0.10, hip + 0.25, hip + 0.5], [0.027, 0.023, 0.019, 0.010])
    shirt_thick = np.where(reg["arm"], 0.014, loose)
    out, faces, weights = shell(body, reg["shirt"], shirt_thick, 0.0030, 0.10, seed + 1, 14)
    arm = weights[:, [b.startswith(("upperarm", "lowerarm")) for b in body.bones]].sum(1)
    st = pattern_st(body, out, faces, arm)
    pieces.append(
        Piece(
            "shirt",
            out,
            faces,
            f"shirt_{person.pattern}_{person.name}",
            np.tile(np.array(person.shirt), (len(out), 1)),
            weights,
            st,
        )
    )

    for side in "LR":
        out, faces, weights = shoe(body, side)
        color = np.tile(np.array(person.shoes), (len(out), 1))
        color[out[:, 2] < 0.004] = (0.30, 0.29, 0.28) if person.name == "B" else (0.015, 0.013, 0.012)
        pieces.append(Piece(f"shoe.{side}", out, faces, "leather", color, weights))

    covered = (reg["shirt"] | reg["trousers"]).astype(float)
    adj = adjacency(len(v), body.faces)
    deep = covered.copy()
    for _ in range(3):  # keep the skin that lies within three edges of a hem
        deep = np.where(adj @ deep > 0.999, deep, 0.0)
    hidden = (deep[body.faces] > 0.5).all(1) | reg["foot"][body.faces].all(1) & (
        v[body.faces][:, :, 2].max(1) < ankle_z - 0.035
    )
    hidden |= body.parts["tongue"]
    (v2, w2), f2 = subdivide([v, body.weights], body.faces)
    parts = {k: np.tile(m, 4) for k, m in body.parts.items()}
    color = face_colors(body, person, v2, f2, parts)
    used, f3 = submesh(f2, ~np.tile(hidden, 4))
    pieces.insert(0, Piece("skin", v2[used], f3, "skin", color[used], w2[used]))
    return pieces
