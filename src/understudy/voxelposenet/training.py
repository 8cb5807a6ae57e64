"""Training of the default network: one configuration in, weights and the record of how they came about out.

    OUT/config.json            the effective configuration, versions, command
    OUT/log.csv                one line every `log_every` steps
    OUT/validation.csv         one line per validation: errors over all, visible, occluded joints, calibration
    OUT/checkpoint.safetensors weights, moving average, optimiser; a run that is started again goes on from here
    OUT/weights.safetensors    the moving average: what is shipped
"""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Sampler

from understudy.errors import UnderstudyError
from understudy.files import write_atomically
from understudy.synthetic.samples import Batch
from understudy.voxelposenet.checkpoint import load_checkpoint, save_checkpoint, save_weights
from understudy.voxelposenet.data import Batches, DataConfig
from understudy.voxelposenet.loss import loss
from understudy.voxelposenet.net import NetConfig, VoxelPoseNet
from understudy.voxelposenet.validation import validate

CONFIG, LOG, VALIDATION, CHECKPOINT, WEIGHTS = (
    "config.json", "log.csv", "validation.csv", "checkpoint.safetensors", "weights.safetensors",
)  # fmt: skip


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the weights."""

    net: NetConfig = field(default_factory=NetConfig)
    data: DataConfig = field(default_factory=DataConfig)
    steps: int = 8000
    batch: int = 16
    """people per step and process"""
    learning_rate: float = 2e-3
    warmup: int = 300
    """steps of linear increase; a cosine follows, down to a hundredth"""
    weight_decay: float = 0.02
    ema: float = 0.998
    """of the moving average of the weights; 0 = none"""
    clip: float = 5.0
    """largest norm of the gradient"""
    bf16: bool = True
    """bfloat16 autocast"""
    seed: int = 0
    validation_samples: int = 512
    validation_seed: int = 1_000_003
    validate_every: int = 1000
    checkpoint_every: int = 250
    log_every: int = 25
    workers: int = 1
    """processes that simulate"""
    device: str = "cpu"


PRESETS: dict[str, TrainConfig] = {
    "default": TrainConfig(),
    "smoke": TrainConfig(
        net=NetConfig(channels=(8, 8, 8), channels_2d=8, lifted=2),
        data=DataConfig(bodies="capsules", capsules=4),
        steps=6, batch=4, warmup=2, validation_samples=8, validate_every=3, checkpoint_every=2, log_every=1, workers=0,
    ),
}  # fmt: skip
"""Name -> configuration. `smoke` proves that everything runs."""


class _Numbers(Sampler[int]):
    """Numbers of the batches of one process, from where training stands."""

    def __init__(self, start: int, stop: int, rank: int, world: int):
        self.numbers = range(start * world + rank, stop * world, world)

    def __iter__(self) -> Iterator[int]:
        return iter(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)


@dataclass
class _World:
    """The processes that train together (torchrun); one when started without it."""

    rank: int = 0
    size: int = 1

    @classmethod
    def join(cls, device: str) -> _World:
        if "WORLD_SIZE" not in os.environ or int(os.environ["WORLD_SIZE"]) < 2:
            return cls()
        torch.distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        return cls(torch.distributed.get_rank(), torch.distributed.get_world_size())


class Trainer:
    """One training run. `run` returns when the last step is done, or on an interruption, which loses nothing."""

    def __init__(self, config: TrainConfig, out: Path):
        self.config, self.out = config, Path(out)
        self.world = _World.join(config.device)
        torch.manual_seed(config.seed)
        self.net = _channels_last(VoxelPoseNet(config.net).to(config.device))
        decay = [p for p in self.net.parameters() if p.ndim > 1]
        rest = [p for p in self.net.parameters() if p.ndim <= 1]
        groups = [{"params": decay, "weight_decay": config.weight_decay}, {"params": rest, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, fused=True)
        self.average = {k: v.detach().clone() for k, v in self.net.state_dict().items()}
        self.step, self.seconds = 0, 0.0
        self._prepare()

    def _prepare(self) -> None:
        """Makes the folder, or goes on with the run that it holds if that has the same configuration."""
        now = json.loads(json.dumps(asdict(self.config)))
        path = self.out / CONFIG
        if path.exists():
            before = json.loads(path.read_text())["config"]
            free = ("steps", "workers", "device", "checkpoint_every", "log_every", "validate_every")
            different = [k for k in now if k not in free and before.get(k) != now[k]]
            if different:
                raise UnderstudyError(
                    f"{path}: the run there has another {different[0]} ({before.get(different[0])!r}, now "
                    f"{now[different[0]]!r}); choose another folder, or delete that one"
                )
        if (self.out / CHECKPOINT).exists():
            self.step, self.seconds = load_checkpoint(self.out / CHECKPOINT, self.net, self.average, self.optimizer)
        if self.world.rank == 0:
            about = {"config": now, "command": sys.argv, "torch": torch.__version__, "machine": platform.processor() or platform.machine(), "processes": self.world.size}
            write_atomically(path, json.dumps(about, indent=1) + "\n")

    def run(self, report: Callable[[dict[str, Any]], object] = lambda row: None) -> VoxelPoseNet:
        """Trains to the end; `report` gets each line of the log. Returns the network with the averaged weights."""
        config = self.config
        model: nn.Module = _Scores(self.net)
        if self.world.size > 1:
            model = nn.parallel.DistributedDataParallel(model)
        batches = Batches(config.data, config.batch, config.seed, 2**62)
        numbers = _Numbers(self.step, config.steps, self.world.rank, self.world.size)
        loader = DataLoader(batches, batch_size=None, sampler=numbers, num_workers=config.workers,
                            prefetch_factor=4 if config.workers else None, worker_init_fn=_one_thread)  # fmt: skip
        start, seconds, sums, since = time.monotonic(), self.seconds, {}, 0
        try:
            for batch in loader:
                parts = self._learn(model, Batch(*(t.to(config.device) for t in batch)))
                self.step += 1
                since += 1
                self.seconds = seconds + time.monotonic() - start
                sums = {k: sums.get(k, 0.0) + v for k, v in parts.items()}
                if self.step % config.log_every == 0 or self.step == config.steps:
                    row = {"step": self.step, "hours": round(self.seconds / 3600, 4), "learning_rate": self._rate(),
                           **{k: round(float(v) / since, 5) for k, v in sums.items()}}  # fmt: skip
                    self._log(LOG, row)
                    report(row)
                    sums, since = {}, 0
                if self.step % config.checkpoint_every == 0:
                    self._save()
                if self.step % config.validate_every == 0 or self.step == config.steps:
                    report(self._validate())
        finally:
            self._save()
        return self.averaged()

    def _learn(self, model: nn.Module, batch: Batch) -> dict[str, Tensor]:
        self.net.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate()
        with torch.autocast(batch.depth.device.type, torch.bfloat16, enabled=self.config.bf16):
            logits, output = model(batch.depth, batch.keypoints, batch.root_z)
        total, parts = loss(logits, output, batch.joints, batch.root_z, batch.in_view & ~batch.occluded)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), self.config.clip)
        self.optimizer.step()
        share = min(self.config.ema, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for k, v in self.net.state_dict().items():
                if v.is_floating_point():
                    self.average[k].lerp_(v, 1 - share)
                else:
                    self.average[k].copy_(v)
        return {"loss": total.detach(), **{k: v.detach() for k, v in parts.items()}}

    def _rate(self) -> float:
        c = self.config
        if self.step < c.warmup:
            return c.learning_rate * (self.step + 1) / c.warmup
        done = (self.step - c.warmup) / max(1, c.steps - c.warmup)
        return c.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))

    def averaged(self) -> VoxelPoseNet:
        """A copy with the averaged weights, for use."""
        net = VoxelPoseNet(self.config.net).to(self.config.device)
        net.load_state_dict(self.average)
        return net.eval()

    def _validate(self) -> dict[str, Any]:
        if self.world.rank:
            return {}
        c = self.config
        data = replace(c.data, bodies_seed=c.data.bodies_seed + 1000, anny=60, capsules=40)
        batches = Batches(data, 16, c.validation_seed, math.ceil(c.validation_samples / 16))
        row = {"step": self.step, "hours": round(self.seconds / 3600, 4), **validate(self.averaged(), batches)}
        self._log(VALIDATION, row)
        return row

    def _log(self, name: str, row: dict[str, Any]) -> None:
        if self.world.rank:
            return
        path = self.out / name
        new = not path.exists()
        with path.open("a", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)

    def _save(self) -> None:
        if self.world.rank:
            return
        save_checkpoint(self.out / CHECKPOINT, self.net, self.average, self.optimizer, self.step, self.seconds)
        save_weights(self.out / WEIGHTS, self.average, self.config.net, {"step": str(self.step)})


class _Scores(nn.Module):
    """`VoxelPoseNet.scores` as a module's forward, which data-parallel training wraps."""

    def __init__(self, net: VoxelPoseNet):
        super().__init__()
        self.net = net

    def forward(self, depth: Tensor, keypoints: Tensor, root_z: Tensor) -> Any:
        return self.net.scores(depth, keypoints, root_z)


def _channels_last(net: VoxelPoseNet) -> VoxelPoseNet:
    for module in net.modules():
        if isinstance(module, nn.Conv3d | nn.ConvTranspose3d):
            module.to(memory_format=torch.channels_last_3d)
    return net


def _one_thread(worker: int) -> None:
    torch.set_num_threads(1)
