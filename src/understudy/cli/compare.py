"""`understudy compare`: one frame by several methods, in one picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.cli.common import command
from understudy.errors import UnderstudyError, one_of


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "compare",
        "draw one frame's people by several methods, seen from the side",
        "  understudy compare sample --out compare.png\n"
        "  understudy compare RECORDING --frame 12 --methods voxelposenet naive --out compare.png",
    )
    parser.add_argument("recording", metavar="RECORDING", help="recording folder or file; 'sample' is the bundled one")
    parser.add_argument("--out", required=True, type=Path, metavar="PNG", help="picture to write")
    parser.add_argument("--frame", type=int, metavar="N", help="index (default: where most joints are hidden)")
    parser.add_argument(
        "--methods", nargs="+", default=["voxelposenet", "naive"], metavar="METHOD", help="default: both"
    )
    parser.add_argument("--detector", default="blazepose", metavar="NAME", help="as for estimate (default blazepose)")
    parser.set_defaults(run=_compare)


def _compare(arguments: argparse.Namespace) -> None:
    import cv2

    from understudy import detectors, methods, recordings
    from understudy.files import write_atomically
    from understudy.registration import register
    from understudy.side_view import draw_methods

    recording = recordings.open(arguments.recording)
    frames = recording.truth.frames if recording.truth is not None else {}
    index = arguments.frame
    if index is None:
        hidden = {i: sum(int((p.occluded & p.in_view).sum()) for p in frames.get(i, ())) for i in recording.indices}
        index = max(hidden, key=lambda i: hidden[i])
    if index not in recording.indices:
        known = recording.indices
        raise UnderstudyError(f"--frame {index}: {recording.path} has frames {known[0]} to {known[-1]}")
    if arguments.out.suffix.lower() != ".png":
        raise UnderstudyError(f"--out {arguments.out}: the name must end in {one_of(['.png'])}")
    registered = register(recording.frame(index))
    seen = detectors.create(arguments.detector, recording).detect(registered.color, registered.depth, index)
    people = {
        name: [p.with_id(i) for i, p in enumerate(methods.create(name).lift(registered, seen))]
        for name in arguments.methods
    }
    picture = draw_methods(registered, people, frames.get(index, ()))
    ok, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    assert ok
    write_atomically(arguments.out, data.tobytes())
    print(f"frame {index}: {arguments.out}")
