"""`understudy adapt`: demonstrations of one task -> gripper and base trajectories of a robot."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.cli.common import command, needs_extra
from understudy.errors import UnderstudyError


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "adapt",
        "bend demonstrations into what a robot can do",
        "  understudy adapt demo1 demo2 demo3 --robot pr2 --out adapted\n"
        "\nAll demonstrations must be of one task; one is enough. The metrics before and after are printed and kept.",
    )
    parser.add_argument("demonstrations", nargs="+", type=Path, metavar="DEMO", help="from `understudy demonstrate`")
    parser.add_argument(
        "--robot", default="pr2", metavar="NAME", help="a robot's name (default pr2) or description.json"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the result")
    parser.add_argument("--default-calibration", action="store_true", help="do not estimate hand-gripper, torso-base")
    parser.add_argument("--no-plots", action="store_true", help="no pictures")
    parser.add_argument("--overwrite", action="store_true", help="replace a result that is there")
    parser.set_defaults(run=_adapt)


def _adapt(arguments: argparse.Namespace) -> int:
    if arguments.out.exists() and any(arguments.out.iterdir()) and not arguments.overwrite:
        raise UnderstudyError(f"{arguments.out}: is there already and not empty: give another folder or --overwrite")
    from understudy.adaptation import adapt, metrics, storage
    from understudy.adaptation.calibration import Calibration
    from understudy.demonstration.storage import load
    from understudy.files import write_atomically

    with needs_extra("robots", "robot"):
        from understudy.adaptation.robots import platform_of
        from understudy.robot.model import load_robot
    demonstrations = [load(path) for path in arguments.demonstrations]
    platform = platform_of(load_robot(arguments.robot))
    config = adapt.AdaptConfig(calibration=Calibration.default() if arguments.default_calibration else None)
    result = adapt.adapt(demonstrations, platform, config=config)
    measured = metrics.evaluate(demonstrations, result, platform)
    storage.save(arguments.out, result, measured)
    print(metrics.table({result.task: measured}))
    for note in result.report.notes:
        print(f"note: {note}")
    if not arguments.no_plots:
        from understudy.adaptation import plots

        for name, content in plots.pictures(demonstrations, result, platform, measured).items():
            write_atomically(arguments.out / name, content)
    print(f"  {arguments.out}")
    return 0
