"""The default network (torch): a person's view grid and 2D keypoints -> one distribution per joint -> 3D joints.

Made for a CPU. What the paper does at 64^3 with 64 channels happens here at 16^3: the occupancy grid is folded
4 x 4 x 4 cells into channels, and everything that is constant along z (the score maps) passes through a 2D trunk whose
result is added to the 3D features. The last layer unfolds to 32^3 scores per joint; their softmax is the joint's
distribution.
Where the floor is known, each cell is also told how high above it it is. In the end the joints look at each other
(`refinement`).
All inputs and outputs are in the coordinates of `understudy.voxels.PersonView`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from understudy.skeleton import N_JOINTS
from understudy.voxelposenet.refinement import WIDTH, Refinement, told
from understudy.voxels import CELL, CELLS, EMPTY, HALF, LIMIT

FOLD = 4
COARSE = CELLS // FOLD  # 16: cells along an edge of the 3D features
_FREE = 0.25  # metres of truncation of the signed distance to the seen surface
_SIGMA = 0.06  # metres: width of a keypoint's score map
_HEIGHTS = (0.25, 1.5)  # metres above and below the floor that the network tells apart, finely and coarsely
_LEAST_SLOPE = 1e-3  # of a ray that goes down to the floor


@dataclass(frozen=True)
class NetConfig:
    """Sizes of the default network."""

    channels: tuple[int, int, int] = (32, 80, 128)
    """features at 16^3, 8^3 and 4^3"""
    channels_2d: int = 96
    """features of the 2D trunk at 16^2"""
    lifted: int = 12
    """features per z slice that the 2D trunk writes into the volume"""
    inside: bool = True
    """use what lies in front of and behind the seen surface (free, hidden), not only the surface"""
    floor: bool = True
    """use the floor, where one is given"""
    refinement: int = 3
    """layers in which the joints look at each other; 0: none"""


class Output(NamedTuple):
    """What the network says of each person."""

    joints: Float[Tensor, "b 18 3"]
    """metres, view coordinates: the mean of each joint's distribution, refined"""
    spread: Float[Tensor, "b 18 3"]
    """standard deviation of the distribution along each axis, metres"""
    head: Float[Tensor, "b 18 3"]
    """log of sigma (metres; 68 % of errors are smaller), logit of 'within 10 cm', logit of 'seen by the camera'"""


class _Features(NamedTuple):
    """What is known of each cell, besides the scores."""

    fine: Float[Tensor, "b c 4096"]
    coarse: Float[Tensor, "b d 512"]
    judged: Float[Tensor, "b 32 4096"]
    """for the judge"""


class _Residual(nn.Module):
    def __init__(self, conv: type[nn.Module], norm: type[nn.Module], channels: int):
        super().__init__()
        self.a = nn.Sequential(conv(channels, channels, 3, padding=1, bias=False), norm(channels), nn.ReLU())
        self.b = nn.Sequential(conv(channels, channels, 3, padding=1, bias=False), norm(channels))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.b(self.a(x)))


def _block(
    conv: type[nn.Module], norm: type[nn.Module], inputs: int, outputs: int, size: int, stride: int
) -> nn.Module:
    layer = conv(inputs, outputs, size, stride=stride, padding=size // 2 if size % 2 else 0, bias=False)
    return nn.Sequential(layer, norm(outputs), nn.ReLU())


class VoxelPoseNet(nn.Module):
    """See the module's text."""

    centers: Tensor
    fine: Tensor
    coarse: Tensor

    def __init__(self, config: NetConfig | None = None):
        super().__init__()
        self.config = config = config or NetConfig()
        c16, c8, c4 = config.channels
        two, three = (nn.Conv2d, nn.BatchNorm2d), (nn.Conv3d, nn.BatchNorm3d)
        flat = N_JOINTS + 2 + (2 if config.floor else 0)
        self.maps = _block(*two, flat, config.channels_2d, FOLD, FOLD)
        self.trunk_2d = nn.Sequential(*(_Residual(*two, config.channels_2d) for _ in range(2)))
        self.lift = nn.Conv2d(config.channels_2d, c16 + COARSE * config.lifted, 1)
        volume = FOLD**3 + (FOLD**2 if config.inside else 0) + config.lifted + 4
        volume += len(_HEIGHTS) + 1 if config.floor else 0
        self.first = nn.Conv3d(volume, c16, 1, bias=False)
        self.first_norm = nn.BatchNorm3d(c16)
        self.block16 = _Residual(*three, c16)
        self.down8 = _block(*three, c16, c8, 2, 2)
        self.block8 = nn.Sequential(_Residual(*three, c8), _Residual(*three, c8))
        self.down4 = _block(*three, c8, c4, 2, 2)
        self.block4 = nn.Sequential(_Residual(*three, c4), _Residual(*three, c4))
        self.up8 = nn.ConvTranspose3d(c4, c8, 2, stride=2)
        self.merge8 = _Residual(*three, c8)
        self.up16 = nn.ConvTranspose3d(c8, c16, 2, stride=2)
        self.merge16 = _Residual(*three, c16)
        self.score = nn.Conv3d(c16, N_JOINTS * 8, 1)
        self.features = nn.Conv3d(c16, 32, 1)
        self.embedding = nn.Parameter(torch.zeros(N_JOINTS, 32))
        self.refinement = Refinement(c16 + c8, config.refinement) if config.refinement else None
        judged = 32 + 8 + (WIDTH if config.refinement else 0)
        self.judge = nn.Sequential(nn.Linear(judged, 64), nn.ReLU(), nn.Linear(64, 32), nn.ReLU(), nn.Linear(32, 3))
        edges = torch.arange(2 * COARSE, dtype=torch.float32)
        self.register_buffer("centers", _sub_centers((edges + 0.5) * (2 * HALF / len(edges)) - HALF), persistent=False)
        fine = (torch.arange(CELLS, dtype=torch.float32) + 0.5) * CELL - HALF
        self.register_buffer("fine", fine, persistent=False)
        self.register_buffer("coarse", fine.reshape(COARSE, FOLD).mean(1), persistent=False)

    def forward(
        self,
        depth: Float[Tensor, "b 2 64 64"],
        keypoints: Float[Tensor, "b 18 3"],
        root_z: Float[Tensor, "b 1"],
        floor: Float[Tensor, "b 4"],
    ) -> Output:
        """Inputs as `understudy.voxels.PersonView` makes them. See `Output`."""
        logits, features = self._logits(depth, keypoints, root_z, floor)
        return self._read(logits.softmax(-1), features, depth, keypoints, root_z, floor)

    def scores(
        self, depth: Tensor, keypoints: Tensor, root_z: Tensor, floor: Tensor
    ) -> tuple[Float[Tensor, "b 18 32768"], Output]:
        """Also the logarithm of each joint's distribution over the 32^3 cells, in the order of `centers`."""
        logits, features = self._logits(depth, keypoints, root_z, floor)
        with torch.autocast(logits.device.type, enabled=False):  # places need more digits than bfloat16 has
            scores = logits.log_softmax(-1)
            return scores, self._read(scores.exp(), features, depth, keypoints, root_z, floor)

    def _logits(self, depth: Tensor, keypoints: Tensor, root_z: Tensor, floor: Tensor) -> tuple[Tensor, _Features]:
        """Scores (b, 18, 32768) before they become distributions."""
        flat = self.trunk_2d(self.maps(self._flat_input(depth, keypoints, root_z, floor)))
        b, c16 = depth.shape[0], self.config.channels[0]
        added, lifted = self.lift(flat).split([c16, COARSE * self.config.lifted], 1)
        x = self.first(self._volume(depth, root_z, floor, lifted.reshape(b, -1, COARSE, COARSE, COARSE)))
        x16 = self.block16(F.relu(self.first_norm(x + added[:, :, None])))
        x8 = self.block8(self.down8(x16))
        x4 = self.block4(self.down4(x8))
        x8 = self.merge8(F.relu(x8 + self.up8(x4)))
        x16 = self.merge16(F.relu(x16 + self.up16(x8))).flatten(2)
        logits = _each_cell(self.score, x16).reshape(b, N_JOINTS, -1).float()
        # The judge must not bend what it judges: it sees features and distribution, but sends no gradient into them.
        return logits, _Features(x16, x8.flatten(2), _each_cell(self.features, x16.detach()))

    def _flat_input(self, depth: Tensor, keypoints: Tensor, root_z: Tensor, floor: Tensor) -> Tensor:
        """Score maps; the nearest depth, and the floor's, each with its mask."""
        near = depth[:, :1]
        seen = (near < 0.5 * (EMPTY + HALF)).to(near.dtype)
        dx = torch.exp(-(((self.fine - keypoints[..., :1]) / _SIGMA) ** 2) / 2) * keypoints[..., 2:]
        dy = torch.exp(-(((self.fine - keypoints[..., 1:2]) / _SIGMA) ** 2) / 2)
        parts = [dy[..., :, None] * dx[..., None, :], near * seen, seen]
        if self.config.floor:
            nx, ny, nz, d = floor[:, :, None, None].unbind(1)
            slope = (nx * self.fine + ny * self.fine[:, None]) / root_z[..., None] + nz
            z = d / (-slope).clamp_min(_LEAST_SLOPE) - root_z[..., None]
            meets = ((z.abs() < LIMIT) & (slope < -_LEAST_SLOPE)).to(near.dtype)
            parts += [(z * meets)[:, None], meets[:, None]]
        return torch.cat(parts, 1)

    def _volume(self, depth: Tensor, root_z: Tensor, floor: Tensor, lifted: Tensor) -> Tensor:
        """3D features at 16^3, axes (z, y, x)."""
        b = depth.shape[0]
        near = depth[:, :1]
        offset = ((depth[:, :, None] - self.fine[:, None, None]) / CELL).to(lifted.dtype)
        surface = F.relu(1 - offset.abs().amin(1))
        folded = surface.reshape(b, COARSE, FOLD, COARSE, FOLD, COARSE, FOLD).permute(0, 2, 4, 6, 1, 3, 5)
        parts = [folded.reshape(b, FOLD**3, COARSE, COARSE, COARSE), lifted]
        if self.config.inside:
            seen = (near < 0.5 * (EMPTY + HALF)).to(near.dtype)
            free = ((near - self.coarse[None, :, None, None]) / _FREE).clamp(-1, 1) * seen
            free = free.reshape(b, COARSE, COARSE, FOLD, COARSE, FOLD).permute(0, 3, 5, 1, 2, 4)
            parts.append(free.reshape(b, FOLD**2, COARSE, COARSE, COARSE))
        c = self.coarse
        shape = (b, 1, COARSE, COARSE, COARSE)
        scale = c[None, :] / root_z
        parts += [
            c[None, None, :, None, None].expand(shape),
            c[None, None, None, :, None].expand(shape),
            c[None, None, None, None, :].expand(shape),
            scale[:, None, :, None, None].expand(shape),
        ]
        if self.config.floor:
            nx, ny, nz, d = floor[:, :, None, None, None].unbind(1)
            distance = root_z[..., None, None]
            slope = (nx * c + ny * c[:, None]) / distance + nz
            height = (slope * (c[:, None, None] + distance) + d)[:, None]
            known = (floor != 0).any(1).to(lifted.dtype)[:, None, None, None, None].expand(shape)
            parts += [*((height / h).clamp(-1, 1) * known for h in _HEIGHTS), known]
        return torch.cat([p.to(lifted.dtype) for p in parts], 1)

    def _read(
        self, p: Tensor, features: _Features, depth: Tensor, keypoints: Tensor, root_z: Tensor, floor: Tensor
    ) -> Output:
        """Means and spreads of the distributions p (b, 18, 32768), refined, and the judge's word, from features where
        each joint is believed to be.
        """
        b = p.shape[0]
        mean, square = (p @ torch.cat([self.centers, self.centers**2], 1)).split(3, -1)
        spread = (square - mean**2).clamp_min(1e-6).sqrt()
        peak = p.amax(-1, keepdim=True).clamp_min(1e-6).log() / 5
        place = p.detach().reshape(b, N_JOINTS, 8, -1).sum(2)
        at_joints = place @ features.judged.float().transpose(1, 2)
        joints, rows = mean, []
        if self.refinement is not None:
            place8 = 8 * F.avg_pool3d(place.unflatten(-1, (COARSE, COARSE, COARSE)), 2).flatten(2)
            local = [place @ features.fine.float().transpose(1, 2), place8 @ features.coarse.float().transpose(1, 2)]
            plane = floor if self.config.floor else torch.zeros_like(root_z).expand(-1, 4)
            about = told(mean.detach(), spread.detach(), peak.detach(), depth, keypoints, root_z, plane)
            correction, row = self.refinement(torch.cat(local, -1), about)
            joints, rows = mean + correction, [row.detach()]
        uv, score = keypoints[..., :2], keypoints[..., 2:]
        off = ((joints[..., :2] - uv).abs() / 0.1).clamp_max(5) * (score > 0)
        said = torch.cat([spread.log(), off, score, (score > 0).to(score.dtype), peak], -1)
        judged = self.judge(torch.cat([at_joints + self.embedding, said.detach(), *rows], -1))
        return Output(joints, spread, judged)


def _each_cell(layer: nn.Conv3d, cells: Float[Tensor, "b c n"]) -> Tensor:
    """A 1x1x1 convolution whose result lies joint by joint in memory, where the softmax reads it: in training, the
    convolution's own order costs a tenth of a step.
    """
    assert layer.bias is not None
    weight = layer.weight.flatten(1).expand(cells.shape[0], -1, -1)
    return torch.bmm(weight, cells) + layer.bias[:, None]


def _sub_centers(edge: Tensor) -> Float[Tensor, "32768 3"]:
    """(x, y, z) of every cell in the order of the logits: 8 sub-cells (z, y, x) of each of 16^3 cells (z, y, x)."""
    z, y, x = torch.meshgrid(edge, edge, edge, indexing="ij")
    points = torch.stack([x, y, z], -1).reshape(COARSE, 2, COARSE, 2, COARSE, 2, 3)
    return points.permute(1, 3, 5, 0, 2, 4, 6).reshape(-1, 3).contiguous()
