"""What simulated hands do: wrists turned, fingers bent as the posture says, around a bar, or against something flat;
what they hold; and a board near them: the door behind a handle, the table under a palm. Hand frame (`hand_bank`),
metres, radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.synthetic.draw import Draw
from understudy.synthetic.hand_bank import about
from understudy.synthetic.render import FAR
from understudy.synthetic.segments import SEGMENT

FREE: Final = 0
BAR: Final = 1
FLAT: Final = 2
"""Kinds of grips: nothing held, around a bar, against a flat thing"""

_WRIST = (0.6, 0.2)  # radians, one sigma: bent, sideways
_MOST_BENT = 0.1  # cosine of the angle between hand and forearm
_JOINT = (0.75, 1.15, 0.6)  # share of the knuckle, the middle and the last joint in a finger's bend
_BAR_Z = 0.022  # metres: a held bar's surface above the palm's plane
_FLAT_Z = 0.03  # the same of a flat thing
_POINTS = 1200  # of what is held


@dataclass(frozen=True)
class GripConfig:
    """How often what happens."""

    holds: float = 0.35
    """share of hands that hold something"""
    bar: float = 0.65
    """of these, share with a bar; the others hold something flat"""
    handle: float = 0.5
    """of the bars, share with a board (a door) behind"""
    lies: float = 0.15
    """of the free hands, share that lie on a board"""


@dataclass(frozen=True)
class Grips:
    """What each hand of a batch does."""

    flex: Float[Tensor, "b 5 3"]
    spread: Float[Tensor, "b 5"]
    kind: Int[Tensor, " b"]
    """FREE, BAR or FLAT"""
    radius: Float[Tensor, " b"]
    """of the bar"""


@dataclass(frozen=True)
class Board:
    """A rectangle for each hand."""

    center: Float[Tensor, "b 3"]
    axes: Float[Tensor, "b 3 3"]
    """rows: along, across, normal"""
    half: Float[Tensor, "b 2"]
    there: Bool[Tensor, " b"]

    def moved(self, rows: Float[Tensor, "b 3 3"], shift: Float[Tensor, "b 3"]) -> Board:
        """In another frame: p -> p @ rows + shift."""
        return Board((self.center[:, None] @ rows)[:, 0] + shift, self.axes @ rows, self.half, self.there)

    def replaced_by(self, other: Board) -> Board:
        """The other ones where those are there, these elsewhere."""
        chosen = other.there
        center = torch.where(chosen[:, None], other.center, self.center)
        axes = torch.where(chosen[:, None, None], other.axes, self.axes)
        return Board(center, axes, torch.where(chosen[:, None], other.half, self.half), self.there | chosen)

    def cast(self, rays: Float[Tensor, "b s s 3"]) -> Float[Tensor, "b s s"]:
        """Distances along rays from the origin, in lengths of the ray; FAR where they miss."""
        center, (along, across, normal) = self.center, self.axes.unbind(1)
        slope = (rays * _flat(normal)).sum(-1)
        z = (center * normal).sum(1)[:, None, None] / torch.where(slope.abs() < 1e-6, 1e-6, slope)
        spot = rays * z[..., None] - _flat(center)
        inside = (spot * _flat(along)).sum(-1).abs() < self.half[:, 0, None, None]
        inside &= (spot * _flat(across)).sum(-1).abs() < self.half[:, 1, None, None]
        return torch.where(inside & (z > 0.1) & self.there[:, None, None], z, FAR)


def _flat(v: Float[Tensor, "b 3"]) -> Float[Tensor, "b 1 1 3"]:
    return v[:, None, None]


def finger_bend(rotations: Float[Tensor, "b s 3 3"], side: str) -> Float[Tensor, " b"]:
    """Mean bend of the fingers' joints in a posture of the body."""
    hand, fingers = rotations[:, SEGMENT[f"{side}_hand"]], rotations[:, SEGMENT[f"{side}_fingers"]]
    relative = hand.mT @ fingers
    return torch.acos(((relative.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)) / 1.9


def turned(
    draw: Draw, share: float, axes: Float[Tensor, "b 3 3"], elbow: Float[Tensor, "b 3"]
) -> Float[Tensor, "b 3 3"]:
    """Hands with other wrists, as far as wrists go: bent towards palm or back, sideways, and twisted.

    axes: rows, the hand frame's axes. elbow: unit vectors from the wrist, in the same frame as the axes.
    """
    b = len(axes)
    flexed, sideways = (s * draw.normal(b) for s in _WRIST)
    twisted = torch.where(draw.chance(0.5, b), draw.uniform(-1.3, 1.3, b), 0.0)
    along, across, out = torch.eye(3).unbind(0)
    other = about(across.expand(b, 3), flexed) @ about(out.expand(b, 3), sideways) @ about(along.expand(b, 3), twisted)
    other = other @ axes
    bent = -(other[:, 0] * elbow).sum(1)  # cosine
    chosen = draw.chance(share, b) & (bent > _MOST_BENT)
    return torch.where(chosen[:, None, None], other, axes)


def draw_grips(
    draw: Draw, config: GripConfig, bend: Float[Tensor, " b"], busy: Bool[Tensor, " b"] | None = None
) -> Grips:
    """bend: of free hands' fingers, see `finger_bend`. busy: hands that hold nothing of their own; default: none."""
    b = len(bend)
    kind = torch.where(draw.chance(config.holds, b), torch.where(draw.chance(config.bar, b), BAR, FLAT), FREE)
    if busy is not None:
        kind = torch.where(busy, FREE, kind)
    radius = draw.uniform(0.006, 0.03, b)
    around = 1.15 - 12.0 * radius
    level = torch.where(kind == BAR, around, torch.where(kind == FLAT, draw.uniform(0.05, 0.6, b), bend))
    flex = level[:, None, None] * torch.tensor(_JOINT) * (1 + 0.25 * draw.normal(b, 5, 1))
    flex = flex + 0.12 * draw.normal(b, 5, 3) - 0.1
    alone = draw.chance(0.12, b) & (kind == FREE)  # one or two fingers stretched out
    which = draw.chance(0.45, b, 5) & alone[:, None]
    flex = torch.where(which[..., None], -0.1 + 0.1 * draw.normal(b, 5, 3), flex)
    flex = flex.clamp(torch.tensor([-0.4, -0.2, -0.3]), torch.tensor([1.5, 1.75, 1.2]))
    thumb = torch.tensor([0.5, 0.45, 0.5]) * (0.3 + level)[:, None] + 0.2 * draw.normal(b, 3)
    flex[:, 0] = torch.where(kind[:, None] == FLAT, draw.uniform(0.2, 0.8, b, 3), thumb).clamp(-0.4, 1.0)
    fan = torch.tensor([0.2, 0.12, 0.0, -0.1, -0.18])
    spread = draw.normal(b, 5) * 0.08 + draw.normal(b, 1) * fan * 0.7
    return Grips(flex, spread, kind, radius)


def held_points(draw: Draw, grips: Grips, landmarks: Float[Tensor, "b 21 3"]) -> Float[Tensor, "b 1200 3"]:
    """Points on the surface of what is held; NaN where nothing is."""
    b, n = len(grips.kind), _POINTS
    radius = grips.radius[:, None]
    along, angle = draw.uniform(-1, 1, b, n), draw.uniform(0, 2 * math.pi, b, n)
    knuckles = landmarks[:, [5, 9, 13], :1].mean(1)
    # a bar lies across the palm below the knuckles, more or less askew
    half = draw.uniform(0.06, 0.25, b)[:, None]
    shift = draw.uniform(-0.5, 0.5, b)[:, None] * (half - 0.05)
    lean = 0.25 * draw.normal(b)[:, None] + 0.15
    y = along * half + shift
    bar = torch.stack([knuckles - 0.005 + radius * angle.cos() + lean * y, y, _BAR_Z + radius * (1 + angle.sin())], -1)
    # a flat thing lies against the fingers, between them and the thumb
    wide, long = draw.uniform(0.05, 0.16, b)[:, None], draw.uniform(0.05, 0.2, b)[:, None]
    thick = draw.uniform(0.001, 0.04, b)[:, None]
    front = draw.chance(0.5, b, n)
    x = knuckles + 0.02 + 0.6 * long + long * along
    flat = torch.stack([x, wide * draw.uniform(-1, 1, b, n), _FLAT_Z + torch.where(front, 0.0, thick)], -1)
    chosen = torch.where((grips.kind == BAR)[:, None, None], bar, flat)
    return chosen + torch.where(grips.kind == FREE, torch.nan, 0.0)[:, None, None]


def draw_board(draw: Draw, config: GripConfig, grips: Grips) -> Board:
    """Behind a bar (as far as a handle is from its door), or under a free palm."""
    b = len(grips.kind)
    bar = grips.kind == BAR
    there = draw.chance(torch.where(bar, config.handle, config.lies), b) & (grips.kind != FLAT)
    beyond = _BAR_Z + 2 * grips.radius + draw.uniform(0.015, 0.06, b)
    height = torch.where(bar, beyond, draw.uniform(0.012, 0.04, b))
    tilt = draw.normal(b, 2) * torch.where(bar, 0.35, 0.08)[:, None]
    normal = torch.nn.functional.normalize(torch.cat([tilt, torch.ones(b, 1)], 1), dim=1)
    turn = draw.uniform(0, math.pi, b)
    along = torch.stack([turn.cos(), turn.sin(), torch.zeros(b)], 1)
    along = torch.nn.functional.normalize(along - normal * (along * normal).sum(1, keepdim=True), dim=1)
    across = torch.linalg.cross(normal, along)
    half = draw.uniform(0.06, 0.6, b, 2)
    aside = (2 * draw.uniform(0, 1, b, 2) - 1) * (half - 0.05)
    center = torch.stack([0.09 + torch.zeros(b), torch.zeros(b), height], 1)
    center = center + along * aside[:, :1] + across * aside[:, 1:]
    return Board(center, torch.stack([along, across, normal], 1), half, there)
