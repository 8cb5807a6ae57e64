"""`understudy demonstrate`: recordings in, demonstrations out; `understudy demo show`: look at one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from understudy.cli.common import command

if TYPE_CHECKING:
    from understudy.demonstration.demonstration import Demonstration
    from understudy.demonstration.run import Result


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the commands to the parser."""
    parser = command(
        commands,
        "demonstrate",
        "turn recordings of a person who opens something into demonstrations",
        "  understudy demonstrate drawer_1 drawer_2 drawer_3 --task drawer --out demos\n"
        "  understudy demonstrate REC --task drawer --object markers --markers markers.json --out demos\n"
        "\nInterrupted runs go on where they stopped. DIR/NAME holds demonstration.json, .npz and .png: docs/demos.md.",
    )
    parser.add_argument("recordings", nargs="+", metavar="RECORDING", help="recordings, as for estimate")
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the demonstrations")
    parser.add_argument(
        "--task", default="unknown", help="what is shown: room_door, swivel_door, drawer, sliding_door, or a name"
    )
    parser.add_argument(
        "--object",
        default="rgbd",
        metavar="HOW",
        help="follow the object by depth and colour (rgbd, default) or markers",
    )
    parser.add_argument(
        "--teacher", default="rgbd", metavar="HOW", help="follow hand and torso by rgbd (default) or markers"
    )
    parser.add_argument("--markers", metavar="JSON", help="which marker is on what: docs/objects.md")
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="of the trajectories (default: the recording's, >= 10)"
    )
    parser.add_argument("--fps", type=float, metavar="N", help="frames a second of recordings without timestamps")
    parser.add_argument("--detector", default="blazepose", metavar="NAME", help="as for estimate")
    parser.add_argument("--hands", default="full", metavar="HOW", help="as for estimate: full, depth or off")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="as for estimate")
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="recordings at a time, each in a process (default: one a processor)"
    )
    parser.add_argument("--overlays", action="store_true", help="also a picture of every frame")
    parser.add_argument("--restart", action="store_true", help="begin anew instead of going on")
    parser.set_defaults(run=_demonstrate, after_interrupt="; the same command goes on where it stopped")

    demo = commands.add_parser("demo", help="look at demonstrations", description="Look at demonstrations.")
    actions = demo.add_subparsers(title="commands", metavar="COMMAND", required=True)
    show = command(
        actions,
        "show",
        "print what a demonstration holds, and draw it",
        "  understudy demo show demos/drawer_1 --out drawer_1.png",
    )
    show.add_argument("demonstrations", nargs="+", type=Path, metavar="DIR", help="folders of `understudy demonstrate`")
    show.add_argument("--out", type=Path, metavar="PNG", help="picture to write (default: beside the demonstration)")
    show.set_defaults(run=_show)


def _demonstrate(arguments: argparse.Namespace) -> int:
    from understudy.demonstration.build import DemonstrationConfig
    from understudy.demonstration.run import demonstrate

    config = DemonstrationConfig(
        arguments.task, arguments.object, arguments.teacher, arguments.markers, arguments.rate, arguments.fps
    )
    results = demonstrate(
        arguments.recordings,
        arguments.out,
        config,
        detector=arguments.detector,
        hands=arguments.hands,
        weights=arguments.weights,
        overlays=arguments.overlays,
        restart=arguments.restart,
        progress=True,
        report=_report,
        jobs=arguments.jobs,
    )
    made = sum(r.demonstration is not None for r in results)
    print(f"{made} of {len(results)} recordings became demonstrations: {arguments.out}")
    return 0 if made else 1


def _report(result: Result) -> None:
    from tqdm import tqdm  # writes above the bar

    if result.demonstration is None:
        tqdm.write(f"understudy: {result.recording}: no demonstration: {result.failed}", file=sys.stderr)
        return
    skipped = result.demonstration.source.get("frames_skipped", 0)
    if skipped:
        tqdm.write(f"understudy: {result.recording}: {skipped} frames could not be read", file=sys.stderr)
    tqdm.write(f"{result.folder.name}: {describe(result.demonstration)}", file=sys.stdout)


def describe(demo: Demonstration) -> str:
    """One line about a demonstration."""
    from math import degrees

    low, high = demo.articulation.range
    way = (
        f"{degrees(high - low):.0f} degrees" if demo.articulation.kind == "revolute" else f"{100 * (high - low):.0f} cm"
    )
    seconds = {
        name: (part.stop - part.start) * (demo.times_s[1] - demo.times_s[0])
        for name, part in demo.segments.slices(len(demo)).items()
    }
    spans = ", ".join(f"{name} {s:.1f} s" for name, s in seconds.items())
    return (
        f"{demo.task}, {demo.acting} hand (seen in {100 * demo.hand.observed.mean():.0f} % of {len(demo)} samples), "
        f"{demo.articulation.kind} object moved {way}; {spans}"
    )


def _show(arguments: argparse.Namespace) -> int:
    from understudy import recordings
    from understudy.demonstration import storage
    from understudy.demonstration.run import PICTURE, picture
    from understudy.errors import UnderstudyError
    from understudy.files import write_atomically

    if arguments.out is not None and len(arguments.demonstrations) > 1:
        raise UnderstudyError("--out goes with one demonstration; without it each picture lies beside its own")
    for folder in arguments.demonstrations:
        demo = storage.load(folder)
        print(f"{folder}: {describe(demo)}")
        try:
            recording = recordings.open(demo.source.get("recording", ""))
        except UnderstudyError:
            recording = None
            print("  (the recording is not where it was: drawn without its image)")
        out = arguments.out or folder / PICTURE
        write_atomically(out, picture(recording, demo))
        print(f"  {out}")
    return 0
