"""The paper's tables and figures: every method on held-out simulated recordings, and on any others with truth.

    python benchmarks/paper_tables.py --out docs/comparison --weights RUN --mlp MLP.safetensors \\
        --paper-fast RUN --runs "anny=RUN capsules=RUN both=RUN" --held-out "realsense=RUN" --recordings DIR...

What is absent is left out, and the page says so. All that was computed stays in the cache: started again, it goes on
where it stopped. The MLP is trained by `python -m understudy.voxelposenet.mlp`; --fit-offsets fits the offsets of
naive lifting.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from understudy import recordings
from understudy.assets import cache_dir
from understudy.benchmark import held_out
from understudy.benchmark.comparison import RUN, Group, lift_group
from understudy.benchmark.comparison_report import Trainings, held_out_name, write_report
from understudy.benchmark.methods import Method, Weights, available, of_network
from understudy.errors import UnderstudyError
from understudy.plots import require_matplotlib


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = parse(arguments)
    if chosen.fit_offsets:
        fit_offsets(chosen.cache, chosen.frames)
        return
    require_matplotlib()
    weights = Weights(chosen.weights, chosen.mlp, chosen.paper, chosen.paper_fast)
    methods, notes = available(weights)
    more, trainings = other_trainings(pairs(chosen.runs), pairs(chosen.held_out))
    methods |= more
    groups: list[Group] = []
    if chosen.simulated:
        try:
            made = held_out.recordings(chosen.cache, chosen.frames, progress=say)
        except ImportError as e:
            notes.append(f"held-out simulation: left out. {e}")
        else:
            groups.append(group("Held-out simulation", "held-out", made, methods, chosen.cache))
    if chosen.recordings:
        groups.append(group(chosen.title, "further", chosen.recordings, methods, chosen.cache))
    if not groups:
        raise UnderstudyError("no recordings to compare methods on: give --recordings")
    trained = {method.name: method.trained for method in methods.values() if method.trained}
    write_report(chosen.out, groups, trainings, notes, trained)
    say(f"wrote {chosen.out / 'README.md'}")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/comparison"))
    parser.add_argument("--weights", type=Path, help="of the default network: .onnx, .safetensors or a run's folder")
    parser.add_argument("--mlp", type=Path)
    parser.add_argument("--paper-fast", type=Path, help="a run, or imported weights")
    parser.add_argument("--paper", type=Path, help="the same of the larger variant")
    parser.add_argument("--runs", default="", help="runs by the body set that they were trained on: 'anny=RUN ...'")
    parser.add_argument("--held-out", default="", help="runs by the sensor that they were not shown: 'realsense=RUN'")
    parser.add_argument("--recordings", type=Path, nargs="+", default=[], help="with truth.json and keypoints2d.json")
    parser.add_argument("--title", default="Further recordings", help="heading of these recordings")
    parser.add_argument("--frames", type=int, default=20, help="of each of the 6 simulated recordings")
    parser.add_argument("--no-simulated", dest="simulated", action="store_false")
    parser.add_argument("--cache", type=Path, default=cache_dir() / "comparison")
    parser.add_argument("--fit-offsets", action="store_true", help="only print the offsets for naive-offset")
    return parser.parse_args(arguments)


def pairs(text: str) -> dict[str, Path]:
    """'a=PATH b=PATH' -> paths by name."""
    out = {}
    for word in text.split():
        name, equals, path = word.partition("=")
        if not (name and equals and path):
            raise UnderstudyError(f"{word!r}: must be NAME=RUN")
        out[name] = Path(path)
    return out


def other_trainings(bodies: dict[str, Path], sensors: dict[str, Path]) -> tuple[dict[str, Method], Trainings]:
    """Methods of the runs that are there, and notes on the others."""
    methods: dict[str, Method] = {}
    notes = [f"trained on {b}: left out. No run was given (--runs '{b}=RUN')" for b in DEFAULT_RUNS if b not in bodies]
    if not sensors:
        notes.append("a sensor kept out of training: left out. No run was given (--held-out 'realsense=RUN')")
    found: dict[str, list[str]] = {"bodies": [], "without": []}
    seen: dict[str, int] = {}
    for kind, runs in (("bodies", bodies), ("without", sensors)):
        for name, path in runs.items():
            title = RUN + name if kind == "bodies" else held_out_name(name)
            try:
                methods[title] = of_network(title, path)
            except (UnderstudyError, ImportError) as e:
                notes.append(f"{title}: left out. {e}")
            else:
                found[kind].append(name)
                if (path / "config.json").is_file():
                    about = json.loads((path / "config.json").read_text())
                    run = about["config"]
                    seen[name] = run["steps"] * run["batch"] * about.get("processes", 1)
    return methods, Trainings(tuple(found["bodies"]), tuple(found["without"]), tuple(notes), seen)


DEFAULT_RUNS = ("anny", "capsules", "both")


def group(title: str, slug: str, folders: Sequence[Path], methods: dict[str, Method], cache: Path) -> Group:
    opened = [recordings.open(folder) for folder in folders]
    return lift_group(title, slug, opened, methods, cache / "lifted", say)


def fit_offsets(cache: Path, frames: int) -> None:
    """Prints the table for `understudy.baselines.OFFSETS_M`."""
    from understudy.baselines import fit_offsets_on

    made = held_out.recordings(cache, frames, fit=True, progress=say)
    print(json.dumps(fit_offsets_on(recordings.open(folder) for folder in made), indent=1))


def say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    main()
