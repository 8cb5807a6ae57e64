"""What covers simulated hands and forearms: sleeves, and pockets, in which hands are in part or altogether (torch)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.synthetic.draw import Draw
from understudy.synthetic.hand_grips import Board

UPPER: Final = 0
LOWER: Final = 1
SKIN: Final = 2
"""What the parts of the body are covered with: a top, trousers, nothing"""

_AT_HIP = 0.28  # metres from the wrist to its side's hip: pockets are there
_EDGE = (-0.03, 0.10)  # metres from the wrist towards the fingers: where a pocket begins
_WHOLE = 0.25  # share of pockets that cover all of the hand
_SHAPELESS = 0.6  # share of pockets in which a hand has no shape of its own: flat cloth is over it
_OVER = (0.01, 0.05)  # metres: this cloth before the middle of the hand
_LONG, _WIDE = (0.25, 0.4), (0.14, 0.3)  # metres: its size
_END_ON = 0.6  # sine between view and fingers, below which the cloth begins to turn towards the camera
_OF_THE_TOP = 0.3  # share of pockets that are a jacket's


@dataclass(frozen=True)
class ClothesConfig:
    """How often what is worn."""

    sleeves: float = 0.6
    """share of forearms in sleeves"""
    pockets: float = 0.04
    """share of the hands that hold nothing that are under cloth, or gone in it"""
    pockets_at_hips: float = 0.35
    """the same of those whose wrist is beside the hip"""


@dataclass(frozen=True)
class HandClothes:
    """Of each point of a hand and its forearm."""

    thick: Float[Tensor, "b p"]
    """metres of cloth on the skin; NaN where the hand has no shape of its own"""
    wear: Int[Tensor, "b p"]
    """UPPER, LOWER or SKIN"""
    pocketed: Bool[Tensor, "b p"]
    patch: Board
    """the cloth over hands without a shape; hand frame"""
    patch_wear: Int[Tensor, " b"]
    """UPPER or LOWER"""


def dress_hands(
    draw: Draw,
    config: ClothesConfig,
    along: Float[Tensor, "b p"],
    of_hand: Bool[Tensor, " p"],
    empty: Bool[Tensor, " b"],
    to_hip: Float[Tensor, " b"],
    to_camera: Float[Tensor, "b 3"],
) -> HandClothes:
    """along: metres from the wrist towards the fingers. of_hand: which points are not the forearm's. empty: which hands
    hold nothing. to_hip: metres from the wrist to the hip. to_camera: unit vector in the hand frame.
    """
    b = len(along)
    begin, sleeve = draw.uniform(-0.01, 0.1, b), draw.uniform(0.003, 0.022, b)
    sleeved = (along < -begin[:, None]) & draw.chance(config.sleeves, b)[:, None]
    share = torch.where(to_hip < _AT_HIP, config.pockets_at_hips, config.pockets)
    edge = torch.where(draw.chance(_WHOLE, b), -1.0, draw.uniform(*_EDGE, b))
    in_pocket = draw.chance(share, b) & empty
    pocketed = of_hand & (along > edge[:, None]) & in_pocket[:, None]
    flat = draw.chance(_SHAPELESS, b)
    pocket = torch.where(flat, torch.nan, draw.uniform(0.008, 0.025, b))
    thick = torch.where(pocketed, pocket[:, None], torch.where(sleeved, sleeve[:, None], 0.0))
    cloth = torch.where(draw.chance(_OF_THE_TOP, b), UPPER, LOWER)
    wear = torch.where(pocketed, cloth[:, None], torch.where(sleeved, UPPER, SKIN))
    return HandClothes(thick, wear, pocketed, _patch(draw, edge, to_camera, in_pocket & flat), cloth)


def _patch(draw: Draw, edge: Float[Tensor, " b"], to_camera: Float[Tensor, "b 3"], there: Bool[Tensor, " b"]) -> Board:
    """Cloth that begins `edge` metres from the wrist and is between the fingers and the camera."""
    b = len(edge)
    lean = 0.2 * draw.normal(b, 3) * torch.tensor([0.5, 1.0, 1.0])
    across = to_camera * torch.tensor([0.0, 1.0, 1.0])
    end_on = (1 - across.norm(dim=1, keepdim=True) / _END_ON).clamp_min(0)  # seen along the fingers: faces the camera
    normal = F.normalize(across.lerp(to_camera, end_on) + lean, dim=1)
    normal = torch.where((normal * to_camera).sum(1, keepdim=True) < 0, -normal, normal)
    fingers = torch.tensor([1.0, 0.0, 0.0]) - normal * normal[:, :1]
    fingers = F.normalize(fingers, dim=1)
    axes = torch.stack([fingers, torch.linalg.cross(normal, fingers), normal], 1)
    half = torch.stack([draw.uniform(*_LONG, b), draw.uniform(*_WIDE, b)], 1) / 2
    start = edge.clamp_min(_EDGE[0] - 0.03)
    aside = draw.uniform(-0.4, 0.4, b) * half[:, 1]
    center = fingers * (start + half[:, 0])[:, None] + axes[:, 1] * aside[:, None]
    return Board(center + normal * draw.uniform(*_OVER, b)[:, None], axes, half, there)
