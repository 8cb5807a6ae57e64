"""Random people: sex, age, build, stature, colours, clothes and hair, as dressed rest bodies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import common  # noqa: F401
import numpy as np
from bodies import PARTS, Body
from common import Array, Rng
from hair import make_hair
from layout import Person
from meshes import Faces, Piece, grid_faces
from wardrobe import Outfit, dress

Color = tuple[float, float, float]


@dataclass
class Dressed:
    """A rest body with its clothes; `dark` tells how badly every piece reflects infrared."""

    person: Person
    outfit: Outfit
    body: Body
    pieces: list[Piece]
    dark: list[float]


@cache
def _model() -> tuple[Any, Any, dict[str, Array], Faces, Array]:
    import anny
    from anny.face_segmentation import get_face_segmentation_mask
    from anny.keypoints import KeypointsRegressor

    model = anny.Anny(rig="anny", topology="anny", phenotypes="all", facial_actions="all")
    parts = {p: get_face_segmentation_mask(model, [p]).numpy() for p in PARTS}
    weights = np.zeros((len(model.template_vertices), model.bone_count))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    return model, KeypointsRegressor.coco(model), parts, model.faces.numpy().astype(np.int64), weights


def build_body(person: Person) -> Body:
    """The rest body; the phenotype's height is solved for the stature (as near as the model goes)."""
    import torch

    model, regressor, parts, faces, weights = _model()

    def rest(height: float) -> Any:
        shape = {k: torch.tensor([x], dtype=torch.float64) for k, x in person.phenotype.items()}
        shape["height"] = torch.tensor([height], dtype=torch.float64)
        face = {k: torch.tensor([x], dtype=torch.float64) for k, x in person.face.items()}
        with torch.no_grad():
            return model(phenotype_kwargs=shape, facial_actions=face)

    low, high = 0.0, 1.0
    for _ in range(11):
        mid = 0.5 * (low + high)
        if np.ptp(rest(mid)["rest_vertices"][0].numpy()[:, 2]) < person.stature:
            low = mid
        else:
            high = mid
    out = rest(0.5 * (low + high))
    vertices = out["rest_vertices"][0].numpy()
    points = regressor({"vertices": out["rest_vertices"]})[0].numpy()
    up = np.array([0.0, 0.0, -vertices[:, 2].min()])
    coco = dict(zip(regressor.labels, points + up, strict=True))
    heads = out["rest_bone_heads"][0].numpy() + up
    parents = [int(p) for p in model.bone_parents]
    return Body(vertices + up, faces, list(model.bone_labels), parents, heads, weights, coco, parts)


def _color(rng: Rng) -> Color:
    """A cloth colour, linear: dark, grey, light or bright."""
    kind = rng.choice(4, p=[0.35, 0.2, 0.2, 0.25])
    if kind == 0:
        base = rng.uniform(0.012, 0.09) * rng.uniform(0.6, 1.4, 3)
    elif kind == 1:
        base = rng.uniform(0.1, 0.4) * rng.uniform(0.85, 1.15, 3)
    elif kind == 2:
        base = rng.uniform(0.5, 0.8) * rng.uniform(0.9, 1.0, 3)
    else:
        base = rng.uniform(0.02, 0.65, 3)
    return tuple(float(c) for c in base)


def random_person(rng: Rng, name: str) -> tuple[Person, Outfit]:
    """Who it is and what is worn."""
    female = rng.random() < 0.5
    child = rng.random() < 0.08
    stature = float(np.clip(rng.normal(1.629, 0.07) if female else rng.normal(1.756, 0.078), 1.48, 1.98))
    if child:
        stature = float(rng.uniform(1.18, 1.50))
    race = rng.dirichlet([0.7, 0.7, 0.7])
    phenotype = {
        "gender": float(rng.uniform(0.85, 1.0) if female else rng.uniform(0.0, 0.15)),
        "age": float(rng.uniform(0.36, 0.5) if child else rng.uniform(0.6, 0.95)),
        "muscle": float(rng.uniform(0.3, 0.8)),
        "weight": float(np.clip(rng.normal(0.5, 0.17), 0.2, 0.92)),
        "proportions": float(rng.uniform(0.25, 0.9)),
        "cupsize": float(rng.uniform(0.3, 0.75)),
        "firmness": float(rng.uniform(0.3, 0.7)),
        "african": float(race[0]),
        "asian": float(race[1]),
        "caucasian": float(race[2]),
    }
    tone = float(np.clip(0.75 * race[0] + rng.normal(0.15, 0.12), 0, 1))
    skin = np.array([0.62, 0.36, 0.25]) * (1 - tone) + np.array([0.10, 0.045, 0.025]) * tone
    dark_hair = np.array([0.02, 0.012, 0.008])
    hairs = [dark_hair, dark_hair * 1.5, np.array([0.10, 0.05, 0.02]), np.array([0.32, 0.2, 0.09]), np.full(3, 0.4)]
    hair = hairs[int(rng.choice(5, p=[0.4, 0.2, 0.18, 0.12, 0.1]))]
    style = str(rng.choice(["bob", "long", "bun", "short"], p=[0.3, 0.3, 0.2, 0.2]) if female else "short")
    if not female and rng.random() < 0.18:
        style = "bald"
    shirt = _color(rng)
    person = Person(
        name,
        stature,
        phenotype,
        skin=tuple(float(c) for c in skin),
        hair=tuple(float(c) for c in hair),
        eyes=(0.08, 0.05, 0.03),
        lips=tuple(float(c) for c in skin * [0.8, 0.45, 0.5]),
        shirt=shirt,
        shirt2=shirt,
        pattern="check" if rng.random() < 0.15 else "plain",
        trousers=_color(rng),
        shoes=_color(rng),
        sleeve=float(rng.choice([rng.uniform(0.3, 0.8), rng.uniform(1.2, 1.5), rng.uniform(1.85, 1.95)])),
        hair_style=style,
        trouser_room=float(rng.uniform(0.8, 1.6)),
        face={"mouthSmileLeft": float(rng.uniform(0, 0.4)), "mouthSmileRight": float(rng.uniform(0, 0.4))},
    )
    odds = [0.45, 0.12, 0.13, 0.15, 0.15] if female else [0.65, 0.17, 0.18, 0.0, 0.0]
    bottom = str(rng.choice(["trousers", "wide", "shorts", "skirt", "dress"], p=odds))
    over = str(rng.choice(["", "jacket", "coat"], p=[0.62, 0.26, 0.12]))
    if bottom in ("skirt", "dress") and over == "coat":
        over = "jacket"
    sweater = rng.random() < 0.3
    hem = float(rng.uniform(0.36, 0.56)) if bottom == "shorts" else float(rng.uniform(0.38, 0.82))
    loose = float(rng.uniform(1.3, 2.0) if sweater else rng.uniform(0.7, 1.2))
    return person, Outfit("sweater" if sweater else "shirt", bottom, over, _color(rng), hem, loose)


def _ball(centre: Array, radius: Array) -> tuple[Array, Faces]:
    a, b = np.meshgrid(np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 21), indexing="ij")
    unit = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], -1).reshape(-1, 3)
    return centre + unit * radius, grid_faces(13, 21)


def _hair(body: Body, person: Person, seed: int) -> list[Piece]:
    """Bald, short, bob, long (a bob that hangs down to the shoulder blades behind) or with a bun."""
    if person.hair_style == "bald":
        return []
    if person.hair_style in ("bob", "long"):
        made = make_hair(body, Person(**{**person.__dict__, "hair_style": "bob"}), seed)
        if person.hair_style == "long":  # pull the lower rows further down, close to the back
            v = made.vertices
            ear = 0.5 * (body.coco["left_ear"] + body.coco["right_ear"])
            t = np.clip((ear[2] - v[:, 2]) / 0.16, 0, 1)
            rear = v[:, 1] > ear[1] - 0.02
            v[:, 2] -= np.where(rear, 0.16 * t**1.5, 0.0)
            v[:, 1] += np.where(rear, 0.045 * t**2, 0.0)
        return [made]
    cap = make_hair(body, Person(**{**person.__dict__, "hair_style": "short"}), seed)
    if person.hair_style == "short":
        return [cap]
    rng = np.random.default_rng(seed)
    high = cap.vertices[cap.vertices[:, 1].argmax()]
    size = rng.uniform(0.035, 0.055)
    v, f = _ball(high + np.array([0, 0.5 * size, rng.uniform(0.0, 0.07)]), np.array([size, 0.8 * size, size]))
    weights = np.zeros((len(v), len(body.bones)))
    weights[:, body.bones.index("head")] = 1.0
    return [cap, Piece("bun", v, f, "hair", np.tile(np.array(person.hair), (len(v), 1)), weights)]


def make_dressed(rng: Rng, name: str) -> Dressed:
    """A new person, dressed."""
    person, outfit = random_person(rng, name)
    seed = int(rng.integers(1 << 30))
    body = build_body(person)
    pieces = dress(body, person, outfit, seed) + _hair(body, person, seed + 5)
    dark = []
    for piece in pieces:
        light = float(piece.color.mean())
        if piece.material == "hair":
            dark.append(float(np.clip(0.62 - 2.0 * light, 0.0, 0.6)))
        elif piece.material == "skin":
            dark.append(0.0)
        else:
            dark.append(float(np.clip(0.14 - 2.5 * light, 0.0, 0.14)) * float(rng.random() < 0.6))
    return Dressed(person, outfit, body, pieces, dark)
