"""Simulated batches for training and validation (torch), by the names of body sets."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from torch.utils.data import Dataset

from understudy.errors import UnderstudyError, one_of
from understudy.synthetic.bodies import load_bank
from understudy.synthetic.samples import Batch, SampleConfig, Samples

BODY_SETS = ("anny", "capsules", "both")


@dataclass(frozen=True)
class DataConfig:
    """Which people are simulated."""

    bodies: str = "both"
    """body set: `anny`, `capsules`, or `both` (three batches of anny to one of capsules)"""
    anny: int = 320
    """bodies of that set; their number decides the cost of the first run only"""
    capsules: int = 160
    bodies_seed: int = 1
    """validation must use another one"""
    samples: SampleConfig = field(default_factory=SampleConfig)
    bvh: str | None = None
    """folder of motion capture that poses are drawn from, in place of sampled postures"""

    def json(self) -> dict[str, Any]:
        return asdict(self)


class Batches(Dataset[Batch]):
    """Batch `i` is a function of the configuration, the seed and `i`."""

    def __init__(self, config: DataConfig, size: int, seed: int, count: int):
        if config.bodies not in BODY_SETS:
            raise UnderstudyError(f"bodies {config.bodies!r}: must be {one_of(BODY_SETS)}")
        self.size, self.count = size, count
        poses = None
        if config.bvh:
            import torch

            from understudy.synthetic.bvh import load_folder

            poses = torch.as_tensor(load_folder(Path(config.bvh))).float()
        wanted = {"anny": config.anny, "capsules": config.capsules}
        banks = {k: load_bank(k, n, config.bodies_seed) for k, n in wanted.items() if config.bodies in (k, "both")}
        self._samples = [Samples(bank, config.samples, seed + 7 * k, poses) for k, bank in enumerate(banks.values())]

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, number: int) -> Batch:
        if number >= self.count:
            raise IndexError(number)
        return self._samples[len(self._samples) > 1 and number % 4 == 3].batch(number, self.size)
