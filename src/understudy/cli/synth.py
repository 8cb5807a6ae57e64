"""`understudy synth`: simulated recordings with exact truth, and a look at the simulator."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.cli.common import command, needs_extra
from understudy.errors import UnderstudyError


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "synth",
        "simulate recordings of people, with exact truth",
        "  understudy synth OUT --frames 40 --sensor kinect2\n"
        "  understudy synth OUT --sequence --activity walking --people 2 --sensor azure\n"
        "  understudy synth OUT --sequence --bvh mocap/ --registered\n"
        "  understudy synth --preview inputs.png\n"
        "  understudy synth --speed\n"
        "\nThe same arguments make the same recording. Bodies of kind capsules need no body model.",
    )
    parser.add_argument("out", nargs="?", type=Path, metavar="OUT", help="folder for the recording")
    parser.add_argument("--frames", type=int, default=40, metavar="N", help="default 40")
    parser.add_argument("--sensor", default="kinect2", metavar="NAME", help="kinect2 (default), azure or realsense")
    parser.add_argument("--bodies", default="anny", metavar="KIND", help="anny (default) or capsules")
    parser.add_argument("--body-count", type=int, default=60, metavar="N", help="different bodies (default 60)")
    parser.add_argument("--body-seed", type=int, default=1001, metavar="N", help="which bodies (default 1001)")
    parser.add_argument("--people", type=int, metavar="N", help="people in each frame (default: 1 to 3)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything else (default 0)")
    parser.add_argument(
        "--sequence", action="store_true", help="people move before one camera; otherwise every frame is a new scene"
    )
    parser.add_argument("--fps", type=float, default=10.0, metavar="HZ", help="of a sequence (default 10)")
    parser.add_argument("--activity", metavar="NAME", help="what everybody does, e.g. sitting (default: anything)")
    parser.add_argument("--bvh", type=Path, metavar="FOLDER", help="motion capture to take movements from")
    parser.add_argument("--registered", action="store_true", help="depth in the colour image's pixels")
    parser.add_argument("--overwrite", action="store_true", help="replace a recording that is there")
    look = parser.add_argument_group("instead of a recording")
    look.add_argument("--preview", type=Path, metavar="FILE", help="draw some inputs of the network into a picture")
    look.add_argument("--speed", action="store_true", help="say how fast this machine simulates inputs of the network")
    parser.set_defaults(run=_synth, after_interrupt="; the same command begins anew")


def _synth(arguments: argparse.Namespace) -> None:
    chosen = [name for name in ("out", "preview", "speed") if getattr(arguments, name)]
    if len(chosen) != 1:
        raise UnderstudyError("give one of OUT, --preview FILE and --speed")
    with needs_extra("simulated people", "train"):
        import torch

        from understudy.synthetic import preview, recording, timing
    config = recording.RecordingConfig(
        sensor=arguments.sensor,
        bodies=arguments.bodies,
        body_count=arguments.body_count,
        body_seed=arguments.body_seed,
        people=arguments.people,
        sequence=arguments.sequence,
        fps=arguments.fps,
        activity=arguments.activity,
        bvh=None if arguments.bvh is None else str(arguments.bvh),
        registered=arguments.registered,
    )
    if arguments.out:
        recording.write_synthetic(
            arguments.out, arguments.frames, arguments.seed, config, overwrite=arguments.overwrite, progress=True
        )
        print(f"  {arguments.out}\nLook at it: understudy estimate {arguments.out} --detector recording --out result")
        return
    samples = preview.samples_of(config, arguments.seed)
    if arguments.preview:
        preview.write_preview(arguments.preview, samples)
        print(f"  {arguments.preview}")
    else:
        print(f"{torch.get_num_threads()} threads\n{timing.measure(samples).table()}")
