"""`understudy train`: a network, from simulated people."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from understudy.cli import train_hands
from understudy.cli.common import command, needs_extra
from understudy.errors import UnderstudyError, one_of

if TYPE_CHECKING:
    from understudy.voxelposenet.training import TrainConfig

_FLAGS = ("steps", "batch", "device", "seed", "workers")
"""Arguments that are fields of the configuration"""


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "train",
        "train a network on simulated people",
        "  understudy train runs/first\n"
        "  understudy train runs/smoke --preset smoke\n"
        "  understudy train runs/hands --preset hands\n"
        "  understudy train runs/no-kinect --without-sensor kinect2 --steps 5000\n"
        "  torchrun --nproc_per_node 2 -m understudy train runs/two\n"
        "\nThe same command goes on with an interrupted run; so does `understudy train OUT` alone. The folder's\n"
        "contents: config.json, log.csv, validation*.csv, *.png, checkpoint.safetensors, weights.safetensors.\n"
        "`understudy weights export OUT --out DIR` makes the files for use.",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the run")
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help="default (default), smoke (seconds), paper (as published); hands: the network of palm normals",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="JSON with fields that replace the preset's")
    parser.add_argument("--steps", type=int, metavar="N", help="how long to train")
    parser.add_argument("--batch", type=int, metavar="N", help="people per step and process")
    parser.add_argument("--bodies", metavar="SET", help="anny, capsules or both")
    parser.add_argument(
        "--without-sensor", action="append", metavar="NAME",
        help="leave a depth camera out of training (validation keeps it); may be repeated",
    )  # fmt: skip
    parser.add_argument("--bvh", type=Path, metavar="FOLDER", help="motion capture to draw poses from")
    parser.add_argument("--init", type=Path, metavar="FILE", help="weights to begin with, in place of random ones")
    parser.add_argument("--device", metavar="NAME", help="cpu or cuda")
    parser.add_argument("--seed", type=int, metavar="N", help="of weights and data")
    parser.add_argument("--workers", type=int, metavar="N", help="processes that simulate; 0: the training one itself")
    parser.set_defaults(run=_train, after_interrupt="; saved; the same command goes on where it stopped")


def _train(arguments: argparse.Namespace) -> None:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads leave the cores to the simulation
    if train_hands.wanted(arguments):
        train_hands.train(arguments)
        return
    with needs_extra("training", "train"):
        from understudy.voxelposenet.training import Trainer
    trainer = Trainer(_config(arguments), arguments.out)
    if trainer.world.rank:
        trainer.run()
    else:
        _run(trainer, arguments.out)
    trainer.close()


def _run(trainer: Any, out: Path) -> None:
    """Trains with a bar, and a line per validation."""
    from tqdm import tqdm

    config = trainer.config
    if trainer.step:
        print(f"going on after step {trainer.step} of {config.steps}", file=sys.stderr)
    with tqdm(total=config.steps, initial=trainer.step, unit="step", dynamic_ncols=True) as bar:

        def report(row: dict[str, Any]) -> None:
            if "loss" in row:
                bar.set_postfix_str(f"loss {row['loss']:.4g}, error {100 * row['error']:.1f} cm")
            else:
                bar.write(_validation(row), file=sys.stdout)

        trainer.run(report, lambda step: bar.update())
    print(f"  {out / 'weights.safetensors'}\nNext: understudy weights export {out} --out DIR")


def _validation(row: dict[str, Any]) -> str:
    return (
        f"step {row['step']}, {row['hours']:.2f} h: error {row['all']:.1f} cm (visible {row['visible']:.1f}, occluded "
        f"{row['occluded']:.1f}, hard {row['hard']:.1f}), AUC {row['auc20']:.3f}, inside sigma "
        f"{row['inside_sigma']:.2f}, calibration error {row['calibration']:.3f}, sides exchanged {row['swapped']:.3f}"
    )


def _config(arguments: argparse.Namespace) -> TrainConfig:
    """The preset or the folder's own configuration, then the file's fields, then the other arguments."""
    from dataclasses import replace

    from understudy.voxelposenet.training import CONFIG, PRESETS, read_config

    if arguments.preset is not None and arguments.preset not in PRESETS:
        raise UnderstudyError(f"preset {arguments.preset!r}: must be {one_of(PRESETS)}")
    own = arguments.out / CONFIG
    if arguments.preset is None and arguments.config is None and own.exists():
        config = read_config(own)
    else:
        config = PRESETS[arguments.preset or "default"]
    if arguments.config is not None:
        config = read_config(arguments.config, config)
    given = {name: getattr(arguments, name) for name in _FLAGS if getattr(arguments, name) is not None}
    data = {"bodies": arguments.bodies, "bvh": str(arguments.bvh) if arguments.bvh else None}
    changed = replace(config.data, **{k: v for k, v in data.items() if v is not None})
    for name in arguments.without_sensor or ():
        left = tuple(s for s in changed.samples.sensors if s != name)
        if left == changed.samples.sensors:
            raise UnderstudyError(f"--without-sensor {name!r}: must be {one_of(changed.samples.sensors)}")
        changed = replace(changed, samples=replace(changed.samples, sensors=left))
    if arguments.init is not None:
        given["init"] = str(arguments.init)
    return replace(config, data=changed, **given)
