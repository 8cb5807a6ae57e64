"""The optimisers of both networks (torch): AdamW for everything, or Muon for the kernels and AdamW for the rest.

Muon (Jordan et al. 2024) takes the momentum of a matrix to the nearest orthogonal one before it steps. On the voxel
network, from random weights, it is a quarter of the steps ahead of AdamW, and costs a tenth of a step; from trained
weights it was no faster.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any, Final

import torch
from torch import Tensor, nn

OPTIMIZERS: Final = ("adamw", "muon")


class Optimizers:
    """Steps all parameters of a network; the learning rate is given anew for each step."""

    def __init__(
        self,
        net: nn.Module,
        kind: str,
        learning_rate: float,
        weight_decay: float,
        readers: Collection[str],
    ):
        """kind: one of OPTIMIZERS. readers: beginnings of the names of parameters that never go to Muon: those that
        read results out of features, and embeddings. weight_decay: of matrices and kernels.
        """
        muon: list[nn.Parameter] = []
        decay: list[nn.Parameter] = []
        rest: list[nn.Parameter] = []
        for name, p in net.named_parameters():
            if p.ndim < 2:
                rest.append(p)
            elif kind == "muon" and not name.startswith(tuple(readers)):
                muon.append(p)
            else:
                decay.append(p)
        groups: list[dict[str, Any]] = [{"params": decay, "weight_decay": weight_decay}]
        groups.append({"params": rest, "weight_decay": 0.0})
        self.net = net
        self.each: list[torch.optim.Optimizer] = [torch.optim.AdamW(groups, lr=learning_rate, fused=True)]
        if muon:
            self.each.append(KernelMuon(muon, learning_rate, weight_decay))

    def zero_grad(self) -> None:
        self.net.zero_grad(set_to_none=True)

    def step(self, learning_rate: float) -> None:
        for optimizer in self.each:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            optimizer.step()


class KernelMuon(torch.optim.Muon):
    """torch's Muon, which takes matrices, for kernels of any size: the first axis x all others (outputs x inputs and
    taps; of transposed convolutions inputs x outputs and taps).

    The matrices share memory with the kernels, whose steps are as large as AdamW's would be.
    """

    def __init__(self, kernels: Iterable[nn.Parameter], learning_rate: float, weight_decay: float):
        self.kernels = list(kernels)
        self.flat = [_flattening(kernel) for kernel in self.kernels]
        matrices = [flat(kernel.detach()) for kernel, flat in zip(self.kernels, self.flat, strict=True)]
        super().__init__(matrices, lr=learning_rate, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    def step(self, closure: Any = None) -> Any:
        matrices = self.param_groups[0]["params"]
        for kernel, flat, matrix in zip(self.kernels, self.flat, matrices, strict=True):
            matrix.grad = None if kernel.grad is None else flat(kernel.grad)
        return super().step(closure)


def _flattening(kernel: Tensor) -> Callable[[Tensor], Tensor]:
    """How a kernel becomes a matrix without being copied: by its order in memory."""
    if kernel.is_contiguous():
        return lambda t: t.flatten(1)
    last = kernel.movedim(1, -1)
    if not last.is_contiguous():
        raise ValueError(f"kernel of strides {kernel.stride()}: must be contiguous or channels-last")
    return lambda t: t.movedim(1, -1).flatten(1)
