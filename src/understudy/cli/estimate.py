"""`understudy estimate`: a recording in, people and pictures out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from understudy.cli.common import add_recording, command, open_recording


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "estimate",
        "estimate every person's joints in a recording, and draw them",
        "  understudy estimate sample --out result\n"
        "  understudy estimate RECORDING --out result --detector recording\n"
        "  understudy estimate RECORDING --out result --detector openpose-json:keypoints/\n"
        "  understudy estimate --color c.png --depth d.png --intrinsics 1081 1081 959.5 539.5 --out result\n"
        "\nInterrupted runs go on where they stopped. The folder's contents: people.json, overlays/, config.json.",
    )
    add_recording(parser)
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the results")
    parser.add_argument("--method", default="voxelposenet", help="method of lifting: voxelposenet (default) or naive")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="an exported network (.onnx) of your own")
    parser.add_argument(
        "--detector",
        default="blazepose",
        metavar="NAME",
        help="2D keypoints: blazepose (default), recording (its keypoints2d.json) or "
        "openpose-json:FOLDER[:LAYOUT] (layouts: body_25, body_25b, coco_18, coco_17)",
    )
    parser.add_argument(
        "--min-score", type=float, default=0.2, metavar="S", help="2D keypoints below are not lifted (default 0.2)"
    )
    parser.add_argument(
        "--hands",
        default="full",
        metavar="HOW",
        help="palm normals from colour and depth (full, default), depth, or off",
    )
    parser.add_argument("--no-overlays", action="store_true", help="do not draw a picture per frame")
    parser.add_argument("--restart", action="store_true", help="begin anew instead of going on")
    parser.set_defaults(run=_estimate, after_interrupt="; the same command goes on where it stopped")


def _estimate(arguments: argparse.Namespace) -> int:
    from understudy.pipeline import OVERLAYS, PEOPLE, estimate_recording
    from understudy.runtime import processors

    result = estimate_recording(
        open_recording(arguments),
        arguments.out,
        method=arguments.method,
        detector=arguments.detector,
        min_score=arguments.min_score,
        weights=arguments.weights,
        hands=arguments.hands,
        overlays=not arguments.no_overlays,
        restart=arguments.restart,
        progress=True,
        threads=min(2, processors()),
    )
    skipped = [f for f in result.frames if f.skipped is not None]
    for frame in skipped:
        print(f"understudy: frame {frame.index} skipped: {frame.skipped}", file=sys.stderr)
    people = [p for f in result.frames for p in f.people]
    failed = sum(p.failed is not None for p in people)
    print(
        f"{len(result.frames)} frames ({len(skipped)} skipped), {len(people)} people"
        + (f", {failed} of them could not be lifted" if failed else "")
    )
    print(f"  {arguments.out / PEOPLE}")
    pictures = sorted((arguments.out / OVERLAYS).glob("*.png"))
    if pictures:
        print(f"  {pictures[0]}" + (f" ... {pictures[-1].name}" if len(pictures) > 1 else ""))
    print(f"Look at it in 3D: understudy view {arguments.out}")
    return 1 if len(skipped) == len(result.frames) else 0
