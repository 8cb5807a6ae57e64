"""`understudy info`: what is in a recording."""

from __future__ import annotations

import argparse
import sys

from understudy.cli.common import add_recording, command, open_recording


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands, "info", "say what is in a recording", "  understudy info sample\n  understudy info recording.mkv"
    )
    add_recording(parser)
    parser.add_argument("--check", action="store_true", help="also read every frame and report the broken ones")
    parser.set_defaults(run=_info)


def _info(arguments: argparse.Namespace) -> int:
    from understudy.inspection import check, describe

    with open_recording(arguments) as recording:
        print(describe(recording))
        if not arguments.check:
            return 0
        broken = check(recording, progress=True)
        for index, error in broken:
            print(f"frame {index}: {error}", file=sys.stderr)
        print(f"{len(recording) - len(broken)} of {len(recording)} frames can be read")
        return 1 if broken else 0
