"""How near demonstrations are to what happened on the stage: recordings are estimated from end to end and scored.

    understudy stage record --task all --demos 5 --out RECORDINGS
    python benchmarks/demonstrations.py RECORDINGS/* --work WORK --out docs/demonstrations

Estimation goes on where it stopped (in WORK).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from common import machine

from understudy.benchmark.demonstrations import DEFINITIONS, DemonstrationErrors, from_stage, score, table
from understudy.demonstration.build import DemonstrationConfig
from understudy.demonstration.run import demonstrate
from understudy.errors import UnderstudyError
from understudy.files import write_atomically


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = parse(arguments)
    errors: list[DemonstrationErrors] = []
    failed: list[str] = []
    frames, begin = 0, time.perf_counter()
    for folder in chosen.recordings:
        truth = from_stage(folder)
        config = DemonstrationConfig(truth.task, chosen.object, chosen.teacher, chosen.markers)
        result = demonstrate([folder], chosen.work, config, hands=chosen.hands, progress=True)[0]
        frames += len(truth.times_s)
        if result.demonstration is None:
            failed.append(f"{Path(folder).name}: {result.failed}")
            print(f"{Path(folder).name}: {result.failed}", file=sys.stderr)
        else:
            errors.append(score(result.demonstration, truth))
            heads, rows = table(errors[-1:])
            print(Path(folder).name, *(f"{h}: {v}" for h, v in zip(heads[2:], rows[0][2:], strict=True)), sep="; ")
    seconds = time.perf_counter() - begin
    heads, rows = table(errors)
    lines = ["| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows)]
    text = "\n".join(
        [
            "# Demonstrations from the stage, estimated from end to end",
            "",
            "Written by `benchmarks/demonstrations.py`; made anew, not edited.",
            "",
            *lines,
            "",
            DEFINITIONS,
            "",
            f"{len(chosen.recordings)} recordings, {frames} frames in {seconds:.0f} s: {frames / seconds:.1f} frames a "
            "second (only if nothing was taken over from an earlier run).",
            *(f"\nNo demonstration: {line}" for line in failed),
            "",
            machine(),
            "",
        ]
    )
    print(text)
    if chosen.out is not None:
        write_atomically(chosen.out / "README.md", text)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", help="folders of `understudy stage record`")
    parser.add_argument("--work", type=Path, required=True, help="folder for the demonstrations")
    parser.add_argument("--out", type=Path, help="folder for README.md")
    parser.add_argument("--object", default="rgbd")
    parser.add_argument("--teacher", default="rgbd")
    parser.add_argument("--markers")
    parser.add_argument("--hands", default="full")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    try:
        main()
    except (UnderstudyError, ImportError) as e:
        sys.exit(f"demonstrations.py: {e}")
