"""`understudy benchmark`: methods compared on recordings with truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from understudy.cli.common import command
from understudy.errors import UnderstudyError


def add(commands: argparse._SubParsersAction) -> None:
    """Adds the command to the parser."""
    parser = command(
        commands,
        "benchmark",
        "compare methods on recordings with truth: table and plots",
        "  understudy benchmark sample --out bench\n"
        "  understudy benchmark REC1 REC2 --methods naive --detector recording --out bench",
    )
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="with truth.json; 'sample' is the bundled one"
    )
    parser.add_argument(
        "--methods", nargs="+", default=["voxelposenet", "naive"], metavar="METHOD", help="default: both"
    )
    parser.add_argument("--detector", default="blazepose", metavar="NAME", help="as in `understudy estimate`")
    parser.add_argument("--out", type=Path, default=Path("benchmark"), metavar="DIR", help="default: benchmark")
    parser.add_argument("--resume", action="store_true", help="keep what an earlier run has estimated")
    parser.add_argument("--no-plots", action="store_true", help="tables only")
    parser.set_defaults(run=_benchmark, after_interrupt="; with --resume the same command goes on where it stopped")


def _benchmark(arguments: argparse.Namespace) -> None:
    from understudy import recordings
    from understudy.benchmark import PLOTS, TABLES, benchmark
    from understudy.benchmark.estimates import estimate_into
    from understudy.estimator import METHODS

    for method in arguments.methods:
        if method not in METHODS:
            raise UnderstudyError(f"method {method!r}: must be one of {', '.join(METHODS)}")
    result = benchmark(
        [recordings.open(path) for path in arguments.recordings],
        arguments.methods,
        arguments.out,
        estimate_into(arguments.out, arguments.detector, resume=arguments.resume, progress=True),
        plots=not arguments.no_plots,
        progress=lambda message: print(message, file=sys.stderr),
    )
    print(result.table())
    for name in (*TABLES, *(() if arguments.no_plots else PLOTS)):
        print(f"  {arguments.out / name}")
