"""`understudy train OUT --preset hands`: the network of palm normals, from simulated hands."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from understudy.cli.common import needs_extra
from understudy.errors import UnderstudyError
from understudy.files import read_json

if TYPE_CHECKING:
    from understudy.hands.training import HandTrainConfig, HandTrainer

PRESET = "hands"
_FLAGS = ("batch", "init", "seed", "workers")
_NOT_HERE = ("steps", "bodies", "without_sensor", "bvh", "device")


def wanted(arguments: argparse.Namespace) -> bool:
    """Whether the arguments mean this network: by the preset, or because the folder holds such a run."""
    if arguments.preset is not None:
        return bool(arguments.preset == PRESET)
    own = arguments.out / "config.json"
    return own.exists() and read_json(own).get("kind") == PRESET


def train(arguments: argparse.Namespace) -> None:
    """Simulates the hands that are missing, then trains; both with a bar."""
    from tqdm import tqdm

    with needs_extra("training", "train"):
        from understudy.hands.training import HandTrainer
    for name in _NOT_HERE:
        if getattr(arguments, name) is not None:
            raise UnderstudyError(f"--{name.replace('_', '-')}: not an option of --preset {PRESET}")
    trainer = HandTrainer(_config(arguments), arguments.out)
    for pool, what in zip(trainer.pools(), ("hands for training", "hands for validation"), strict=True):
        with tqdm(total=pool.shards, unit="shard", desc=what, dynamic_ncols=True) as bar:
            pool.fill(trainer.config.workers, lambda done, bar=bar: bar.update(done - bar.n))  # type: ignore[misc]
    _run(trainer, arguments.out)


def _run(trainer: HandTrainer, out: Path) -> None:
    from tqdm import tqdm

    if trainer.step:
        print(f"going on after step {trainer.step} of {trainer.steps}", file=sys.stderr)
    with tqdm(total=trainer.steps, initial=trainer.step, unit="step", dynamic_ncols=True) as bar:

        def report(row: dict[str, Any]) -> None:
            if "loss" in row:
                bar.set_postfix_str(f"loss {row['loss']:.3f}, error {row['degrees']:.1f} degrees")
            else:
                bar.write(
                    f"step {row['step']}, {row['hours']:.2f} h: error {row['all_mean']:.1f} degrees (median "
                    f"{row['all_median']:.1f}; visible {row['visible_mean']:.1f}, {row['visible_median']:.1f}; hidden "
                    f"{row['hidden_mean']:.1f}), turned round {row['visible_flips']:.3f} of the visible, calibration "
                    f"error {row['calibration']:.3f}",
                    file=sys.stdout,
                )

        trainer.run(report, lambda step: bar.update())
    print(f"  {out / 'weights.safetensors'}\nNext: understudy weights export {out} --out DIR")


def _config(arguments: argparse.Namespace) -> HandTrainConfig:
    """The folder's own configuration or the default one, then the file's fields, then the other arguments."""
    from dataclasses import replace

    from understudy.hands.training import CONFIG, HandTrainConfig
    from understudy.voxelposenet.train_config import filled

    config = HandTrainConfig()
    own = arguments.out / CONFIG
    if arguments.config is None and own.exists():
        config = filled(read_json(own)["config"], config, str(own))
    if arguments.config is not None:
        config = filled(read_json(arguments.config), config, str(arguments.config))
    given = {n: getattr(arguments, n) for n in _FLAGS if getattr(arguments, n) is not None}
    if "init" in given:
        given["init"] = str(given["init"])
    return replace(config, **given)
