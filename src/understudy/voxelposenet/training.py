"""Training: one configuration in, weights and the record of how they came about out.

OUT/config.json              the effective configuration, versions, command
OUT/log.csv                  one line every `log_every` steps
OUT/validation.csv           one line per validation: errors over all, visible, occluded joints, calibration
OUT/validation_joints.csv    the same validations per joint; also _distance and _sensor
OUT/*.png                    curves, see `curves`
OUT/checkpoint.safetensors   weights, moving average, optimiser; a run that is started again goes on from here
OUT/weights.safetensors      the moving average: what is shipped
"""

from __future__ import annotations

import json
import math
import os
import platform
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Sampler

from understudy.errors import MissingExtraError, UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.synthetic.samples import Batch
from understudy.synthetic.sensors import SENSORS
from understudy.voxelposenet import curves, kinds, records, validation
from understudy.voxelposenet.checkpoint import WITHOUT, load_checkpoint, save_checkpoint
from understudy.voxelposenet.data import Batches
from understudy.voxelposenet.optimizers import Optimizers
from understudy.voxelposenet.processes import Stop, World
from understudy.voxelposenet.train_config import PRESETS, TrainConfig, differences, from_json

__all__ = ["PRESETS", "TrainConfig", "Trainer", "read_config"]

CONFIG, CHECKPOINT, WEIGHTS = "config.json", "checkpoint.safetensors", "weights.safetensors"
_VALIDATION_BATCH = 16
_VALIDATION_BODIES = {"anny": 60, "capsules": 40}


class _Numbers(Sampler[int]):
    """Numbers of the batches of one process, from where training stands."""

    def __init__(self, start: int, stop: int, rank: int, world: int):
        self.numbers = range(start * world + rank, stop * world, world)

    def __iter__(self) -> Iterator[int]:
        return iter(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)


class Trainer:
    """One training run. `run` returns when the last step is done; an interruption loses nothing."""

    def __init__(self, config: TrainConfig, out: Path):
        self.config, self.out = config, Path(out)
        self.world = World.join(config.device)
        torch.manual_seed(config.seed)
        self.kind = kinds.make(config, self.world.device)
        self.net = self.kind.net
        if config.init and not (self.out / CHECKPOINT).exists():
            self.kind.load(Path(config.init))
        self.optimizers = Optimizers(
            self.net, config.optimizer, config.learning_rate, config.weight_decay, self.kind.readers
        )
        self.average = {k: v.detach().clone() for k, v in self.net.state_dict().items()}
        self.step, self.seconds = 0, 0.0
        self._saved = -1  # step of the checkpoint on disk
        self._prepare()

    def _prepare(self) -> None:
        """Makes the folder, or goes on with the run that it holds if that has the same configuration."""
        path = self.out / CONFIG
        if path.exists():
            for name, (before, now) in differences(read_config(path), self.config).items():
                raise UnderstudyError(
                    f"{path}: the run there has another {name} ({before!r}, now {now!r}); choose another folder, or "
                    "delete that one"
                )
        if (self.out / CHECKPOINT).exists():
            self.step, self.seconds = load_checkpoint(
                self.out / CHECKPOINT, self.net, self.average, self.optimizers.each
            )
            self._saved = self.step
        if self.world.size > 1:
            torch.distributed.barrier()  # all have read what the first one now writes
        if self.world.rank == 0:
            for name in (records.LOG, records.VALIDATION, *records.TABLES.values()):
                records.keep_until(self.out / name, self.step)
            machine = platform.processor() or platform.machine()
            about: dict[str, Any] = {"config": asdict(self.config), "command": sys.argv, "torch": torch.__version__}
            about |= {"machine": machine, "processes": self.world.size}
            write_atomically(path, json.dumps(about, indent=1) + "\n")

    def run(
        self,
        report: Callable[[dict[str, Any]], object] = lambda row: None,
        progress: Callable[[int], object] = lambda step: None,
    ) -> nn.Module:
        """Trains to the end. Returns the network with the averaged weights.

        report: gets each line of the log (it has `loss`) and of the validations (`all`). progress: gets the number of
        steps done after each. Raises KeyboardInterrupt after it has saved when Ctrl-C or SIGTERM asks to stop.
        """
        config = self.config
        model: nn.Module = _Learning(self.kind)
        if config.compile and _can_compile():
            model.compile()
        if self.world.size > 1:
            model = nn.parallel.DistributedDataParallel(model)
        batches = Batches(config.data, config.batch, config.seed, 2**62)
        numbers = _Numbers(self.step, config.steps, self.world.rank, self.world.size)
        start, seconds, sums, since = time.monotonic(), self.seconds, dict[str, Tensor](), 0
        with Stop() as stop:
            self._validate(report, stop)  # when an interruption came between a step and its validation
            loader = DataLoader(batches, batch_size=None, sampler=numbers, num_workers=config.workers,
                                prefetch_factor=4 if config.workers else None, worker_init_fn=_worker)  # fmt: skip
            for batch in loader:
                parts = self._learn(model, Batch(*(t.to(self.world.device) for t in batch)))
                self.step += 1
                since += 1
                self.seconds = seconds + time.monotonic() - start
                sums = {k: sums[k] + v if k in sums else v for k, v in parts.items()}
                progress(self.step)
                if self.step % config.log_every == 0 or self.step == config.steps:
                    self._log({k: float(v) / since for k, v in sums.items()}, report)
                    sums, since = {}, 0
                asked = self.world.any(stop.asked)
                if self.step % config.checkpoint_every == 0 or self.step == config.steps or asked:
                    self._save()
                if asked:
                    raise KeyboardInterrupt
                self._validate(report, stop)
                self.seconds = seconds + time.monotonic() - start
            self._save()
        return self.averaged()

    def _learn(self, model: nn.Module, batch: Batch) -> dict[str, Tensor]:
        self.net.train()
        total, parts = model(*batch)
        self.optimizers.zero_grad()
        total.backward()
        if self.config.clip:
            nn.utils.clip_grad_norm_(self.net.parameters(), self.config.clip)
        self.optimizers.step(self.config.rate(self.step))
        keep = self.config.average_share(self.step)
        with torch.no_grad():
            for k, v in self.net.state_dict().items():
                if v.is_floating_point():
                    self.average[k].lerp_(v, 1 - keep)
                else:
                    self.average[k].copy_(v)
        return {"loss": total.detach(), **{k: v.detach() for k, v in parts.items()}}

    def averaged(self) -> nn.Module:
        """A copy with the averaged weights, for use."""
        return self.kind.copy(self.average)

    def close(self) -> None:
        """Leaves the processes that train together."""
        if self.world.size > 1:
            torch.distributed.destroy_process_group()

    def _log(self, means: Mapping[str, float], report: Callable[[dict[str, Any]], object]) -> None:
        if not math.isfinite(means["loss"]):
            raise UnderstudyError(
                f"step {self.step}: the loss is {means['loss']}; the last good state is {self.out / CHECKPOINT}. "
                "A lower learning_rate or clip may help"
            )
        row = {**self._when(), "learning_rate": self.config.rate(self.step - 1)}
        row |= {k: round(v, 5) for k, v in means.items()}
        if self.world.rank == 0:
            records.append(self.out / records.LOG, [row])
            report(row)

    def _when(self) -> dict[str, Any]:
        return {"step": self.step, "hours": round(self.seconds / 3600, 4)}

    def _validate(self, report: Callable[[dict[str, Any]], object], stop: Stop) -> None:
        """Validates in the first process, if it is time to and has not been done."""
        due = self.step > 0 and (self.step % self.config.validate_every == 0 or self.step == self.config.steps)
        if not due or self.world.rank:
            return
        if any(int(row["step"]) == self.step for row in records.read(self.out / records.VALIDATION)):
            return
        self._save()

        def unless_stopped(batches: Batches) -> Iterator[Batch]:
            for batch in batches:
                if stop.asked and self.world.size == 1:  # together, all stop after the next step
                    raise KeyboardInterrupt
                yield Batch(*(t.to(self.world.device) for t in batch))

        results = validation.collect(self.averaged(), unless_stopped(self._validation()), self.kind.estimate)
        for kind, name in records.TABLES.items():
            rows = validation.TABLES[kind](results, self.config.data.samples.sensors)
            records.append(self.out / name, [{**self._when(), **row} for row in rows])
        row = {**self._when(), **validation.summary(results)}
        records.append(self.out / records.VALIDATION, [row])
        report(row)
        if self.config.plots:
            try:
                curves.write(self.out)
            except MissingExtraError as e:
                warnings.warn(str(e), stacklevel=2)

    def _validation(self) -> Batches:
        """Other people and scenes than those of training, with every sensor."""
        data = self.config.data
        counts = {k: min(n, getattr(data, k)) for k, n in _VALIDATION_BODIES.items()}
        samples = replace(data.samples, sensors=tuple(SENSORS))
        data = replace(data, bodies_seed=data.bodies_seed + 1000, samples=samples, **counts)
        count = math.ceil(self.config.validation_samples / _VALIDATION_BATCH)
        return Batches(data, _VALIDATION_BATCH, self.config.validation_seed, count)

    def _save(self) -> None:
        if self.world.rank or self._saved == self.step:
            return
        save_checkpoint(self.out / CHECKPOINT, self.net, self.average, self.optimizers.each, self.step, self.seconds)
        self.kind.save(self.out / WEIGHTS, self.average, {"step": str(self.step)})
        self._saved = self.step


def _can_compile() -> bool:
    """Whether torch.compile has what it needs; says so where not."""
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler):
        return True
    warnings.warn(
        f"training goes without torch.compile, about 1.4 times as slowly: the C++ compiler {compiler!r} was not found",
        stacklevel=3,
    )
    return False


class _Learning(nn.Module):
    """`Kind.learn` as a module's forward, which data-parallel training wraps."""

    def __init__(self, kind: kinds.Kind):
        super().__init__()
        self.kind = kind
        self.net = kind.net

    def forward(self, *batch: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return self.kind.learn(Batch(*batch))


def read_config(path: Path, base: TrainConfig | None = None) -> TrainConfig:
    """A configuration from a file: a run's config.json, or a JSON object of some of `TrainConfig`'s fields.

    base: has what the file does not say. Raises UnderstudyError that names the file and the field.
    """
    data = read_json(path)
    inner = _completed(data["config"]) if isinstance(data.get("config"), dict) else data
    return from_json(inner, base or TrainConfig(), str(path))


def _completed(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a run with what runs did before it could be said."""
    net = config.get("net")
    return {"optimizer": "adamw", **config} | ({"net": {**WITHOUT, **net}} if isinstance(net, dict) else {})


def _worker(number: int) -> None:
    """A simulating process: one thread, and the keyboard is the main process's business."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
