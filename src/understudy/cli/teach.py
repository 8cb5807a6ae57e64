"""`understudy teach`: recordings in, a skill that a robot has tried out, and a report."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from understudy.cli.common import command, needs_extra


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "teach",
        "teach a robot what recordings show",
        "  understudy teach sample-drawer --task drawer --robot pr2 --out drawer\n"
        "  understudy teach rec1 rec2 rec3 --task swivel_door --robot pr2 --out swivel_door --trials 5\n"
        "\nInterrupted runs go on where they stopped. DIR is the skill; look at DIR/report.html (docs/teaching.md).",
    )
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="recordings, as for estimate")
    parser.add_argument(
        "--task", required=True, help="what is shown: room_door, swivel_door, drawer, sliding_door, or a name"
    )
    parser.add_argument(
        "--robot", default="pr2", metavar="NAME", help="a robot's name (default pr2) or description.json"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the skill and the report")
    trials = parser.add_mutually_exclusive_group()
    trials.add_argument("--trials", type=int, default=1, metavar="N", help="in simulation (default 1)")
    trials.add_argument("--no-simulation", action="store_true", help="learn only")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the trials (default 0)")
    parser.add_argument(
        "--object", default="rgbd", metavar="HOW", help="follow the object by rgbd (default) or markers"
    )
    parser.add_argument(
        "--teacher", default="rgbd", metavar="HOW", help="follow hand and torso by rgbd (default) or markers"
    )
    parser.add_argument("--markers", metavar="JSON", help="which marker is on what: docs/objects.md")
    parser.add_argument("--fps", type=float, metavar="N", help="frames a second of recordings without timestamps")
    parser.add_argument("--detector", default="blazepose", metavar="NAME", help="as for estimate")
    parser.add_argument("--hands", default="full", metavar="HOW", help="as for estimate: full, depth or off")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="as for estimate")
    parser.set_defaults(run=_teach, after_interrupt="; the same command goes on where it stopped")


def _teach(arguments: argparse.Namespace) -> int:
    from understudy.demonstration.build import DemonstrationConfig

    with needs_extra("teaching a robot", "robot"):
        import pinocchio  # noqa: F401
        import sklearn  # noqa: F401

    from understudy.teaching import TeachConfig, teach

    if not arguments.no_simulation:
        with needs_extra("simulation", "robot"):
            import mujoco  # noqa: F401

    config = TeachConfig(
        DemonstrationConfig(arguments.task, arguments.object, arguments.teacher, arguments.markers, fps=arguments.fps),
        detector=arguments.detector,
        hands=arguments.hands,
        weights=arguments.weights,
        trials=0 if arguments.no_simulation else arguments.trials,
        seed=arguments.seed,
    )
    result = teach(arguments.recordings, arguments.out, task=arguments.task, robot=arguments.robot, config=config)
    for s in result.seen:
        if s.failed:
            print(f"understudy: {s.recording}: left out: {s.failed}", file=sys.stderr)
    for note in result.notes:
        print(f"note: {note}")
    done = sum(o.success for o in result.outcomes)
    for o in result.outcomes:
        print(f"trial {o.number}: {o.reason}: {o.detail}")
    print(f"learnt from {len(result.demonstrations)} of {len(result.seen)} recordings: {result.folder}")
    print(result.report)
    return 0 if done or not result.outcomes else 1
