"""HandNormalNet (torch): depth and colour around a hand, arm's and body's joints, the colour path's word -> the palm.

Made for a CPU: a small residual network over 48 x 48 depth and 72 x 72 colour, whose features meet those of the joints.
It gives von Mises-Fisher distributions of the palm's normal and of the fingers' direction, 21 landmarks, and the chance
that the normal is within 30 degrees. Coordinates are those of the crop view; every hand is a right one.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from understudy.hands.crop import CELL, CONTEXT, GREY, SIGMA, UNSURE

N_LANDMARKS: Final = 21
COLOR_SIZE: Final = 9
"""Numbers of the colour path: normal, direction, log of the spread, quality, and 1; all zero where it says nothing."""
WITHIN: Final = math.cos(math.radians(30))
_KAPPA: Final = (-2.0, 6.0)  # range of the log of the concentration


class HandOutput(NamedTuple):
    """What the network says of each hand."""

    normal: Float[Tensor, "b 3"]
    """unit, out of the palm"""
    direction: Float[Tensor, "b 3"]
    """unit, from the wrist to the middle knuckle"""
    log_kappa: Float[Tensor, "b 2"]
    """log of the concentrations of normal and direction"""
    landmarks: Float[Tensor, "b 21 3"]
    """relative to the crop's centre, metres"""
    sure: Float[Tensor, " b"]
    """logit of 'the normal is within 30 degrees'"""


class _Residual(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.a = _conv(channels, channels, 3)
        self.b = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.b(self.a(x)))


def _conv(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    layer = nn.Conv2d(inputs, outputs, size, stride=stride, padding=size // 2, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU())


class HandNormalNet(nn.Module):
    """See the module's text.

    Landmarks are votes: every cell of a 12 x 12 map says where it believes each of them to be, and how much it counts.
    """

    def __init__(self) -> None:
        super().__init__()
        known = 3 * len(CONTEXT) + 1 + COLOR_SIZE + len(UNSURE)
        self.told = nn.Sequential(nn.Linear(known, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU())
        self.first = _conv(2, 32, 5, 2)
        self.image = nn.Sequential(nn.Conv2d(3, 32, 5, stride=3, padding=1, bias=False), nn.BatchNorm2d(32), nn.ReLU())
        self.bias_image = nn.Linear(128, 32)
        self.join_image = _conv(64, 40, 3)
        self.fine = nn.Sequential(_Residual(40), _conv(40, 80, 3, 2), _Residual(80), _Residual(80))
        self.bias_fine = nn.Linear(128, 80)
        self.coarse = nn.Sequential(_conv(80, 144, 3, 2), _Residual(144), _Residual(144))
        self.back = nn.Conv2d(144, 80, 1)
        self.votes = nn.Sequential(_conv(80, 96, 3), nn.Conv2d(96, 4 * N_LANDMARKS, 1))
        steps = (torch.arange(12) - 5.5) * (4 * CELL)
        v, u = torch.meshgrid(steps, steps, indexing="ij")
        self.register_buffer("grid", torch.stack([u, v, torch.zeros_like(u)]).flatten(1), persistent=False)
        self.squeeze = _conv(144, 32, 1)
        size = 32 * 36 + 144 + 128 + 3 * N_LANDMARKS
        self.join = nn.Sequential(nn.Linear(size, 256), nn.ReLU(), nn.Linear(256, 192), nn.ReLU())
        self.read = nn.Linear(192, 3 + 3 + 2)
        self.judge = nn.Sequential(nn.Linear(192 + 2, 48), nn.ReLU(), nn.Linear(48, 1))

    def forward(
        self,
        depth: Float[Tensor, "b 2 48 48"],
        context: Float[Tensor, "b 11 3"],
        distance: Float[Tensor, "b 1"],
        color: Float[Tensor, "b 9"],
        sigma: Float[Tensor, "b 2"],
        image: Float[Tensor, "b 3 72 72"],
    ) -> HandOutput:
        """Inputs as `HandBatch` has them; image: 0 to 255, GREY everywhere where there is none. See `HandOutput`."""
        near, seen = depth[:, :1], depth[:, 1:]
        unsure = (sigma.clamp(0.01, 0.5) / SIGMA).log()
        told = self.told(torch.cat([context.flatten(1) / 0.3, distance / 3, color, unsure], 1))
        x = self.first(torch.cat([near * seen / 0.1, seen], 1))
        y = self.image((image - GREY) / 64) + self.bias_image(told)[:, :, None, None]
        fine = self.fine(self.join_image(torch.cat([x, y], 1)))
        coarse = self.coarse(fine + self.bias_fine(told)[:, :, None, None])
        wide = F.relu(fine + F.interpolate(self.back(coarse), scale_factor=2.0, mode="nearest"))
        votes = self.votes(wide).flatten(2).unflatten(1, (N_LANDMARKS, 4))
        places = self.grid + 0.1 * votes[:, :, 1:]
        marks = (votes[:, :, :1].softmax(3) * places).sum(3)
        shape = (marks - marks.mean(1, keepdim=True)).flatten(1) / 0.05
        joined = self.join(torch.cat([self.squeeze(coarse).flatten(1), coarse.amax((2, 3)), told, shape], 1))
        out = self.read(joined)
        kappa = out[:, 6:8].clamp(*_KAPPA)
        sure = self.judge(torch.cat([joined, kappa], 1).detach())[:, 0]
        return HandOutput(F.normalize(out[:, :3], dim=1), F.normalize(out[:, 3:6], dim=1), kappa, marks, sure)


def loss(
    output: HandOutput,
    normal: Float[Tensor, "b 3"],
    direction: Float[Tensor, "b 3"],
    landmarks: Float[Tensor, "b 21 3"],
) -> tuple[Tensor, dict[str, Tensor]]:
    """Negative log likelihoods of both directions, L1 of the landmarks, and the judge's cross-entropy."""
    cos_n = (output.normal * normal).sum(1)
    cos_d = (output.direction * direction).sum(1)
    parts = {
        "normal": von_mises_fisher(cos_n, output.log_kappa[:, 0]).mean(),
        "direction": von_mises_fisher(cos_d, output.log_kappa[:, 1]).mean(),
        "landmarks": (output.landmarks - landmarks).abs().mean() / 0.02,
        "sure": F.binary_cross_entropy_with_logits(output.sure, (cos_n.detach() > WITHIN).float()),
    }
    total = parts["normal"] + 0.5 * parts["direction"] + 0.5 * parts["landmarks"] + parts["sure"]
    parts["degrees"] = torch.rad2deg(torch.acos(cos_n.detach().clamp(-1, 1))).mean()
    return total, parts


def von_mises_fisher(cos: Float[Tensor, " b"], log_kappa: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """Negative log density on the sphere, up to a constant, at an angle of cosine `cos` from the mean."""
    kappa = log_kappa.exp()
    return -log_kappa + torch.log1p(-torch.exp(-2 * kappa)) + kappa * (1 - cos)
