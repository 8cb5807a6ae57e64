"""The joints of a person look at each other (torch): corrections to where the voxels put each joint.

Voxels are coarse, and each joint's distribution knows of the others only what the convolutions carry. Here a joint is a
row of numbers: where its distribution lies, where the detector saw it, how far it is above the floor and behind the
nearest surface, what the features say there. A small transformer over the 18 rows sees what no voxel does: bones that
are too long, sides that are exchanged, a keypoint that does not fit the rest of the person.
"""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from understudy.skeleton import N_JOINTS
from understudy.voxels import CELL, CELLS, EMPTY, HALF

TOLD: Final = 20
"""numbers that `told` says of a joint"""
WIDTH: Final = 96
_HEADS = 4
_NEAR = 0.3  # metres: how far from a surface a joint can be told to be
_APART = 0.5  # metres: the same, of a keypoint from its joint
_SCALE = 0.1  # metres that are 1 to the network


class Refinement(nn.Module):
    """See the module's text. Fresh, it corrects nothing."""

    def __init__(self, features: int, layers: int):
        """features: numbers that the voxels say at each joint."""
        super().__init__()
        self.enter = nn.Linear(features + TOLD, WIDTH)
        self.embedding = nn.Parameter(0.02 * torch.randn(N_JOINTS, WIDTH))
        self.blocks = nn.ModuleList(_Block() for _ in range(layers))
        self.norm = nn.LayerNorm(WIDTH)
        self.leave = nn.Linear(WIDTH, 3)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(
        self, features: Float[Tensor, "b 18 f"], said: Float[Tensor, "b 18 t"]
    ) -> tuple[Float[Tensor, "b 18 3"], Float[Tensor, "b 18 w"]]:
        """Corrections in metres, view coordinates, and what each joint's row has become. said: of `told`."""
        x = self.enter(torch.cat([features, said], -1)) + self.embedding
        for block in self.blocks:
            x = block(x)
        x = self.norm(x)
        return _SCALE * self.leave(x), x


class _Block(nn.Module):
    """Attention among the joints, then a layer for each alone."""

    def __init__(self) -> None:
        super().__init__()
        self.norm_a, self.norm_b = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        self.asked = nn.Linear(WIDTH, 3 * WIDTH)
        self.answered = nn.Linear(WIDTH, WIDTH)
        self.up, self.down = nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor) -> Tensor:
        rows = self.asked(self.norm_a(x)).unflatten(-1, (3, _HEADS, -1)).permute(2, 0, 3, 1, 4)
        query, key, value = rows.unbind(0)
        weight = (query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5).softmax(-1)
        x = x + self.answered((weight @ value).transpose(1, 2).flatten(2))
        return x + self.down(F.gelu(self.up(self.norm_b(x))))


def told(
    mean: Float[Tensor, "b 18 3"],
    spread: Float[Tensor, "b 18 3"],
    peak: Float[Tensor, "b 18 1"],
    depth: Float[Tensor, "b 2 64 64"],
    keypoints: Float[Tensor, "b 18 3"],
    root_z: Float[Tensor, "b 1"],
    floor: Float[Tensor, "b 4"],
) -> Float[Tensor, "b 18 20"]:
    """What a joint's row begins with. mean, spread, peak: of its distribution; the rest: the network's inputs."""
    score = keypoints[..., 2:]
    found = (score > 0).to(score.dtype)
    uv = keypoints[..., :2] * found
    gap = (uv - mean[..., :2]).clamp(-_APART, _APART) * found
    distance = root_z[..., None].expand_as(score)
    metric = torch.cat([mean[..., :2] * (1 + mean[..., 2:] / distance), mean[..., 2:] + distance], -1)
    known = (floor != 0).any(1).to(score.dtype)[:, None, None]
    height = ((metric * floor[:, None, :3]).sum(-1, keepdim=True) + floor[:, None, 3:]).clamp(-1, 2.5) * known
    surfaces = [*_behind(depth, mean[..., :2], mean[..., 2:]), *_behind(depth, uv, mean[..., 2:], found)]
    parts = [mean / _APART, spread.log(), peak, uv / _APART, score, found, gap / _SCALE, height, known.expand_as(score)]
    return torch.cat([*parts, *surfaces, distance / 3 - 1], -1)


def _behind(
    depth: Tensor, xy: Tensor, z: Tensor, counts: Tensor | float = 1.0
) -> tuple[Float[Tensor, "b 18 1"], Float[Tensor, "b 18 1"]]:
    """How far the nearest surface in a column is behind (before: negative) a depth, and whether there is one near."""
    column = ((xy.detach() + HALF) / CELL).floor().clamp(0, CELLS - 1).nan_to_num().long()
    near = depth[:, 0].flatten(1).gather(1, column[..., 1] * CELLS + column[..., 0])[..., None]
    seen = (near < 0.5 * (EMPTY + HALF)).to(z.dtype) * counts
    return (near - z).clamp(-_NEAR, _NEAR) * seen / _SCALE, seen
