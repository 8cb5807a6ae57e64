"""Hands in detail: dense surfaces of anny's hands with articulated fingers, for images that a hand fills.

Hand frame: origin at the wrist, x towards the middle finger's knuckle, z out of the palm, y = z x x. All hands are
right hands (the thumb is at -y); a left hand is the mirror image, y -> -y. Metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Bool, Float, Int
from safetensors.torch import load, save
from torch import Tensor

from understudy.assets import cache_dir
from understudy.errors import UnderstudyError
from understudy.files import write_atomically
from understudy.skeleton import HAND_KEYPOINTS
from understudy.synthetic.kinematics import axes, cross, unit

FINGERS: Final = ("thumb", "index", "middle", "ring", "pinky")
PARTS: Final = ("palm", *(f"{finger}_{k}" for finger in FINGERS for k in (1, 2, 3)), "forearm")
"""What moves as one: the palm, then three bones of each finger, from the knuckle outwards, and the forearm's end."""
FOREARM: Final = PARTS.index("forearm")
VERSION: Final = 2

_FOREARM = 0.14  # metres of the forearm that come along
_WIDTH_SIGMA, _THICK_SIGMA = 0.06, 0.08  # of the log: hands of one length differ
_CHUNK = 32
_MEAN_FLEX = math.radians(12)  # of the fingers at rest in anny, which articulation takes back


@dataclass(frozen=True)
class HandBank:
    """N right hands with the same P surface points, fingers at rest, in the hand frame."""

    points: Float[Tensor, "n p 3"]
    normals: Float[Tensor, "n p 3"]
    """unit, outward"""
    weights: Float[Tensor, "p 17"]
    """skinning weights over PARTS; rows sum to 1"""
    heads: Float[Tensor, "n 17 3"]
    """rotation centres of the parts; the wrist is that of palm and forearm"""
    flexion: Float[Tensor, "n 17 3"]
    """unit axes about which a positive angle bends a part towards the palm; those of palm and forearm are not used"""
    landmarks: Float[Tensor, "n 21 3"]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.points.device

    @property
    def of_hand(self) -> Bool[Tensor, " p"]:
        """Which points are the hand's, not the forearm's."""
        return self.weights[:, FOREARM] < 0.5

    def to(self, device: torch.device | str) -> HandBank:
        """The same bank on another device."""
        return HandBank(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})


@dataclass(frozen=True)
class PosedHands:
    """B articulated hands in the hand frame."""

    points: Float[Tensor, "b p 3"]
    normals: Float[Tensor, "b p 3"]
    landmarks: Float[Tensor, "b 21 3"]


def articulate(
    bank: HandBank,
    ids: Int[Tensor, " b"],
    flex: Float[Tensor, "b 5 3"],
    spread: Float[Tensor, "b 5"],
    elbow: Float[Tensor, "b 3"],
) -> PosedHands:
    """Bends fingers and wrist.

    ids: which hands. flex: radians of each joint, thumb to pinky, from the knuckle outwards; 0 = as at rest. spread:
    about the palm's normal, away from the palm's middle towards the thumb. elbow: unit vectors from the wrist to the
    elbow, hand frame.
    """
    heads, axis = bank.heads[ids], bank.flexion[ids]
    b, device = len(ids), bank.device
    turn = torch.eye(3, device=device).expand(b, len(PARTS), 3, 3).clone()
    shift = torch.zeros(b, len(PARTS), 3, device=device)
    up = torch.tensor([0.0, 0.0, 1.0], device=device).expand(b, 3)
    for f in range(len(FINGERS)):
        R, t = torch.eye(3, device=device).expand(b, 3, 3), torch.zeros(b, 3, device=device)
        for k in range(3):
            part = 1 + 3 * f + k
            own = about(axis[:, part], flex[:, f, k])
            if k == 0:
                own = about(up, spread[:, f]) @ own
            center = heads[:, part]
            t = t + (R @ (center - (own @ center[..., None])[..., 0])[..., None])[..., 0]
            R = R @ own
            turn[:, part], shift[:, part] = R, t
    turn[:, FOREARM] = shortest_turn(torch.tensor([-1.0, 0.0, 0.0], device=device), elbow)
    blended = bank.weights @ torch.cat([turn.flatten(2), shift], 2)  # (B, P, 12)
    R, t = blended[..., :9].unflatten(2, (3, 3)), blended[..., 9:]
    points = (R @ bank.points[ids][..., None])[..., 0] + t
    normals = unit((R @ bank.normals[ids][..., None])[..., 0])
    carrier = torch.tensor([0, *(1 + 3 * f + min(k, 2) for f in range(5) for k in range(4))], device=device)
    marks = (turn[:, carrier] @ bank.landmarks[ids][..., None])[..., 0] + shift[:, carrier]
    return PosedHands(points, normals, marks)


def about(axis: Float[Tensor, "b 3"], angle: Float[Tensor, " b"]) -> Float[Tensor, "b 3 3"]:
    """Rotations about unit axes by angles in radians."""
    x, y, z = axis.unbind(-1)
    o = torch.zeros_like(x)
    K = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    s, c = angle.sin()[:, None, None], angle.cos()[:, None, None]
    return torch.eye(3, device=axis.device) + s * K + (1 - c) * (K @ K)


def shortest_turn(start: Float[Tensor, "3"], end: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """The smallest rotations that take one unit vector to others."""
    start = start.expand_as(end)
    axis = torch.linalg.cross(start, end)
    return about(unit(axis), torch.atan2(axis.norm(dim=1), (start * end).sum(1)))


def palm_normals(landmarks: Float[Tensor, "b 21 3"]) -> Float[Tensor, "b 3"]:
    """Unit normals out of the palms of right hands: wrist to index knuckle, times wrist to pinky knuckle."""
    wrist, index, pinky = (landmarks[:, HAND_KEYPOINTS.index(n)] for n in ("wrist", "index_1", "pinky_1"))
    return unit(cross(index - wrist, pinky - wrist))


def load_hands(n: int, seed: int, points: int = 2600, cache: Path | None = None) -> HandBank:
    """n hands of random adults, from the cache or built (anny; about a tenth of a second each)."""
    folder = cache or cache_dir() / "synthetic"
    path = folder / f"hands-n{n}-p{points}-seed{seed}-v{VERSION}.safetensors"
    if path.exists():
        try:
            return HandBank(**load(path.read_bytes()))
        except Exception as e:  # safetensors has its own exceptions
            raise UnderstudyError(f"{path}: not a readable bank of hands: {e}") from e
    bank = build_hands(n, seed, points)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save({f.name: getattr(bank, f.name).contiguous() for f in fields(bank)}))
    return bank


def build_hands(n: int, seed: int, points: int) -> HandBank:
    """n right hands with about `points` surface points each. Deterministic for a given seed."""
    import anny

    from understudy.synthetic.ansur import draw_sex, draw_stature
    from understudy.synthetic.body_anny import draw_phenotypes, with_stature
    from understudy.synthetic.surface import even_samples, vertex_normals

    generator = torch.Generator().manual_seed(seed)
    model = anny.Anny(rig="anny", topology="anny", phenotypes="all").to(torch.float32)
    female = draw_sex(n, generator)
    stature = draw_stature(female, generator)
    phenotypes = draw_phenotypes(female, generator)
    faces = model.faces.long()
    weights, near = _part_weights(model)
    corner: Tensor | None = None
    made: list[tuple[Tensor, ...]] = []
    for start in range(0, n, _CHUNK):
        rows = slice(start, start + _CHUNK)
        vertices, heads = with_stature(model, {k: v[rows] for k, v in phenotypes.items()}, stature[rows])
        frame, wrist = _frames(model, heads)
        local = (vertices - wrist[:, None]) @ frame
        bones = (heads - wrist[:, None]) @ frame
        if corner is None:
            with_it = near & (local[0, :, 0] > -_FOREARM)
            chosen = with_it[faces].all(1).float()
            face, bary = even_samples(vertices[0], faces, chosen, points, generator)
            corner = faces[face]
        normal = torch.nn.functional.normalize(vertex_normals(vertices, faces) @ frame, dim=2)
        spots = (local[:, corner] * bary[..., None]).sum(2)
        out = torch.nn.functional.normalize((normal[:, corner] * bary[..., None]).sum(2), dim=2)
        centers = _centers(model, bones)
        tips = _tips(model, local, bones)
        made.append((spots, out, centers, tips))
    assert corner is not None
    spots, out, centers, tips = (torch.cat(part) for part in zip(*made, strict=True))
    scale = torch.ones(n, 1, 3)
    scale[:, 0, 1] = torch.exp(_WIDTH_SIGMA * torch.randn(n, generator=generator).clamp(-2.5, 2.5))
    scale[:, 0, 2] = torch.exp(_THICK_SIGMA * torch.randn(n, generator=generator).clamp(-2.5, 2.5))
    spots, centers, tips = spots * scale, centers * scale, tips * scale
    out = torch.nn.functional.normalize(out / scale, dim=2)
    w = (weights[corner] * bary[..., None]).sum(1)
    marks = torch.zeros(n, 21, 3)
    for f in range(5):
        marks[:, 1 + 4 * f : 4 + 4 * f] = centers[:, 1 + 3 * f : 4 + 3 * f]
        marks[:, 4 + 4 * f] = tips[:, f]
    return HandBank(spots, out, w / w.sum(1, keepdim=True), centers, _flexion(centers, tips), marks)


def _part_weights(model: Any) -> tuple[Float[Tensor, "v 17"], Tensor]:
    """anny's skinning weights of the right hand, summed over PARTS, and which vertices are mostly hand or forearm."""
    column = {}
    for i, label in enumerate(model.bone_labels):
        if label.startswith(("wrist", "metacarpal")) and label.endswith(".R"):
            column[i] = 0
        elif label.startswith("lowerarm") and label.endswith(".R"):
            column[i] = FOREARM
        elif label.startswith("finger") and label.endswith(".R"):
            finger, bone = label.removeprefix("finger").removesuffix(".R").split("-")
            column[i] = 1 + 3 * (int(finger) - 1) + int(bone) - 1
    index = model.vertex_bone_indices.long()
    table = torch.full((len(model.bone_labels),), -1)
    table[list(column)] = torch.tensor(list(column.values()))
    part = table[index]
    weight = model.vertex_bone_weights.float() * (part >= 0)
    out = torch.zeros(len(index), len(PARTS))
    out.scatter_add_(1, part.clamp_min(0), weight)
    total = out.sum(1)
    return out / total.clamp_min(1e-6)[:, None], total > 0.5


def _bone(model: Any, heads: Tensor, name: str) -> Tensor:
    found: Tensor = heads[:, model.bone_labels.index(f"{name}.R")]
    return found


def _frames(model: Any, heads: Tensor) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Columns: the hand frame's axes in the body frame; and the wrist."""
    wrist, index, middle, pinky = (_bone(model, heads, b) for b in ("wrist", "finger2-1", "finger3-1", "finger5-1"))
    normal = unit(cross(index - wrist, pinky - wrist))
    return axes(middle - wrist, normal), wrist


def _centers(model: Any, bones: Tensor) -> Float[Tensor, "n 17 3"]:
    named = [f"finger{f}-{k}" for f in range(1, 6) for k in (1, 2, 3)]
    wrist = torch.zeros_like(bones[:, 0])
    return torch.stack([wrist, *(_bone(model, bones, b) for b in named), wrist], 1)


def _tips(model: Any, local: Tensor, bones: Tensor) -> Float[Tensor, "n 5 3"]:
    """The outermost vertex of each finger's last bone."""
    main = model.vertex_bone_indices.long().gather(1, model.vertex_bone_weights.argmax(1, keepdim=True))[:, 0]
    out = []
    for f in range(1, 6):
        own = (main == model.bone_labels.index(f"finger{f}-3.R")).nonzero()[:, 0]
        way = unit(_bone(model, bones, f"finger{f}-3") - _bone(model, bones, f"finger{f}-2"))
        far = (local[:, own] * way[:, None]).sum(2).argmax(1)
        out.append(local[torch.arange(len(local)), own[far]])
    return torch.stack(out, 1)


def _flexion(centers: Float[Tensor, "n 17 3"], tips: Float[Tensor, "n 5 3"]) -> Float[Tensor, "n 17 3"]:
    """Fingers bend about axes across them that lie in the palm; the thumb bends towards the pinky's knuckle."""
    out = torch.zeros_like(centers)
    palm = torch.tensor([0.0, 0.0, 1.0]).expand(len(centers), 3)
    pinky = centers[:, 1 + 3 * 4]
    for f in range(5):
        chain = [*(centers[:, 1 + 3 * f + k] for k in range(3)), tips[:, f]]
        for k in range(3):
            way = unit(chain[k + 1] - chain[k])
            towards = palm if f else unit(unit(pinky - chain[0]) + 0.6 * palm)
            out[:, 1 + 3 * f + k] = unit(cross(way, towards))
    return out
