"""Weights and checkpoints as safetensors: tensors and words only, nothing that could run (torch)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from understudy.errors import ModelFileError
from understudy.files import write_atomically
from understudy.voxelposenet.net import NetConfig, VoxelPoseNet

FORMAT = "understudy-voxelposenet/1"

WITHOUT: Final = MappingProxyType({"floor": False, "refinement": 0})
"""What networks were that were made before `NetConfig` could say it"""


def save_weights(path: Path, state: Mapping[str, Tensor], config: NetConfig, about: Mapping[str, str]) -> None:
    """The weights with the sizes of their network, and whatever words are to travel with them."""
    tensors = {k: v.detach().cpu().contiguous().clone() for k, v in state.items()}
    words = {"format": FORMAT, "net": json.dumps(asdict(config)), **about}
    write_atomically(path, save(tensors, words))


def load_net(path: Path) -> VoxelPoseNet:
    """The network that `save_weights` wrote, ready for use. Raises ModelFileError for anything else."""
    tensors, words = _read(path)
    if words.get("format") != FORMAT:
        raise ModelFileError(f"{path}: format is {words.get('format')!r}, must be {FORMAT!r}")
    try:
        sizes = {**WITHOUT, **json.loads(words["net"])}
        net = VoxelPoseNet(NetConfig(**{**sizes, "channels": tuple(sizes["channels"])}))
        net.load_state_dict(tensors)
    except (RuntimeError, KeyError, TypeError, ValueError) as e:
        raise ModelFileError(f"{path}: the weights do not fit the network that the file describes: {e}") from e
    return net.eval()


def save_checkpoint(
    path: Path,
    net: torch.nn.Module,
    average: Mapping[str, Tensor],
    optimizers: Sequence[torch.optim.Optimizer],
    step: int,
    seconds: float,
) -> None:
    """All that a run needs to go on."""
    tensors = {f"net/{k}": v for k, v in net.state_dict().items()} | {f"average/{k}": v for k, v in average.items()}
    for name, optimizer in _named(optimizers):
        for i, values in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}/{i}/{k}": v for k, v in values.items()}
    flat = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
    write_atomically(path, save(flat, {"step": str(step), "seconds": str(seconds)}))


def load_checkpoint(
    path: Path, net: torch.nn.Module, average: dict[str, Tensor], optimizers: Sequence[torch.optim.Optimizer]
) -> tuple[int, float]:
    """Puts back what `save_checkpoint` wrote; returns the step and the seconds of training so far.

    Raises ModelFileError for a damaged file, or one of another network.
    """
    tensors, words = _read(path)
    try:
        return _restore(tensors, words, net, average, optimizers)
    except (RuntimeError, KeyError, ValueError) as e:
        raise ModelFileError(f"{path}: not a checkpoint of this network: {e}") from e


def _restore(
    tensors: Mapping[str, Tensor],
    words: Mapping[str, str],
    net: torch.nn.Module,
    average: dict[str, Tensor],
    optimizers: Sequence[torch.optim.Optimizer],
) -> tuple[int, float]:
    parts: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        part, _, rest = name.partition("/")
        parts.setdefault(part, {})[rest] = tensor
    step = int(words["step"])
    names = {"net", "average", *(name for name, _ in _named(optimizers))}
    if set(parts) - names or (step and names - set(parts)):
        raise ValueError(f"it has {', '.join(sorted(parts))}; must have {', '.join(sorted(names))}")
    net.load_state_dict(parts["net"])
    for k, v in parts["average"].items():
        average[k].copy_(v)
    for name, optimizer in _named(optimizers):
        parameters = dict(enumerate(p for group in optimizer.param_groups for p in group["params"]))
        state: dict[int, dict[str, Tensor]] = {}
        for key, tensor in parts.get(name, {}).items():
            i, _, k = key.partition("/")
            if tensor.ndim and tensor.shape != parameters[int(i)].shape:
                raise ValueError(f"{name}/{key} has the shape {tuple(tensor.shape)}, of another optimiser")
            state.setdefault(int(i), {})[k] = _laid_out_as(parameters[int(i)], tensor)
        if state:
            optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return step, float(words["seconds"])


def _named(optimizers: Sequence[torch.optim.Optimizer]) -> list[tuple[str, torch.optim.Optimizer]]:
    """What they are called in the file."""
    return [("optimizer" if i == 0 else f"optimizer{i + 1}", o) for i, o in enumerate(optimizers)]


def _laid_out_as(parameter: Tensor, value: Tensor) -> Tensor:
    """The value in the parameter's order in memory. The fused optimiser walks both in memory's order without looking
    at strides: a plain copy beside a channels-last parameter would silently exchange elements.
    """
    if value.shape != parameter.shape:
        return value
    return torch.empty_like(parameter, dtype=value.dtype).copy_(value)


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, "pt") as f:
            return {k: f.get_tensor(k) for k in f.keys()}, f.metadata() or {}  # noqa: SIM118
    except (SafetensorError, OSError) as e:
        raise ModelFileError(f"{path}: not a readable safetensors file: {e}") from e
