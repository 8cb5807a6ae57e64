"""A store of simulated hands on disk, made once and used for many epochs (torch).

FOLDER/000000.safetensors ...   512 hands each; shard `i` is a function of the settings and of `i`
FOLDER/settings.json            what they were made with
"""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import torch
from safetensors.torch import load_file, save

from understudy.errors import UnderstudyError
from understudy.files import read_json, write_atomically
from understudy.synthetic.bodies import load_bank
from understudy.synthetic.hand_bank import load_hands
from understudy.synthetic.hand_samples import HandBatch, HandConfig, HandSamples

SHARD: Final = 512
"""hands"""
VERSION: Final = 7
"""Of what the simulation makes of the same settings."""
_BATCH = 64


@dataclass(frozen=True)
class PoolConfig:
    """What is simulated."""

    samples: HandConfig = field(default_factory=HandConfig)
    bodies: int = 320
    hands: int = 160
    """different hands"""
    bank_seed: int = 1
    """of bodies and hands"""
    seed: int = 0
    """of everything else"""
    version: int = VERSION


class HandPool:
    """The shards of one folder."""

    def __init__(self, folder: Path, config: PoolConfig, shards: int):
        self.folder, self.config, self.shards = folder, config, shards

    def fill(self, workers: int = 1, progress: Callable[[int], object] = lambda done: None) -> None:
        """Makes the shards that are missing, in `workers` processes. `progress` gets the number that are there.

        Raises UnderstudyError when the folder holds hands of other settings.
        """
        self._claim()
        missing = [i for i in range(self.shards) if not self._path(i).exists()]
        progress(self.shards - len(missing))
        if not missing:
            return
        load_bank("anny", self.config.bodies, self.config.bank_seed)  # once, before all processes want them
        load_hands(self.config.hands, self.config.bank_seed)
        for n, _ in enumerate(self._made(missing, workers), self.shards - len(missing) + 1):
            progress(n)

    def _made(self, missing: list[int], workers: int) -> Iterator[int]:
        jobs = [(self.config, i, self._path(i)) for i in missing]
        if workers < 2:
            yield from map(_make, jobs)
            return
        context = multiprocessing.get_context("spawn")
        with context.Pool(workers, _one_thread) as processes:
            yield from processes.imap(_make, jobs)

    def load(self) -> HandBatch:
        """All hands, depths as float16."""
        parts = [load_file(self._path(i)) for i in range(self.shards)]
        return HandBatch(**{name: torch.cat([part.pop(name) for part in parts]) for name in HandBatch._fields})

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:06d}.safetensors"

    def _claim(self) -> None:
        path, settings = self.folder / "settings.json", json.loads(json.dumps(asdict(self.config)))
        if path.exists() and read_json(path) != settings:
            raise UnderstudyError(f"{path}: the hands there were made with other settings; delete the folder")
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(settings, indent=1) + "\n")


def _one_thread() -> None:
    torch.set_num_threads(1)


_SAMPLES: dict[str, HandSamples] = {}


def _make(job: tuple[PoolConfig, int, Path]) -> int:
    config, number, path = job
    key = json.dumps(asdict(config))
    if key not in _SAMPLES:
        bodies = load_bank("anny", config.bodies, config.bank_seed)
        hands = load_hands(config.hands, config.bank_seed)
        _SAMPLES[key] = HandSamples(bodies, hands, config.samples, config.seed)
    per_shard = SHARD // _BATCH
    parts = [_SAMPLES[key].batch(number * per_shard + k, _BATCH) for k in range(per_shard)]
    data: dict[str, Any] = {n: torch.cat([getattr(p, n) for p in parts]).contiguous() for n in HandBatch._fields}
    data["depth"] = data["depth"].half()
    write_atomically(path, save(data))
    return os.getpid()
