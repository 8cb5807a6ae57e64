"""Training of the MLP baseline (torch): a few minutes on a CPU, on the same simulated people as the network.

    python -m understudy.voxelposenet.mlp OUT.safetensors --minutes 6

It runs without torch: `understudy.baselines.MlpPredictor`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save
from torch import Tensor, nn

from understudy.baselines import FORMAT, N_FEATURES, mirrored, mlp_input
from understudy.errors import UnderstudyError
from understudy.files import write_atomically
from understudy.skeleton import N_JOINTS
from understudy.synthetic.samples import Batch
from understudy.voxelposenet.data import Batches, DataConfig
from understudy.voxelposenet.loss import COVERED, WITHIN, metric_error, to_metric
from understudy.voxels import HALF

_FRESH = 64  # new people per round
_ROUND = 15  # steps of optimisation per round
_BATCH = 256  # people per step, from all so far
_POOL = 200_000  # people that are kept


class Mlp(nn.Module):
    """Residual blocks of two layers; corrects the naive estimate, and judges itself (log sigma, logit of 'within')."""

    mean: Tensor
    std: Tensor

    def __init__(self, hidden: int = 512, blocks: int = 2):
        super().__init__()
        self.first = nn.Linear(N_FEATURES, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, hidden)) for _ in range(blocks)
        )
        self.joints = nn.Linear(hidden, 3 * N_JOINTS)
        self.judge = nn.Linear(hidden, 2 * N_JOINTS)
        nn.init.zeros_(self.joints.weight)
        nn.init.zeros_(self.joints.bias)
        self.register_buffer("mean", torch.zeros(N_FEATURES))
        self.register_buffer("std", torch.ones(N_FEATURES))

    def forward(self, features: Tensor, naive: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (b, 18, 3) in view coordinates; (b, 2, 18): log sigma (metres), logit of 'within 10 cm'."""
        x = self.first((features - self.mean) / self.std)
        for block in self.blocks:
            x = x + block(F.relu(x))
        x = F.relu(x)
        return naive + self.joints(x).view_as(naive), self.judge(x.detach()).view(-1, 2, N_JOINTS)


@dataclass(frozen=True)
class Example:
    """People as the MLP sees them; rows. And the truth."""

    features: Tensor
    naive: Tensor
    joints: Tensor
    root_z: Tensor

    @classmethod
    def of(cls, batch: Batch, mirror: bool) -> Example:
        depth, keypoints, root_z = (t.numpy() for t in (batch.depth, batch.keypoints, batch.root_z))
        joints = batch.joints.numpy()
        if mirror:
            depth, keypoints, joints = np.ascontiguousarray(depth[..., ::-1]), mirrored(keypoints), mirrored(joints)
        features, naive = mlp_input(depth, keypoints, root_z)
        return cls(*(torch.from_numpy(np.ascontiguousarray(a)) for a in (features, naive, joints, root_z)))

    def rows(self, index: Tensor) -> Example:
        return Example(*(t[index] for t in vars(self).values()))

    @classmethod
    def joined(cls, parts: Sequence[Example]) -> Example:
        return cls(*(torch.cat(column) for column in zip(*(vars(p).values() for p in parts), strict=True)))


@runtime_checkable
class BatchSource(Protocol):
    """Batch by number."""

    def __getitem__(self, number: int) -> Batch: ...


def mlp_loss(joints: Tensor, judged: Tensor, truth: Example) -> Tensor:
    """L1 in metres over joints inside the network's grid, and the judge's quantile and cross-entropy losses."""
    inside = (truth.joints.abs() < HALF).all(-1).float()
    off = to_metric(joints, truth.root_z) - to_metric(truth.joints, truth.root_z)
    position = (off.abs().sum(-1) * inside).sum() / inside.sum().clamp_min(1)
    error = metric_error(joints, truth.joints, truth.root_z).detach()
    surprise = error.clamp_min(1e-3).log() - judged[:, 0]
    sigma = torch.maximum(COVERED * surprise, (COVERED - 1) * surprise).mean()
    within = F.binary_cross_entropy_with_logits(judged[:, 1], (error < WITHIN).float())
    return 10 * position + sigma + within


def train_mlp(
    out: Path,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    hidden: int = 512,
    blocks: int = 2,
    learning_rate: float = 1e-3,
    data: DataConfig | None = None,
    batches: BatchSource | None = None,
    progress: bool = False,
) -> Mlp:
    """Trains and writes `out` (safetensors). Give `minutes`, or `steps`: the same ones give the same weights.

    New people are simulated all the time; each round of steps draws from all people so far, mirrored ones too.
    batches: in place of the simulated ones that `data` describes.
    """
    if (minutes is None) == (steps is None):
        raise UnderstudyError("train_mlp: give either minutes or steps")
    source = batches or Batches(data or DataConfig(), _FRESH, seed + 31, 2**40)
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    net = Mlp(hidden, blocks)
    optimizer = torch.optim.AdamW(net.parameters(), lr=learning_rate, weight_decay=0.02)
    pool: list[Example] = []
    average = 0.0
    start, step, number = time.monotonic(), 0, 0
    while (done := _done(start, minutes, step, steps)) < 1:
        batch = source[number]
        pool = [*pool, Example.of(batch, False), Example.of(batch, True)][-_POOL // len(batch.joints) :]
        number += 1
        if len(pool) * len(batch.joints) < _BATCH and number < 8:
            continue
        everyone = Example.joined(pool)
        if step == 0:
            net.mean.copy_(everyone.features.mean(0))
            net.std.copy_(everyone.features.std(0).clamp_min(0.05))
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (0.01 + 0.99 * 0.5 * (1 + np.cos(np.pi * done)))
        for _ in range(_ROUND):
            some = everyone.rows(torch.randint(len(everyone.joints), (_BATCH,), generator=generator))
            joints, judged = net(some.features, some.naive)
            value = mlp_loss(joints, judged, some)
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            step += 1
            average += 0.02 * (float(value.detach()) - average)
        if progress and number % 50 == 0:
            print(f"step {step}, {len(everyone.joints)} people, loss {average:.3f}", flush=True)
    about = {
        "format": FORMAT, "hidden": str(hidden), "blocks": str(blocks), "steps": str(step), "seed": str(seed),
        "people": str(number * _FRESH), "minutes": f"{(time.monotonic() - start) / 60:.1f}",
    }  # fmt: skip
    if steps is not None:
        del about["minutes"]
    write_atomically(out, save({k: v.contiguous() for k, v in net.state_dict().items()}, about))
    return net.eval()


def _done(start: float, minutes: float | None, step: int, steps: int | None) -> float:
    """Share of the training."""
    if steps is not None:
        return step / max(1, steps)
    assert minutes is not None
    return (time.monotonic() - start) / max(1e-9, 60 * minutes)


def main(arguments: Sequence[str] | None = None) -> None:
    """Trains the MLP baseline."""
    parser = argparse.ArgumentParser(prog="python -m understudy.voxelposenet.mlp", description=main.__doc__)
    parser.add_argument("out", type=Path, help="file to write (safetensors)")
    parser.add_argument("--minutes", type=float, default=None, help="wall time (default: by --steps)")
    parser.add_argument("--steps", type=int, default=None, help="steps of 256 people; reproducible (default 20000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bodies", default="both", help="body set: anny, capsules, both")
    parser.add_argument("--threads", type=int, default=2)
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(chosen.threads)
    steps = 20_000 if chosen.minutes is None and chosen.steps is None else chosen.steps
    train_mlp(
        chosen.out, minutes=chosen.minutes, steps=steps, seed=chosen.seed,
        data=DataConfig(bodies=chosen.bodies), progress=True,
    )  # fmt: skip


if __name__ == "__main__":
    main()
