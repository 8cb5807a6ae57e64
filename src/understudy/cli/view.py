"""`understudy view`: results in 3D."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.cli.common import command


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "view",
        "show results in 3D on a local web page",
        "  understudy view result\n  understudy view result --port 9000 --open\n"
        "  understudy view result --recording /moved/to/RECORDING",
    )
    parser.add_argument("results", metavar="DIR", type=Path, help="folder that `understudy estimate` wrote")
    parser.add_argument("--recording", type=Path, metavar="PATH", help="where the recording is, if it has moved")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this computer only)")
    parser.add_argument("--port", type=int, default=8080, help="default 8080, or the next free one")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.set_defaults(run=_view)


def _view(arguments: argparse.Namespace) -> None:
    from understudy.viewer import view

    view(
        arguments.results,
        arguments.recording,
        host=arguments.host,
        port=arguments.port,
        open_browser=arguments.open,
    )
