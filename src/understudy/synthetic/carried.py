"""Things that people carry or wear rigidly: backpack, bag, boxes, the brim of a cap; as points of one segment each."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from understudy.skeleton import JOINT
from understudy.synthetic.bodies import REGION, BodyBank
from understudy.synthetic.segments import SEGMENT

THINGS: Final = ("nothing", "backpack", "shoulder_bag", "box_right", "box_left", "box_both")
"""Names of the codes. `box_both` is rigid to the right hand and reaches from its palm to where the left one belongs."""

N_THING, N_BRIM = 1280, 128
N_EXTRA: Final = N_THING + N_BRIM
"""Extra points of every person; absent ones are NaN."""

SPACING: Final = 0.017
"""Of the points, metres; wider where N_THING does not suffice."""


def carry(
    bank: BodyBank,
    ids: Int[Tensor, " b"],
    carried: Int[Tensor, " b"],
    brim: Bool[Tensor, " b"],
    clothes: Float[Tensor, " b"],
    generator: torch.Generator,
) -> tuple[Float[Tensor, "b e 3"], Float[Tensor, "b e 3"], Int[Tensor, "b e"], Float[Tensor, "b 3"]]:
    """Points and normals at rest, their segments, and the sizes of the things (see `Dressed`).

    carried: codes of THINGS. clothes: thickness at the trunk, metres.
    """
    n, device = len(ids), bank.device
    random = torch.rand(4, n, 3, generator=generator, device=generator.device).to(device)
    low = torch.tensor(
        [
            [0.0, 0.0, 0.0],
            [0.26, 0.12, 0.36],
            [0.08, 0.24, 0.20],
            [0.06, 0.05, 0.05],
            [0.06, 0.05, 0.05],
            [0.15, 0.1, 0.22],
        ],
        device=device,
    )
    high = torch.tensor(
        [
            [0.0, 0.0, 0.0],
            [0.36, 0.26, 0.55],
            [0.18, 0.42, 0.34],
            [0.26, 0.22, 0.25],
            [0.26, 0.22, 0.25],
            [0.40, 0.4, 0.50],
        ],
        device=device,
    )
    size = torch.lerp(low[carried], high[carried], random[0])
    centre, turn, segment = _places(bank, ids, carried, size, clothes, random[1])
    q, m = _rounded_box(size, random[2, :, 0])
    area = 2 * (size * size.roll(1, 1)).sum(1)
    order = torch.arange(N_THING, device=device)
    absent = order >= (area / SPACING**2)[:, None]  # so that small things are not denser than big ones
    q = q.masked_fill(absent[..., None], float("nan"))
    points = centre[:, None] + q @ turn.mT
    brim_points, brim_normals = _brim(bank, ids, random[3])
    brim_points = brim_points.masked_fill(~brim[:, None, None], float("nan"))
    segments = torch.cat(
        [segment[:, None].expand(-1, N_THING), torch.full((n, N_BRIM), SEGMENT["head"], device=device)], 1
    )
    return torch.cat([points, brim_points], 1), torch.cat([m @ turn.mT, brim_normals], 1), segments, size


def _places(
    bank: BodyBank, ids: Tensor, carried: Tensor, size: Tensor, clothes: Tensor, random: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Centre (B, 3), orientation at rest (B, 3, 3) and segment (B,) of each thing."""
    n, device = len(ids), bank.device
    trunk = (bank.region == REGION["trunk_upper"]) | (bank.region == REGION["trunk_lower"])
    spots = bank.points[ids[:, None], trunk.nonzero()[:, 0][::7]]
    half, zero = size / 2, torch.zeros(n, device=device)
    neck = bank.origins[ids, SEGMENT["neck"]]
    back = spots[..., 1].amax(1) + 0.6 * clothes
    pack = torch.stack(
        [zero, back + half[:, 1] - 0.015, neck[:, 2] - 0.02 - half[:, 2] + 0.06 * (random[:, 0] - 0.5)], 1
    )
    side = torch.where(random[:, 0] < 0.5, -1.0, 1.0)
    hips = spots[..., 0].abs().amax(1) * 0.9 + clothes
    bag = torch.stack([side * (hips + half[:, 0]), 0.1 * (random[:, 1] - 0.5), -0.1 + 0.25 * random[:, 2]], 1)
    centres, turns, segments = (
        [zero[:, None].expand(-1, 3), pack, bag],
        [torch.eye(3, device=device).expand(n, 3, 3)] * 3,
        [0, 2, 0],
    )
    segments = [SEGMENT["pelvis"], SEGMENT["chest"], SEGMENT["pelvis"]]
    for hand, sign in (("right_hand", -1.0), ("left_hand", 1.0), ("right_hand", -1.0)):
        # canonical: out along the hand, across it, out of the palm
        axes = torch.tensor([[sign, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]], device=device).T
        turn = bank.align[ids, SEGMENT[hand]].mT @ axes
        reach = torch.stack([0.09 + zero, zero, half[:, 2] + 0.022], 1)
        centres.append(bank.origins[ids, SEGMENT[hand]] + (turn @ reach[..., None])[..., 0])
        turns.append(turn)
        segments.append(SEGMENT[hand])
    rows = torch.arange(n, device=device)
    return (
        torch.stack(centres, 1)[rows, carried],
        torch.stack(turns, 1)[rows, carried],
        torch.tensor(segments, device=device)[carried],
    )


def _rounded_box(size: Tensor, hard: Tensor) -> tuple[Tensor, Tensor]:
    """(B, N_THING, 3) points and normals of boxes with edges from soft (hard 0) to sharp (1), evenly by area."""
    device = size.device
    k = torch.arange(N_THING, device=device) + 0.5
    face_at, s, t = ((k * g) % 1.0 for g in (0.8191725134, 0.6710436067, 0.5497004779))  # a low-discrepancy sequence
    half = size / 2
    areas = half.roll(1, 1) * half.roll(2, 1)
    edges = (areas / areas.sum(1, keepdim=True).clamp_min(1e-9)).cumsum(1)
    axis = (face_at[None, :, None] >= edges[:, None, :2]).sum(2)  # the axis that the face is square to
    before = torch.cat([torch.zeros_like(edges[:, :1]), edges], 1)
    within = (face_at - before.gather(1, axis)) / (before.gather(1, axis + 1) - before.gather(1, axis)).clamp_min(1e-9)
    sign = torch.where(within < 0.5, -1.0, 1.0)
    flat = torch.stack([sign, (2 * s - 1).expand_as(sign), (2 * t - 1).expand_as(sign)], 2)
    q = flat.gather(2, (torch.arange(3, device=device) - axis[..., None]) % 3)
    power = (3.0 + 13.0 * hard)[:, None, None]
    q = q / q.abs().clamp_min(1e-4).pow(power).sum(2, keepdim=True).pow(1 / power)
    normal = q.sign() * q.abs().clamp_min(1e-4).pow(power - 1) / half[:, None].clamp_min(1e-3)
    return q * half[:, None], torch.nn.functional.normalize(normal, dim=2)


def _brim(bank: BodyBank, ids: Tensor, random: Tensor) -> tuple[Tensor, Tensor]:
    """(B, N_BRIM, 3) points and normals of the brim of a cap: half a ring before the forehead."""
    device = bank.device
    k = torch.arange(N_BRIM, device=device) + 0.5
    angle = ((k * 0.7548776662) % 1.0 - 0.5) * 2.3
    far = (k * 0.5698402910) % 1.0
    eye = bank.joints[ids][:, [JOINT["right_eye"], JOINT["left_eye"]]].mean(1)
    ear = bank.joints[ids][:, [JOINT["right_ear"], JOINT["left_ear"]]].mean(1)
    reach = (eye[:, 1] - ear[:, 1]).abs()[:, None] + 0.012
    length = 0.05 + 0.03 * random[:, :1]
    x = (0.082 + 0.25 * length * far) * angle.sin()
    y = ear[:, 1:2] - (reach + length * far) * angle.cos()
    z = eye[:, 2:3] + 0.045 - (0.1 + 0.3 * random[:, 1:2]) * length * far - 0.02 * angle.sin().square()
    up = torch.tensor([0.0, 0.0, 1.0], device=device).expand(len(ids), N_BRIM, 3)
    return torch.stack([x, y, z], 2), up
