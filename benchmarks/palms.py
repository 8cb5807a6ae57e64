"""How well palm normals are estimated: tables and plots, on recordings with true palms and on simulated hands.

    python benchmarks/palms.py --out docs/palms [--recordings DIR ...] [--hands N]

Without --recordings, the bundled one. --hands 0 leaves out the simulated hands, which need the extra `train`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from understudy import recordings
from understudy.benchmark.palm_recordings import estimators, from_recordings, recording_methods, with_palms
from understudy.benchmark.palm_report import main_table, write_report
from understudy.benchmark.palm_simulation import from_simulation, simulate
from understudy.benchmark.palms import Source
from understudy.errors import UnderstudyError
from understudy.hands.nets import load_nets
from understudy.hands.predictor import HandPredictor
from understudy.plots import require_matplotlib


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = parse(arguments)
    require_matplotlib()
    if chosen.hands < 0:
        raise UnderstudyError(f"--hands {chosen.hands}: must be 0 (no simulated hands) or more")
    opened = with_palms([recordings.open(name) for name in chosen.recordings])  # fail now, not after the first one
    people_of, methods = estimators(chosen.detector), recording_methods(load_nets())
    simulated = simulate(chosen.hands) if chosen.hands else None
    sources: list[Source] = [from_recordings(opened, methods, people_of, chosen.detector)]
    if simulated is not None:
        sources.append(from_simulation(simulated, HandPredictor().network))
    write_report(chosen.out, sources)
    for source in sources:
        print(f"{source.title}\n\n{main_table(source)}\n")
    print(f"wrote {chosen.out / 'README.md'}")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/palms"))
    parser.add_argument("--recordings", nargs="+", default=["sample"], help="with true palms")
    parser.add_argument("--hands", type=int, default=3072, help="simulated hands; 0: none")
    parser.add_argument("--detector", default="blazepose", help="`recording`: its own keypoints2d.json")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    try:
        main()
    except (UnderstudyError, ImportError) as e:
        sys.exit(f"palms.py: {e}")
