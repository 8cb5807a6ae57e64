"""Plain colours of simulated people and rooms (RGB, 0..1)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.bodies import REGION, BodyBank
from understudy.synthetic.clothing import Dressed, Style, _covers, _places
from understudy.synthetic.draw import Draw

_SKIN = ((0.36, 0.23, 0.17), (0.95, 0.78, 0.67))
_HAIR = ((0.45, 0.30, 0.18), (0.75, 0.60, 0.35), (0.62, 0.61, 0.60))
_EYE, _LIPS = (0.12, 0.08, 0.07), (0.72, 0.30, 0.30)
_MOVED = 0.008  # metres: a neck's or back's point that lies farther out is covered by long hair or a hood


def person_colors(
    draw: Draw, bank: BodyBank, style: Style, worn: Dressed
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " 3"]]:
    """Colours of the points of one dressed person's surface, and of what they carry. bank: of that one body."""
    region = bank.region
    low, arm = _places(bank)
    wear = {name: getattr(style, name)[:, None] for name in ("top_hem", "sleeve", "bottom_hem")}
    masks = {name: region == code for name, code in REGION.items()}
    top, bottom = (m[0] for m in _covers(masks, low, arm, wear))
    tone = draw.uniform(0, 1, 1)
    skin = torch.lerp(torch.tensor(_SKIN[0]), torch.tensor(_SKIN[1]), tone)
    hair = cloth(draw, True) if bool(style.dark_hair) else torch.tensor(_HAIR)[draw.integers(len(_HAIR), 1)][0]
    upper, lower, shoes = (cloth(draw, bool(d)) for d in (style.dark_top, style.dark_bottom, style.dark_shoes))
    out = skin.expand(len(region), 3).clone()
    out[bottom] = lower
    out[top] = upper
    if float(style.sole) > 0:
        out[masks["foot"]] = shoes
    moved = (worn.points[0] - bank.points[0]).norm(dim=1) > _MOVED
    behind = bank.points[0, :, 1] > bank.joints[0, JOINT["right_ear"], 1]
    hidden = masks["scalp"] | (masks["neck"] & moved & behind)
    if int(style.hat) > 0:
        out[hidden] = upper if int(style.hat) == 3 else cloth(draw, bool(style.dark_top))
    elif float(style.hair) > 0:
        out[hidden] = hair
    _draw_face(bank, out)
    return out, cloth(draw, False)


def cloth(draw: Draw, dark: bool) -> Float[Tensor, " 3"]:
    """A random colour."""
    if dark:
        return draw.uniform(0.03, 0.14, 1) + 0.03 * draw.uniform(0, 1, 3)
    grey, tint = draw.uniform(0.2, 0.85, 1), draw.uniform(0.1, 0.95, 3)
    return torch.lerp(grey.expand(3), tint, draw.uniform(0.1, 0.9, 1))


def room_colors(draw: Draw, boxes: int) -> Float[Tensor, "k 3"]:
    """Of floor, two walls, and furniture."""
    grey, tint = draw.uniform(0.3, 0.85, boxes, 1), draw.uniform(0.2, 0.9, boxes, 3)
    return torch.lerp(grey.expand(-1, 3), tint, draw.uniform(0.05, 0.6, boxes, 1))


def _draw_face(bank: BodyBank, colors: Float[Tensor, "p 3"]) -> None:
    """Eyes and lips: the nearest points of the face; in place."""
    joints, points = bank.joints[0], bank.points[0]
    eyes = joints[[JOINT["right_eye"], JOINT["left_eye"]]]
    nose = joints[JOINT["nose"]]
    mouth = nose + 0.9 * (nose - eyes.mean(0)) * torch.tensor([1.0, 0.0, 1.0]).to(nose)
    face = (bank.region == REGION["head_skin"]).nonzero()[:, 0]
    for place, count, color in ((eyes[0], 2, _EYE), (eyes[1], 2, _EYE), (mouth, 4, _LIPS)):
        near = (points[face] - place).norm(dim=1).topk(min(count, len(face)), largest=False).indices
        colors[face[near]] = torch.tensor(color).to(colors)
