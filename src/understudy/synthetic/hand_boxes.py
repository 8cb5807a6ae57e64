"""What simulated people carry between both hands: boxes between their palms, trays and crates on them. World frame,
metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.draw import Draw
from understudy.synthetic.scene import Boxes
from understudy.synthetic.segments import SEGMENT

_MIDDLE: Final = 0.08  # from the wrist to the middle of the palm
_SKIN: Final = 0.03  # from a palm's plane to what lies against it
_APART: Final = (0.1, 0.65)  # between the palms
_LEVEL: Final = 0.35  # most rise from one palm to the other, over their distance
_FACES: Final = 0.5  # least cosine between a palm's normal and the way to the other, or upwards
_DEEP: Final = (0.06, 0.25)  # half edges: across the way from palm to palm
_HIGH: Final = (0.04, 0.22)
_FLAT: Final = (0.01, 0.15)  # half a height, of what lies on the palms
_BEYOND: Final = 0.12  # of what lies on the palms, how far it reaches beyond them at most


@dataclass(frozen=True)
class Carried:
    """One thing for everybody of a batch."""

    boxes: Boxes
    """one each"""
    there: Bool[Tensor, " b"]


def carried_between(
    draw: Draw, share: float, joints: Float[Tensor, "b 18 3"], R_world_segment: Float[Tensor, "b s 3 3"]
) -> Carried:
    """Things for those whose hands are held as if there were one: palms that face each other or both look upwards.

    share: of these, how many carry something. joints: the body's; R_world_segment: of its segments.
    """
    b = len(joints)
    palms, normals = [], []
    for side, along in (("right", -1.0), ("left", 1.0)):  # hands at rest point sideways, palms down
        R = R_world_segment[:, SEGMENT[f"{side}_hand"]]
        palms.append(joints[:, JOINT[f"{side}_wrist"]] + _MIDDLE * along * R[..., 0])
        normals.append(-R[..., 2])
    way = palms[1] - palms[0]
    apart = way.norm(dim=1)
    unit = way / apart[:, None].clamp_min(1e-6)
    between = ((normals[0] * unit).sum(1) > _FACES) & ((normals[1] * -unit).sum(1) > _FACES)
    on = (normals[0][:, 2] > _FACES) & (normals[1][:, 2] > _FACES)
    can = (between | on) & (apart > _APART[0]) & (apart < _APART[1]) & (unit[:, 2].abs() < _LEVEL)
    yaw = torch.atan2(way[:, 1], way[:, 0])
    middle = (palms[0] + palms[1]) / 2
    ahead = torch.stack([-yaw.sin(), yaw.cos(), torch.zeros(b)], 1)
    hips = joints[:, [JOINT["right_hip"], JOINT["left_hip"]]].mean(1)
    ahead = ahead * torch.where(((middle - hips) * ahead).sum(1, keepdim=True) < 0, -1.0, 1.0)
    deep = draw.uniform(*_DEEP, b)
    high = torch.where(on, draw.uniform(*_FLAT, b), draw.uniform(*_HIGH, b))
    long = torch.where(on, apart / 2 + draw.uniform(-0.03, _BEYOND, b), apart / 2 - _SKIN)
    top = torch.maximum(palms[0][:, 2], palms[1][:, 2])
    up = torch.where(on, top + _SKIN + high, middle[:, 2] + draw.uniform(-0.7, 0.7, b) * high)
    center = middle + ahead * (draw.uniform(-0.3, 0.7, b) * deep)[:, None]
    center = torch.cat([center[:, :2], up[:, None]], 1)
    boxes = Boxes(center[:, None], torch.stack([long, deep, high], 1)[:, None], yaw[:, None])
    there = can & draw.chance(share, b)
    return Carried(boxes.without(~there[:, None]), there)
