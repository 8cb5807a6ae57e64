"""`understudy stage`: recordings of people who open furniture, with exact truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.cli.common import command, needs_extra
from understudy.demonstration.tasks import TASKS

_ALL = "all"


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = commands.add_parser(
        "stage",
        help="record people who open doors and drawers on a simulated stage",
        description="Record people who open doors and drawers on a simulated stage, with exact truth.",
    )
    parser.set_defaults(after_interrupt="")
    inner = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_record(inner)


def _add_record(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "record",
        "record demonstrations of a task",
        "  understudy stage record --task drawer --demos 5 --out recordings\n"
        "  understudy stage record --task all --demos 5 --markers --out recordings\n"
        "\nEach demonstration has its own person, furniture, room and camera. The same arguments make the same\n"
        "recordings; those that are there already are kept.",
    )
    parser.add_argument(
        "--task", required=True, choices=(*TASKS, _ALL), metavar="TASK", help=f"{', '.join(TASKS)} or all"
    )
    parser.add_argument("--demos", type=int, default=5, metavar="N", help="demonstrations of each task (default 5)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="recordings become DIR/TASK_00, ...")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything that is random (default 0)")
    parser.add_argument("--markers", action="store_true", help="AprilTags on the furniture, the hands and the torso")
    parser.add_argument("--sensor", default="kinect2", metavar="NAME", help="kinect2 (default), azure or realsense")
    parser.add_argument("--fps", type=float, default=10.0, metavar="HZ", help="frames per second (default 10)")
    parser.set_defaults(run=_record, after_interrupt="; the same command goes on where it stopped")


def _record(arguments: argparse.Namespace) -> None:
    with needs_extra("the stage", "stage"):
        import mujoco  # noqa: F401
    from understudy.stage.record import record

    for task in TASKS if arguments.task == _ALL else (arguments.task,):
        folders = record(
            arguments.out,
            task,
            arguments.demos,
            arguments.seed,
            arguments.fps,
            arguments.sensor,
            arguments.markers,
        )
        print("".join(f"  {folder}\n" for folder in folders), end="")
    print(f"Look at one: understudy estimate {folders[0]} --out result")
