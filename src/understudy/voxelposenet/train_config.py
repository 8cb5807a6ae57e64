"""What decides a training run: one dataclass, its presets, and its way to and from JSON (torch, by its parts)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, Final

from understudy.errors import UnderstudyError, one_of
from understudy.voxelposenet.data import DataConfig
from understudy.voxelposenet.net import NetConfig
from understudy.voxelposenet.optimizers import OPTIMIZERS

NETWORKS: Final = ("default", "paper", "paper-fast")
SCHEDULES: Final = ("cosine", "steps")
_AT_LEAST = {
    "steps": 1,
    "batch": 1,
    "validation_samples": 1,
    "validate_every": 1,
    "checkpoint_every": 1,
    "log_every": 1,
}
_AT_LEAST |= {"warmup": 0, "weight_decay": 0, "ema": 0, "clip": 0, "seed": 0, "workers": 0, "decay_every": 1}
_AT_LEAST |= {"learning_rate": 0, "grid": 8}


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the weights."""

    network: str = "default"
    """`default` (of the sizes `net`), or the published one: `paper`, `paper-fast`"""
    net: NetConfig = field(default_factory=NetConfig)
    grid: int = 64
    """cells along an edge of the paper's grid; other multiples of 8 are for trials; the default network has its own"""
    data: DataConfig = field(default_factory=DataConfig)
    steps: int = 8000
    batch: int = 16
    """people per step and process"""
    optimizer: str = "muon"
    """one of `optimizers.OPTIMIZERS`"""
    learning_rate: float = 2e-3
    warmup: int = 300
    """steps of linear increase before the schedule"""
    schedule: str = "cosine"
    """`cosine`: down to a hundredth at the last step; `steps`: a tenth after every `decay_every` steps"""
    decay_every: int = 10_000
    weight_decay: float = 0.02
    """of matrices and kernels; 0 makes `adamw` Adam"""
    ema: float = 0.998
    """of the moving average of the weights; 0 = none"""
    clip: float = 5.0
    """largest norm of the gradient; 0 = any"""
    bf16: bool = True
    """bfloat16 autocast"""
    compile: bool = True
    """through torch.compile, which needs a C++ compiler and a minute at the start, and is 1.4 times as fast"""
    init: str | None = None
    """file of weights to begin with in place of random ones"""
    seed: int = 0
    validation_samples: int = 512
    validation_seed: int = 1_000_003
    validate_every: int = 1000
    checkpoint_every: int = 250
    log_every: int = 25
    workers: int = 1
    """processes that simulate"""
    device: str = "cpu"
    """`cpu` or `cuda`"""
    plots: bool = True
    """draw the curves at each validation (needs matplotlib)"""

    def __post_init__(self) -> None:
        if self.network not in NETWORKS:
            raise UnderstudyError(f"network {self.network!r}: must be {one_of(NETWORKS)}")
        if self.optimizer not in OPTIMIZERS:
            raise UnderstudyError(f"optimizer {self.optimizer!r}: must be {one_of(OPTIMIZERS)}")
        if self.schedule not in SCHEDULES:
            raise UnderstudyError(f"schedule {self.schedule!r}: must be {one_of(SCHEDULES)}")
        for name, least in _AT_LEAST.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise UnderstudyError(f"{name} {value!r}: must be at least {least}")
        if self.ema >= 1:
            raise UnderstudyError(f"ema {self.ema!r}: must be below 1")
        if self.grid % 8:
            raise UnderstudyError(f"grid {self.grid!r}: must be a multiple of 8")

    def rate(self, step: int) -> float:
        """The learning rate of step `step` (the first is 0)."""
        if step < self.warmup:
            return self.learning_rate * (step + 1) / self.warmup
        if self.schedule == "steps":
            return self.learning_rate * 0.1 ** (step // self.decay_every)
        done = (step - self.warmup) / max(1, self.steps - self.warmup)
        return self.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))

    def average_share(self, step: int) -> float:
        """What the moving average keeps of itself in step `step`; less in the first steps."""
        return min(self.ema, (step + 1) / (step + 10))


PRESETS: Final = MappingProxyType(
    {
        "default": TrainConfig(),
        "smoke": TrainConfig(
            net=NetConfig(channels=(8, 8, 8), channels_2d=8, lifted=2),
            data=DataConfig(bodies="capsules", capsules=4),
            steps=6, batch=4, warmup=2, validation_samples=8, validate_every=3, checkpoint_every=2, log_every=1,
            workers=0, compile=False,
        ),
        "paper": TrainConfig(
            network="paper-fast", steps=40_000, batch=2, optimizer="adamw", learning_rate=1e-4, warmup=0,
            schedule="steps", weight_decay=0.0, ema=0.0, clip=0.0, bf16=False, compile=False,
        ),
    }
)  # fmt: skip
"""Name -> configuration. `smoke` proves that everything runs; `paper` is the published network and schedule."""

FREE: Final = ("steps", "workers", "device", "checkpoint_every", "log_every", "validate_every", "plots", "compile")
"""What may change when a run goes on."""


def from_json(data: Mapping[str, Any], base: TrainConfig, where: str) -> TrainConfig:
    """`base` with the values of a JSON object in place of its own.

    Raises UnderstudyError that begins with `where` and names the field.
    """
    config: TrainConfig = filled(data, base, where)
    return config


def filled(data: Mapping[str, Any], base: Any, where: str) -> Any:
    """`base`, any dataclass, with the values of a JSON object in place of its own; see `from_json`."""
    known = {f.name for f in fields(base)}
    changed: dict[str, Any] = {}
    for name, value in data.items():
        if name not in known:
            raise UnderstudyError(f"{where}: there is no {name!r}; must be {one_of(sorted(known))}")
        old = getattr(base, name)
        if is_dataclass(old):
            if not isinstance(value, Mapping):
                raise UnderstudyError(f"{where}: {name!r} must be an object, got {value!r}")
            changed[name] = filled(value, old, f"{where}: {name}")
        else:
            changed[name] = _value(value, old, f"{where}: {name!r}")
    try:
        return replace(base, **changed)
    except UnderstudyError as e:
        raise UnderstudyError(f"{where}: {e}") from e


def _value(value: Any, old: Any, where: str) -> Any:
    """A value of the kind that the field has."""
    if isinstance(old, tuple):
        kinds = {type(v) for v in old}
        if isinstance(value, list | tuple) and all(
            type(v) in kinds or (type(v) is int and float in kinds) for v in value
        ):
            return tuple(value)
        raise UnderstudyError(f"{where} must be a list like {list(old)}, got {value!r}")
    if isinstance(old, float) and type(value) is int:
        return float(value)
    if old is not None and type(value) is not type(old):
        raise UnderstudyError(f"{where} must be {type(old).__name__}, got {value!r}")
    return value


def differences(a: TrainConfig, b: TrainConfig) -> dict[str, tuple[Any, Any]]:
    """Where two configurations differ, apart from `FREE`: `data.bodies` -> both values."""
    one, two = _flat(asdict(a)), _flat(asdict(b))
    names = [n for n in {**one, **two} if one.get(n) != two.get(n) and n not in FREE]
    return {n: (one.get(n), two.get(n)) for n in names}


def _flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in data.items():
        out |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return out
