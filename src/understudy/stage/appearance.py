"""Dresses a rest body: skin, a painted face, hair, shirt, trousers and shoes, each a skinned mesh of one material."""

from __future__ import annotations

import colorsys
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from understudy.stage.appearance_head import eyes, face, hair
from understudy.stage.appearance_mesh import averaging, border, edges, normals, part, rim, smooth, subdivision, waves
from understudy.stage.appearance_pieces import Color, Garment, Looks, Piece
from understudy.stage.appearance_shoes import shoe
from understudy.stage.body import SIDES, Body

_SKINS: Final = ((0.94, 0.78, 0.68), (0.89, 0.70, 0.58), (0.80, 0.60, 0.47), (0.66, 0.46, 0.34), (0.48, 0.32, 0.24))
_HAIRS: Final = ((0.10, 0.08, 0.07), (0.20, 0.13, 0.09), (0.34, 0.22, 0.13), (0.58, 0.43, 0.25), (0.45, 0.43, 0.41))
_EYES: Final = ((0.25, 0.15, 0.08), (0.35, 0.25, 0.12), (0.30, 0.42, 0.50), (0.32, 0.42, 0.30))


def draw_looks(rng: np.random.Generator, female: bool) -> Looks:
    """Random looks; shirt and trousers differ in brightness, so that one is told from the other."""
    skin = _SKINS[rng.integers(len(_SKINS))]
    dark = skin[0] < 0.75
    hair = _HAIRS[rng.integers(2 if dark else len(_HAIRS))]
    bright = bool(rng.random() < 0.6)
    shirt = _color(rng, (0.55, 0.9) if bright else (0.2, 0.45), (0.15, 0.75))
    trousers = _color(rng, (0.15, 0.38) if bright else (0.5, 0.75), (0.1, 0.45))
    shoes = _color(rng, (0.1, 0.35) if rng.random() < 0.6 else (0.7, 0.9), (0.0, 0.2))
    sleeve = rng.uniform(0.5, 0.8) if rng.random() < 0.5 else rng.uniform(1.80, 1.93)
    eyes = _EYES[0 if dark else rng.integers(len(_EYES))]
    return Looks(
        skin, hair, eyes, shirt, trousers, shoes, float(sleeve), bool(rng.random() < (0.7 if female else 0.06))
    )


def _color(rng: np.random.Generator, value: tuple[float, float], saturation: tuple[float, float]) -> Color:
    return colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value))


def dress(body: Body, looks: Looks, rng: np.random.Generator) -> list[Garment]:
    """All that is seen of a person, at rest; less than 25 000 vertices."""
    v, s = body.vertices, body.skeleton
    arm = body.weight_of("upperarm", "lowerarm", "wrist", "finger", "metacarpal") > 0.5
    shirt, trousers, foot = _regions(body, looks.sleeve, arm)
    hip, ankle = s.head("upperleg01", "left")[2], s.head("foot", "left")[2]
    leg = np.interp(v[:, 2], [ankle, ankle + 0.12, 0.5 * hip, hip, hip + 0.2], [0.024, 0.020, 0.015, 0.009, 0.006])
    loose = np.interp(v[:, 2], [hip - 0.02, hip + 0.10, hip + 0.25, hip + 0.5], [0.026, 0.023, 0.018, 0.010])
    out = [
        _shell(body, "trousers", trousers, leg, looks.trousers, rng),
        _shell(body, "shirt", shirt, np.where(arm, 0.013, loose), looks.shirt, rng),
        *(shoe(body, side, looks.shoes) for side in SIDES),
    ]
    seen = ~_covered(body, shirt | trousers, foot, ankle)
    front = face(body, looks, rng)
    skin = seen & ~front.faces & ~_inner(body)
    used, faces = part(body.faces, skin)
    out.append(Garment(Piece("skin", faces.astype(np.int32), looks.skin), v[used], body.weights[used]))
    return [*out, front.garment, eyes(body, looks), hair(body, looks, rng)]


def _inner(body: Body) -> Bool[np.ndarray, " f"]:
    """Faces that no one sees, or that are made by themselves: eyes, what lies behind them, and the mouth's inside."""
    names = [name for name in body.parts if name != "head"]
    return np.any([body.parts[name] for name in names], axis=0)


def _regions(
    body: Body, sleeve: float, arm: Bool[np.ndarray, " v"]
) -> tuple[Bool[np.ndarray, " v"], Bool[np.ndarray, " v"], Bool[np.ndarray, " v"]]:
    """Vertices under the shirt, under the trousers, and of the feet."""
    v, s = body.vertices, body.skeleton
    hip, neck = s.head("upperleg01", "left")[2], s.head("neck01")
    down = np.where(v[:, 1] > 0, _down_the_arm(body, "left"), _down_the_arm(body, "right"))
    head = body.weight_of("neck02", "neck03", "head", "eye") > 0.5
    hand = body.weight_of("wrist", "finger", "metacarpal") > 0.5
    collar = v[:, 2] < neck[2] + 0.012 - 0.35 * (v[:, 0] - neck[0])
    shirt = (~head & collar & (v[:, 2] > hip - 0.02) & ~arm) | (arm & (down < sleeve) & ~hand)
    trousers = ~arm & (v[:, 2] < hip + 0.14) & (v[:, 2] > s.head("foot", "left")[2] - 0.030)
    return shirt, trousers, body.weight_of("foot", "toe") > 0.5


def _down_the_arm(body: Body, side: str) -> Float[np.ndarray, " v"]:
    """0 to 1 from shoulder to elbow, 1 to 2 from elbow to wrist, by projection on the bones."""
    s, e, w = (body.skeleton.head(name, side) for name in ("upperarm01", "lowerarm01", "wrist"))
    upper = (body.vertices - s) @ (e - s) / ((e - s) @ (e - s))
    lower = (body.vertices - e) @ (w - e) / ((w - e) @ (w - e))
    return np.where((upper > 1) | (lower > 0.12), 1 + np.clip(lower, 0, 3), np.clip(upper, 0, 1))


def _covered(
    body: Body, cloth: Bool[np.ndarray, " v"], foot: Bool[np.ndarray, " v"], ankle: float
) -> Bool[np.ndarray, " f"]:
    """Faces of the skin under clothes; those within three edges of a hem are kept."""
    mean = averaging(len(cloth), edges(body.faces))
    deep = cloth.astype(float)
    for _ in range(3):
        deep = np.where(mean @ deep > 0.999, deep, 0.0)
    in_shoe = foot[body.faces].all(1) & (body.vertices[body.faces][:, :, 2].max(1) < ankle - 0.03)
    return (deep[body.faces] > 0.5).all(1) | in_shoe


def _shell(
    body: Body,
    name: str,
    mask: Bool[np.ndarray, " v"],
    thick: Float[np.ndarray, " v"],
    color: Color,
    rng: np.random.Generator,
) -> Garment:
    """The masked surface moved outward, smoothed and slightly wrinkled, but kept outside of the body."""
    used, faces = part(body.faces, mask[body.faces].all(1))
    split, faces = subdivision(len(used), faces)
    base, weights = split @ body.vertices[used], split @ body.weights[used]
    normal = split @ normals(body.vertices, body.faces)[used]
    thickness = (split @ thick[used])[:, None]
    edge, mean = border(len(base), faces), averaging(len(base), edges(faces))

    def outside(points: Float[np.ndarray, "v 3"], least: Float[np.ndarray, "v 1"]) -> Float[np.ndarray, "v 3"]:
        gap = ((points - base) * normal).sum(1, keepdims=True)
        return points + normal * np.clip(least - gap, 0, None)

    out = base + normal * thickness
    for _ in range(12):
        out = outside(smooth(out, mean, 2, 0.5, edge), 0.7 * thickness)
    out = _straight_hems(smooth(out, mean, 3, 0.4), faces, mean, edge)
    folds = waves(base, 0.10, rng) * np.where(edge, 0.2, 1.0)
    out = out + normals(out, faces) * (0.003 * folds)[:, None]
    out = outside(out, np.maximum(0.005, 0.6 * thickness))
    for _ in range(4):
        weights = 0.5 * weights + 0.5 * (mean @ weights)
    return Garment(Piece(name, faces.astype(np.int32), color), out, weights.tocsr())


def _straight_hems(
    points: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    mean: sparse.csr_matrix,
    edge: Bool[np.ndarray, " v"],
) -> Float[np.ndarray, "v 3"]:
    """Open edges smoothed along themselves; the next rows follow."""
    moved = smooth(points, averaging(len(points), rim(faces)), 40, 0.5, ~edge) - points
    follow = moved
    for share in (0.8, 0.6, 0.4):
        follow = np.where(edge[:, None], moved, share * (mean @ follow))
    return points + follow
