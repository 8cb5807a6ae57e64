"""What the colour path says of simulated hands: the errors that it was measured to have on rendered ones.

Measured on 650 crops of 66 rendered hands (tools/make_rooms and the bundled recording, BlazePose's hand networks):
hands that are hidden, small or seen edge-on are missed or turned by half a turn; the others are off by 12 degrees along
each axis, mostly the same way in all crops of one hand.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from understudy.synthetic.draw import Draw

_SIGMA = math.radians(12)
_PIXELS = torch.tensor([16.0, 24.0, 34.0, 50.0])  # of the hand's 0.19 m in the colour image
_FOUND = torch.tensor([0.40, 0.56, 0.69, 0.73, 0.76])
_FOUND_HIDDEN = 0.10
_WRONG_SIZE = torch.tensor([24.0, 40.0, 75.0])
_WRONG = torch.tensor([0.24, 0.11, 0.10, 0.04])
_UNNOTICED = 0.15  # of the wrong ones, share that look as good as right ones
_EDGE_ON = 0.2  # |cosine| of the normal and the view


def color_words(
    draw: Draw,
    normal: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    visible: Float[Tensor, " b"],
    pixels: Float[Tensor, " b"],
    absent: float = 0.25,
) -> Float[Tensor, "b 9"]:
    """Normal, direction, log of the spread, quality (`ColorPalm.quality`), 1; zeros where the colour path says nothing.

    visible: share of the hand that is seen. pixels: of its length in the colour image. absent: share of people of whom
    there is no usable colour at all, so that depth is learnt to suffice.
    """
    b = len(normal)
    hidden = visible < 0.35
    chance = torch.where(hidden, _FOUND_HIDDEN, _FOUND[torch.bucketize(pixels, _PIXELS)])
    found = draw.chance(chance, b) & ~draw.chance(absent, b)
    edge_on = normal[:, 2].abs() < _EDGE_ON
    odds = _WRONG[torch.bucketize(pixels, _WRONG_SIZE)] * torch.where(edge_on, 2.5, 0.7)
    wrong = draw.chance(torch.where(hidden, 0.6, odds.clamp_max(0.8)), b)
    turned = draw.chance(0.6, b)  # of the wrong ones: palm and back exchanged about the view
    said_n, said_d = _jittered(draw, normal, _SIGMA), _jittered(draw, direction, _SIGMA)
    flipped = said_n * torch.tensor([-1.0, -1.0, 1.0])
    anywhere = torch.nn.functional.normalize(draw.normal(b, 3), dim=1)
    wrong_n = torch.where(turned[:, None], flipped, anywhere)
    elsewhere = torch.nn.functional.normalize(anywhere.roll(1, 1) + 0.3 * said_d, dim=1)
    wrong_d = torch.where(turned[:, None], said_d, elsewhere)
    n = torch.where(wrong[:, None], wrong_n, said_n)
    d = torch.where(wrong[:, None], wrong_d, said_d)
    spread = torch.where(wrong, 0.09, 0.07) * draw.lognormal(0.9, b)
    good = 0.96 - 0.6 * draw.uniform(0, 1, b) ** 3.5
    doubtful = wrong & ~draw.chance(_UNNOTICED, b)
    quality = torch.where(doubtful, 0.45 + 0.15 * draw.normal(b), good).clamp(0.02, 0.98)
    words = torch.cat([n, d, spread.clamp_min(0.01).log()[:, None], quality[:, None], torch.ones(b, 1)], 1)
    return words * found[:, None]


def _jittered(draw: Draw, unit: Float[Tensor, "b 3"], sigma: float) -> Float[Tensor, "b 3"]:
    return torch.nn.functional.normalize(unit + sigma * draw.normal(*unit.shape), dim=1)
