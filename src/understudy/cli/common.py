"""What the commands share."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from understudy.errors import MissingExtraError, UnderstudyError

if TYPE_CHECKING:
    from understudy.recordings.base import Recording

_PAIR = "a single colour/depth pair, instead of RECORDING"


def command(commands: argparse._SubParsersAction, name: str, help: str, examples: str) -> argparse.ArgumentParser:
    """A new command; `help` becomes its description, too."""
    return commands.add_parser(
        name,
        help=help,
        description=help[0].upper() + help[1:] + ".",
        epilog="examples:\n" + examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_recording(parser: argparse.ArgumentParser) -> None:
    """The arguments that name a recording or a pair of images."""
    parser.add_argument(
        "recording",
        nargs="?",
        metavar="RECORDING",
        help="recording folder, TUM RGB-D folder or Azure Kinect .mkv; 'sample' is the bundled one",
    )
    pair = parser.add_argument_group(_PAIR)
    pair.add_argument("--color", metavar="FILE", type=Path, help="8-bit colour image")
    pair.add_argument("--depth", metavar="FILE", type=Path, help="16-bit depth image in the colour image's pixels")
    pair.add_argument("--intrinsics", nargs=4, type=float, metavar=("FX", "FY", "CX", "CY"), help="of the colour image")
    pair.add_argument("--unit", type=float, metavar="M", help="metres per depth value (default 0.001)")


def open_recording(arguments: argparse.Namespace) -> Recording:
    """The recording that the arguments name."""
    from understudy import recordings

    pair = {"--color": arguments.color, "--depth": arguments.depth, "--intrinsics": arguments.intrinsics}
    given = [name for name, value in {**pair, "--unit": arguments.unit}.items() if value is not None]
    if arguments.recording is not None:
        if given:
            raise UnderstudyError(f"{given[0]} goes with a pair of images: give either RECORDING or {', '.join(pair)}")
        return recordings.open(arguments.recording)
    given = [name for name in given if name in pair]
    if len(given) < len(pair):
        missing = [name for name in pair if name not in given]
        raise UnderstudyError(f"give RECORDING, or {_PAIR.split(',')[0]} ({', '.join(missing)} missing)")
    return recordings.open_pair(
        arguments.color,
        arguments.depth,
        arguments.intrinsics,
        unit_m=0.001 if arguments.unit is None else arguments.unit,
    )


@contextmanager
def needs_extra(feature: str, extra: str) -> Iterator[None]:
    """Around imports: a package that is not installed becomes a MissingExtraError. Our own modules are not missing."""
    try:
        yield
    except MissingExtraError:
        raise
    except ImportError as e:
        if (e.name or "").partition(".")[0] == "understudy":
            raise
        raise MissingExtraError(feature, extra) from e
