"""The command line. Each command is a thin face of Python functions; heavy parts are imported late."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from understudy import __version__
from understudy.errors import MissingExtraError, UnderstudyError

if TYPE_CHECKING:
    from understudy.recordings.base import Recording

_PAIR = "a single colour/depth pair, instead of RECORDING"


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
    for add in (_add_estimate, _add_view, _add_info, _add_models, _add_benchmark):
        add(commands)
    return parser


def _command(commands: argparse._SubParsersAction, name: str, help: str, examples: str) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=help,
        description=help[0].upper() + help[1:] + ".",
        epilog="examples:\n" + examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _add_recording(parser: argparse.ArgumentParser) -> None:
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


def _open(arguments: argparse.Namespace) -> Recording:
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


# --- estimate ---


def _add_estimate(commands: argparse._SubParsersAction) -> None:
    parser = _command(
        commands,
        "estimate",
        "estimate every person's joints in a recording, and draw them",
        "  understudy estimate sample --out result\n"
        "  understudy estimate RECORDING --out result --detector recording\n"
        "  understudy estimate RECORDING --out result --detector openpose-json:keypoints/\n"
        "  understudy estimate --color c.png --depth d.png --intrinsics 1081 1081 959.5 539.5 --out result\n"
        "\nInterrupted runs go on where they stopped. The folder's contents: people.json, overlays/, config.json.",
    )
    _add_recording(parser)
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the results")
    parser.add_argument("--method", default="naive", help="method of lifting: naive (default)")
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
    parser.add_argument("--no-overlays", action="store_true", help="do not draw a picture per frame")
    parser.add_argument("--restart", action="store_true", help="begin anew instead of going on")
    parser.set_defaults(run=_estimate, after_interrupt="; the same command goes on where it stopped")


def _estimate(arguments: argparse.Namespace) -> int:
    from understudy.pipeline import OVERLAYS, PEOPLE, estimate_recording

    result = estimate_recording(
        _open(arguments),
        arguments.out,
        method=arguments.method,
        detector=arguments.detector,
        min_score=arguments.min_score,
        overlays=not arguments.no_overlays,
        restart=arguments.restart,
        progress=True,
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


# --- view ---


def _add_view(commands: argparse._SubParsersAction) -> None:
    parser = _command(
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


# --- info ---


def _add_info(commands: argparse._SubParsersAction) -> None:
    parser = _command(
        commands, "info", "say what is in a recording", "  understudy info sample\n  understudy info recording.mkv"
    )
    _add_recording(parser)
    parser.add_argument("--check", action="store_true", help="also read every frame and report the broken ones")
    parser.set_defaults(run=_info)


def _info(arguments: argparse.Namespace) -> int:
    from understudy.inspection import check, describe

    with _open(arguments) as recording:
        print(describe(recording))
        if not arguments.check:
            return 0
        broken = check(recording, progress=True)
        for index, error in broken:
            print(f"frame {index}: {error}", file=sys.stderr)
        print(f"{len(recording) - len(broken)} of {len(recording)} frames can be read")
        return 1 if broken else 0


# --- models ---


def _add_models(commands: argparse._SubParsersAction) -> None:
    parser = _command(
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


# --- benchmark ---


def _add_benchmark(commands: argparse._SubParsersAction) -> None:
    parser = _command(
        commands,
        "benchmark",
        "compare methods on recordings with truth: table and plots",
        "  understudy benchmark sample --out bench\n"
        "  understudy benchmark REC1 REC2 --methods naive --detector recording --out bench",
    )
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="with truth.json; 'sample' is the bundled one"
    )
    parser.add_argument("--methods", nargs="+", default=["naive"], metavar="METHOD", help="default: naive")
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


if __name__ == "__main__":
    sys.exit(main())
