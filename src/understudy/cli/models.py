"""`understudy models`: the model files."""

from __future__ import annotations

import argparse
from pathlib import Path

from understudy.cli.common import command
from understudy.errors import UnderstudyError


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "models",
        "list the model files, or fetch them before they are needed",
        "  understudy models\n  understudy models fetch\n  understudy models fetch --wheel mediapipe-0.10.21-...whl",
    )
    parser.add_argument("action", nargs="?", choices=("list", "fetch"), default="list")
    parser.add_argument("--wheel", type=Path, metavar="FILE", help="take them from a wheel that was brought by hand")
    parser.set_defaults(run=_models)


def _models(arguments: argparse.Namespace) -> int:
    from understudy import assets

    if arguments.action == "fetch":
        missing = [name for name in assets.MODELS if assets.state(name) != "ready"]
        if missing or arguments.wheel:
            assets.fetch(wheel=arguments.wheel, progress=assets.progress_bar())
    elif arguments.wheel:
        raise UnderstudyError("--wheel goes with `understudy models fetch`")
    print(f"cache: {assets.cache_dir()}")
    intact = True
    for name, model in assets.MODELS.items():
        state = assets.state(name)
        intact &= state != "damaged"
        print(f"  {name:20} {model.size / 1e6:5.1f} MB  {state:8}  {model.licence}, {model.purpose}")
    return 0 if intact else 2
