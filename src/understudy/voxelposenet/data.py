"""Simulated batches for training and validation (torch), by the names of body sets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from torch.utils.data import Dataset

from understudy.errors import MissingExtraError, UnderstudyError, one_of
from understudy.synthetic.bodies import load_bank
from understudy.synthetic.samples import Batch, SampleConfig, Samples
from understudy.synthetic.sensors import SENSORS

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

    def __post_init__(self) -> None:
        if self.bodies not in BODY_SETS:
            raise UnderstudyError(f"bodies {self.bodies!r}: must be {one_of(BODY_SETS)}")
        if self.anny < 1 or self.capsules < 1:
            raise UnderstudyError(f"anny {self.anny}, capsules {self.capsules}: must be at least 1")
        unknown = [name for name in self.samples.sensors if name not in SENSORS]
        if unknown or not self.samples.sensors:
            raise UnderstudyError(f"sensors {self.samples.sensors!r}: must be some of {', '.join(SENSORS)}")


class Batches(Dataset[Batch]):
    """Batch `i` is a function of the configuration, the seed and `i`."""

    def __init__(self, config: DataConfig, size: int, seed: int, count: int):
        self.size, self.count = size, count
        poses = None
        if config.bvh:
            import torch

            from understudy.synthetic.bvh import load_folder

            poses = torch.as_tensor(load_folder(Path(config.bvh))).float()
        wanted = {"anny": config.anny, "capsules": config.capsules}
        try:
            banks = {k: load_bank(k, n, config.bodies_seed) for k, n in wanted.items() if config.bodies in (k, "both")}
        except MissingExtraError:
            raise
        except ImportError as e:
            raise MissingExtraError(f"bodies of the set {config.bodies!r}", "train") from e
        self._samples = [Samples(bank, config.samples, seed + 7 * k, poses) for k, bank in enumerate(banks.values())]

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[Batch]:
        return (self[i] for i in range(self.count))

    def __getitem__(self, number: int) -> Batch:
        if number >= self.count:
            raise IndexError(number)
        return self._samples[len(self._samples) > 1 and number % 4 == 3].batch(number, self.size)
