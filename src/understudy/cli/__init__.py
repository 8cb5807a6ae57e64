"""The command line. Each command is a thin face of Python functions; heavy parts are imported late."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence

from understudy import __version__
from understudy.cli import (
    adapt,
    benchmark,
    compare,
    demonstrate,
    estimate,
    info,
    models,
    stage,
    synth,
    teach,
    train,
    trials,
    view,
    weights,
)
from understudy.errors import MissingExtraError, UnderstudyError

_GROUPS = (
    estimate,
    view,
    info,
    models,
    compare,
    benchmark,
    demonstrate,
    adapt,
    teach,
    trials,
    stage,
    synth,
    train,
    weights,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command. Returns the exit status: 0 done, 1 nothing could be estimated, 2 wrong input, 130 interrupted."""
    arguments = _parser().parse_args(argv)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _note
            return int(arguments.run(arguments) or 0)
    except (UnderstudyError, MissingExtraError) as e:
        print(f"understudy: error: {e}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output has gone, as in `understudy info sample | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as e:
        print(f"understudy: error: {e.filename or ''}: {e.strerror or e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\nunderstudy: interrupted{arguments.after_interrupt}", file=sys.stderr)
        return 130


def _note(message: Warning | str, category: type[Warning], *where: object, **more: object) -> None:
    """Warnings are for the reader of the command's output, who does not know our source files."""
    print(f"understudy: note: {message}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="understudy",
        description="Metric 3D human pose from an RGB-D camera, on an ordinary CPU.",
        epilog="Start with: understudy estimate sample --out result && understudy view result",
    )
    parser.add_argument("--version", action="version", version=f"understudy {__version__}")
    parser.set_defaults(after_interrupt="")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for group in _GROUPS:
        group.add(commands)
    return parser
