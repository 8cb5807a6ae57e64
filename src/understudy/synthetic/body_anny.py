"""Bodies of the parametric model anny (Apache-2.0, data CC0): adults of all builds with ANSUR II's statures."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.ansur import bones, draw_lengths, draw_sex, draw_stature
from understudy.synthetic.bodies import BodyBank
from understudy.synthetic.segments import JOINT_SEGMENT, PARENTS, SEGMENT, SEGMENTS
from understudy.synthetic.surface import SIDES, alignment, drape, even_samples, regions, vertex_normals

HIDDEN = ("eye_back.L", "eye_back.R", "eye_cavity.L", "eye_cavity.R", "mouth_cavity", "tongue")
"""Parts of the mesh inside the head."""

CHUNK = 32
"""Bodies made at once."""

_BONES = {
    "pelvis": ("root", "pelvis.", "spine05"),
    "abdomen": ("spine04", "spine03"),
    "chest": ("spine02", "spine01"),
    "neck": ("neck0",),
    "head": ("head", "eye."),
    "clavicle": ("clavicle", "shoulder01"),
    "upper_arm": ("upperarm",),
    "forearm": ("lowerarm",),
    "hand": ("wrist", "metacarpal", "finger1-"),
    "fingers": ("finger2-", "finger3-", "finger4-", "finger5-"),
    "thigh": ("upperleg",),
    "shin": ("lowerleg",),
    "foot": ("foot", "toe"),
}
"""Segment (without its side) -> beginnings of the names of anny's bones."""

_ORIGIN = {
    "abdomen": "spine04",
    "chest": "spine02",
    "neck": "neck01",
    "head": "head",
    "clavicle": "clavicle",
    "upper_arm": "upperarm01",
    "forearm": "lowerarm01",
    "hand": "wrist",
    "thigh": "upperleg01",
    "shin": "lowerleg01",
    "foot": "foot",
}
"""Segment -> the bone whose head is its rotation centre."""


def build(n: int, seed: int, points: int) -> BodyBank:
    """n bodies with about `points` surface points each. Deterministic for a given seed."""
    import anny
    from anny.face_segmentation import get_face_segmentation_mask
    from anny.keypoints import KeypointsRegressor

    generator = torch.Generator().manual_seed(seed)
    model = anny.Anny(rig="anny", topology="anny", phenotypes="all")
    model = model.to(torch.float32)
    regressor = KeypointsRegressor.coco(model)
    faces = model.faces.long()
    seen = (~get_face_segmentation_mask(model, list(HIDDEN))).float()
    female = draw_sex(n, generator)
    stature = draw_stature(female, generator)
    phenotypes = draw_phenotypes(female, generator)

    average, _ = _shape(model, {k: torch.tensor([0.5]) for k in phenotypes} | {"age": torch.tensor([0.7])})
    face, bary = even_samples(average[0], faces, seen, points, generator)
    corner = faces[face]
    weights = (segment_weights(model)[corner] * bary[..., None]).sum(1)

    spots, directions, origins, joints, palms, tips, toes = [], [], [], [], [], [], []
    for start in range(0, n, CHUNK):
        part = slice(start, start + CHUNK)
        vertices, heads = with_stature(model, {k: v[part] for k, v in phenotypes.items()}, stature[part])
        hips = _heads(model, heads, "upperleg01.L", "upperleg01.R").mean(1, keepdim=True)
        coco = dict(zip(regressor.labels, (regressor({"vertices": vertices}) - hips).unbind(1), strict=True))
        vertices, heads = vertices - hips, heads - hips
        o = _origins(model, heads)
        normal = vertex_normals(vertices, faces)
        spots.append((vertices[:, corner] * bary[..., None]).sum(2))
        directions.append(torch.nn.functional.normalize((normal[:, corner] * bary[..., None]).sum(2), dim=2))
        origins.append(o)
        joints.append(_joints(o, coco))
        palms.append(torch.stack([_palm(model, heads, s) for s in "RL"], 1))
        tips.append(
            torch.stack([_heads(model, heads, *(f"finger{k}-3.{s}" for k in (2, 3, 4, 5))).mean(1) for s in "RL"], 1)
        )
        toes.append(
            torch.stack([coco[f"{s}_big_toe"] + coco[f"{s}_small_toe"] - 2 * coco[f"{s}_heel"] for s, _ in SIDES], 1)
        )
    o, j, p = torch.cat(origins), torch.cat(joints), torch.cat(spots)
    fingers, palm = torch.cat(tips), torch.cat(palms)
    p, o, j, fingers = _with_lengths(p, weights, o, j, fingers, bones(draw_lengths(female, stature, generator)))
    region, along = regions(p.mean(0), weights, o.mean(0), j.mean(0))
    normals = torch.cat(directions)
    return BodyBank(
        points=p,
        normals=normals,
        weights=weights,
        origins=o,
        align=alignment(o, palm, fingers, torch.cat(toes)),
        joints=j,
        region=region,
        along=along,
        drape=drape(p, normals, region),
        stature=stature,
        female=female,
    )


def draw_phenotypes(female: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """anny's shape parameters of adults, each (N,) in [0, 1]; all but the height."""
    n = len(female)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(n, generator=generator)

    def normal(mean: float, sd: float, low: float, high: float) -> Tensor:
        return (mean + sd * torch.randn(n, generator=generator)).clamp(low, high)

    gender = uniform(0.0, 0.2)
    return {
        "gender": torch.where(female, 1 - gender, gender),
        "age": uniform(0.58, 0.97),  # 2/3 is a young adult, 1 is old
        "muscle": normal(0.5, 0.18, 0.05, 0.95),
        "weight": normal(0.52, 0.2, 0.05, 0.98),
        "proportions": uniform(0.3, 0.9),
        "cupsize": uniform(0.1, 0.6),
        "firmness": uniform(0.2, 0.8),
        "african": uniform(0.01, 1.0),
        "asian": uniform(0.01, 1.0),
        "caucasian": uniform(0.01, 1.0),
    }


def _shape(model: Any, phenotypes: dict[str, Tensor], height: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Rest vertices and heads of the bones."""
    h = torch.full_like(phenotypes["gender"], 0.5) if height is None else height
    with torch.no_grad():
        out = model(phenotype_kwargs={**phenotypes, "height": h})
    return out["rest_vertices"].float(), out["rest_bone_heads"].float()


def with_stature(
    model: Any, phenotypes: dict[str, Tensor], stature: Float[Tensor, " n"], steps: int = 4
) -> tuple[Float[Tensor, "n v 3"], Float[Tensor, "n bones 3"]]:
    """Solves the height parameter by the secant method; a last uniform scale of about 1 makes the stature exact."""

    def extent(vertices: Tensor) -> Tensor:
        return vertices[..., 2].amax(1) - vertices[..., 2].amin(1)

    before = torch.full_like(stature, 0.4)
    now = torch.full_like(stature, 0.6)
    tall_before = extent(_shape(model, phenotypes, before)[0])
    for _ in range(steps):
        vertices, heads = _shape(model, phenotypes, now)
        tall = extent(vertices)
        slope = (tall - tall_before) / torch.where((now - before).abs() < 1e-4, 1e-4, now - before)
        before, tall_before = now, tall
        now = (now + (stature - tall) / slope.clamp_min(0.2)).clamp(0.0, 1.0)
    scale = (stature / tall)[:, None, None]
    return vertices * scale, heads * scale


LIMITS = (0.88, 1.14)
"""How far a bone of anny is shortened or lengthened at most."""


def _with_lengths(
    points: Tensor, weights: Tensor, origins: Tensor, joints: Tensor, tips: Tensor, bone: dict[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Stretches the limbs along their bones towards wanted lengths, within LIMITS; all points blend with their weights.

    Statures are restored by a last uniform scale. bone: distances between joint centres (`ansur.bones`).
    """
    n = len(points)
    stretch = torch.eye(3).expand(n, len(SEGMENTS), 3, 3).clone()

    def at(name: str) -> Tensor:
        return origins[:, SEGMENT[name]]

    def along(name: str, vector: Tensor, length: Tensor) -> None:
        k = (length / vector.norm(dim=1)).clamp(*LIMITS)
        u = torch.nn.functional.normalize(vector, dim=1)
        stretch[:, SEGMENT[name]] += (k - 1)[:, None, None] * u[:, :, None] * u[:, None]

    across = at("left_upper_arm") - at("right_upper_arm")
    inner = (at("left_clavicle") - at("right_clavicle")).norm(dim=1)
    for side, _ in SIDES:
        beam = (at(f"{side}_upper_arm") - at(f"{side}_clavicle")) * across.new_tensor([1.0, 0.0, 0.0])
        along(f"{side}_clavicle", beam, (bone["shoulders"] - inner) / 2)
        for part, child in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot")):
            along(f"{side}_{part}", at(f"{side}_{child}") - at(f"{side}_{part}"), bone[part])
        palm = at(f"{side}_fingers") - at(f"{side}_hand")
        along(f"{side}_hand", palm, palm.norm(dim=1) * bone["palm"] / bone["palm"].mean())
    moved = torch.zeros_like(origins)
    for i, parent in enumerate(PARENTS):
        if parent >= 0:
            step = origins[:, i] - origins[:, parent]
            moved[:, i] = moved[:, parent] + (stretch[:, parent] @ step[..., None])[..., 0]
    shift = moved - (stretch @ origins[..., None])[..., 0]
    blend = (weights @ torch.cat([stretch.mT, shift[:, :, None]], 2).flatten(2)).unflatten(2, (4, 3))
    out = (blend[:, :, :3] * points[..., None]).sum(2) + blend[:, :, 3]
    carrier = list(JOINT_SEGMENT)
    joints = joints + (moved - origins)[:, carrier]
    joints[:, JOINT["neck"]] = joints[:, [JOINT["right_shoulder"], JOINT["left_shoulder"]]].mean(1)
    hands = [SEGMENT["right_fingers"], SEGMENT["left_fingers"]]
    tips = tips + (moved - origins)[:, hands]
    before = points[..., 2].amax(1) - points[..., 2].amin(1)
    k = (before / (out[..., 2].amax(1) - out[..., 2].amin(1)))[:, None, None]
    return out * k, moved * k, joints * k, tips * k


def segment_weights(model: Any) -> Float[Tensor, "v s"]:
    """anny's skinning weights, summed over the bones of each segment."""
    of_bone = torch.tensor([_segment_of(label) for label in model.bone_labels])
    index = of_bone[model.vertex_bone_indices.long()]
    out = torch.zeros(len(index), len(SEGMENTS))
    out.scatter_add_(1, index, model.vertex_bone_weights.float())
    return out / out.sum(1, keepdim=True)


def _segment_of(bone: str) -> int:
    for name, beginnings in _BONES.items():
        if bone.startswith(beginnings):
            side = {"L": "left_", "R": "right_"}.get(bone.rpartition(".")[2], "")
            return SEGMENT[name] if name in SEGMENT else SEGMENT[side + name]
    raise KeyError(bone)


def _heads(model: Any, heads: Tensor, *bones: str) -> Tensor:
    """(N, len(bones), 3) positions of the bones' heads."""
    return heads[:, [model.bone_labels.index(b) for b in bones]]


def _origins(model: Any, heads: Tensor) -> Tensor:
    """(N, S, 3) rotation centres; the pelvis is at zero."""
    out = []
    for name in SEGMENTS:
        part = name.removeprefix("right_").removeprefix("left_")
        end = ".R" if name.startswith("right_") else ".L" if name.startswith("left_") else ""
        if part == "pelvis":
            out.append(torch.zeros_like(heads[:, 0]))
        elif part == "fingers":
            out.append(_heads(model, heads, *(f"finger{k}-1{end}" for k in (2, 3, 4, 5))).mean(1))
        else:
            out.append(_heads(model, heads, _ORIGIN[part] + end)[:, 0])
    return torch.stack(out, 1)


def _palm(model: Any, heads: Tensor, side: str) -> Tensor:
    """(N, 3) unit vector out of the palm."""
    wrist, index, pinky = _heads(model, heads, f"wrist.{side}", f"finger2-1.{side}", f"finger5-1.{side}").unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(index - wrist, pinky - wrist), dim=1)
    return normal if side == "R" else -normal


def _joints(origins: Tensor, coco: dict[str, Tensor]) -> Tensor:
    """(N, 18, 3): limb joints are origins; the face's are the regressor's, ears 8 mm further in."""
    out = origins[:, list(JOINT_SEGMENT)].clone()
    for name in ("nose", "right_eye", "left_eye", "right_ear", "left_ear"):
        place = coco[name].clone()
        if name.endswith("ear"):
            place[:, 0] -= 0.008 * place[:, 0].sign()
        out[:, JOINT[name]] = place
    out[:, JOINT["neck"]] = out[:, [JOINT["right_shoulder"], JOINT["left_shoulder"]]].mean(1)
    return out
