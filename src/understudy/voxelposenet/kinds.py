"""The networks that can be trained, and what differs between them: making, loss, reading, writing (torch)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from understudy.errors import ModelFileError
from understudy.synthetic.samples import Batch
from understudy.voxelposenet import paper_data
from understudy.voxelposenet.checkpoint import load_net, save_weights
from understudy.voxelposenet.loss import loss
from understudy.voxelposenet.net import NetConfig, VoxelPoseNet
from understudy.voxelposenet.paper_lifter import sigma_of_score
from understudy.voxelposenet.paper_net import PaperNet, paper_loss
from understudy.voxelposenet.tensorflow_weights import read_paper_weights, save_paper_weights
from understudy.voxelposenet.train_config import TrainConfig


class Estimate(NamedTuple):
    """What a network says of a batch."""

    joints: Float[Tensor, "b 18 3"]
    """view coordinates, metres"""
    sigma: Float[Tensor, "b 18"]
    """metres"""
    confidence: Float[Tensor, "b 18"]


@runtime_checkable
class Kind(Protocol):
    """One network, as training sees it."""

    @property
    def net(self) -> nn.Module:
        """The network that is trained."""
        ...

    @property
    def readers(self) -> tuple[str, ...]:
        """Beginnings of the names of parameters that read results out of features; see `optimizers`."""
        ...

    def learn(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its parts for the log; `error` among them is the mean error in metres, where it is known."""
        ...

    def estimate(self, net: nn.Module, batch: Batch) -> Estimate:
        """What a copy of the network says of people."""
        ...

    def copy(self, state: Mapping[str, Tensor]) -> nn.Module:
        """A network for use, with other weights."""
        ...

    def save(self, path: Path, state: Mapping[str, Tensor], about: Mapping[str, str]) -> None:
        """Writes weights, with words about them."""
        ...

    def load(self, path: Path) -> None:
        """Puts weights that `save` wrote into the network. Raises ModelFileError for those of another network."""
        ...


class DefaultKind:
    """`VoxelPoseNet` with its loss."""

    readers = ("score", "features", "embedding", "judge", "refinement.embedding", "refinement.leave")

    def __init__(self, config: TrainConfig, device: torch.device):
        self.config = config
        self.net = self._make(device)

    def _make(self, device: torch.device) -> VoxelPoseNet:
        net = VoxelPoseNet(self.config.net).to(device)
        _channels_last(net)
        return net

    def learn(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        with torch.autocast(batch.depth.device.type, torch.bfloat16, enabled=self.config.bf16):
            scores, output = self.net.scores(batch.depth, batch.keypoints, batch.root_z, batch.floor)
        return loss(scores, self.net.centers, output, batch.joints, batch.root_z, batch.in_view & ~batch.occluded)

    def estimate(self, net: nn.Module, batch: Batch) -> Estimate:
        return read_default(net, batch)

    def copy(self, state: Mapping[str, Tensor]) -> nn.Module:
        net = self._make(next(self.net.parameters()).device)
        net.load_state_dict(state)
        return net.eval()

    def save(self, path: Path, state: Mapping[str, Tensor], about: Mapping[str, str]) -> None:
        save_weights(path, state, self.config.net, about)

    def load(self, path: Path) -> None:
        given = load_net(path)
        wanted = self.config.net
        if given.config not in _beginnings(wanted):
            raise ModelFileError(f"{path}: weights of a network of {given.config}, must be {wanted}")
        self.net.load_state_dict(_widened(given.state_dict(), self.net.state_dict()))


class PaperKind:
    """The published network with its loss, on input made by `paper_data`."""

    readers = ("det", "scorevolume")

    def __init__(self, config: TrainConfig, device: torch.device):
        self.config = config
        self.net = PaperNet(config.network).to(device)
        _channels_last(self.net)

    def learn(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        made = paper_data.paper_batch(batch, self.config.grid)
        with torch.autocast(batch.depth.device.type, torch.bfloat16, enabled=self.config.bf16):
            volumes = self.net(made.input.contiguous(memory_format=torch.channels_last_3d))
        total = paper_loss(tuple(v.float() for v in volumes), made.cells)
        metres, _ = paper_data.peaks(volumes[-1].detach().float(), made.origin)
        away = (metres - paper_data.to_metres(batch.joints, batch.root_z)).norm(dim=-1)
        return total, {"error": away.mean(), "rooted": made.rooted.float().mean()}

    def estimate(self, net: nn.Module, batch: Batch) -> Estimate:
        volumes, origins = [], []
        for i in range(len(batch.depth)):  # one by one: a person takes a gigabyte
            made = paper_data.paper_batch(Batch(*(t[i : i + 1] for t in batch)), self.config.grid)
            volumes.append(net(made.input)[-1])
            origins.append(made.origin)
        metres, score = paper_data.peaks(torch.cat(volumes), torch.cat(origins))
        cell = paper_data.cell_size(self.config.grid)
        sigma = np.stack([sigma_of_score(s, cell) for s in score.double().cpu().numpy()])
        joints = paper_data.assembled(metres, score, batch)
        return Estimate(joints, torch.as_tensor(sigma, dtype=score.dtype, device=score.device), score.clamp(0, 1))

    def copy(self, state: Mapping[str, Tensor]) -> nn.Module:
        net = PaperNet(self.config.network).to(next(self.net.parameters()).device)
        net.load_state_dict(state)
        return net.eval()

    def save(self, path: Path, state: Mapping[str, Tensor], about: Mapping[str, str]) -> None:
        net = PaperNet(self.config.network)
        net.load_state_dict(state)
        save_paper_weights(net.variables(), path, about)

    def load(self, path: Path) -> None:
        weights, _ = read_paper_weights(path)
        self.net.load_variables(weights, str(path))


def _channels_last(net: nn.Module) -> None:
    """Lays the kernels in memory as convolutions on a CPU are fastest."""
    for module in net.modules():
        if isinstance(module, nn.Conv3d | nn.ConvTranspose3d):
            module.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]


def _beginnings(wanted: NetConfig) -> list[NetConfig]:
    """Networks whose weights one with more inputs and layers can begin with."""
    return [wanted, replace(wanted, refinement=0), replace(wanted, floor=False, refinement=0)]


def _widened(state: Mapping[str, Tensor], like: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of a network with fewer inputs and layers, for one like `like`, which says the same: of inputs that are
    new, last of all, it takes no notice yet, and new layers are fresh.
    """
    out = dict(like)
    for name, tensor in state.items():
        out[name] = torch.zeros_like(like[name])
        out[name][tuple(slice(n) for n in tensor.shape)] = tensor
    return out


def make(config: TrainConfig, device: torch.device) -> Kind:
    """The network of a configuration, with fresh weights."""
    return DefaultKind(config, device) if config.network == "default" else PaperKind(config, device)


def read_default(net: nn.Module, batch: Batch) -> Estimate:
    """What the default network says of people."""
    out = net(batch.depth, batch.keypoints, batch.root_z, batch.floor)
    return Estimate(out.joints, out.head[..., 0].exp(), out.head[..., 1].sigmoid())
