"""How near demonstrations are to what happened on the stage: recordings are estimated from end to end and scored.

    understudy stage record --task all --demos 5 --out RECORDINGS
    python benchmarks/demonstrations.py RECORDINGS/* --work WORK --out docs/demonstrations

Estimation goes on where it stopped (in WORK). The speed counts everything, from the start of the processes to the last
file; where other programs run, the processor time tells more.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from common import machine
from tqdm import tqdm

from understudy.benchmark.demonstrations import DEFINITIONS, DemonstrationErrors, from_stage, score, table
from understudy.demonstration.build import DemonstrationConfig
from understudy.demonstration.run import Result, demonstrate
from understudy.errors import UnderstudyError
from understudy.files import write_atomically


def main(arguments: Sequence[str] | None = None) -> None:
    chosen = parse(arguments)
    truths = [from_stage(folder) for folder in chosen.recordings]
    configs = [
        DemonstrationConfig(truth.task, chosen.object, chosen.teacher, marker_file(chosen, folder))
        for truth, folder in zip(truths, chosen.recordings, strict=True)
    ]
    begin, used = time.perf_counter(), processor_s()
    results = demonstrate(
        chosen.recordings, chosen.work, configs, hands=chosen.hands, progress=True, report=complain, jobs=chosen.jobs
    )
    seconds, used = time.perf_counter() - begin, processor_s() - used
    frames = sum(len(truth.times_s) for truth in truths)
    errors: list[DemonstrationErrors] = []
    for result, truth in zip(results, truths, strict=True):
        if result.demonstration is not None:
            errors.append(score(result.demonstration, truth))
            heads, rows = table(errors[-1:])
            print(result.folder.name, *(f"{h}: {v}" for h, v in zip(heads[2:], rows[0][2:], strict=True)), sep="; ")
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
            f"{len(results)} recordings, {frames} frames in {seconds:.0f} s: {frames / seconds:.1f} frames a second, "
            f"{1000 * used / frames:.0f} ms of processor time a frame (if nothing was taken over from an earlier run).",
            *(f"\nNo demonstration: {r.folder.name}: {r.failed}" for r in results if r.failed),
            "",
            machine(),
            "",
        ]
    )
    print(text)
    if chosen.out is not None:
        write_atomically(chosen.out / "README.md", text)


def complain(result: Result) -> None:
    if result.failed:
        tqdm.write(f"{result.folder.name}: {result.failed}", file=sys.stderr)


def processor_s() -> float:
    """Seconds that this process and those that it has started and seen end have used, on all processors."""
    return sum(os.times()[:4])


def marker_file(chosen: argparse.Namespace, folder: str) -> str | None:
    """Which marker is on what: as given, or the recording's own."""
    if chosen.markers or "markers" not in (chosen.object, chosen.teacher):
        return chosen.markers
    return str(Path(folder) / "markers.json")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", help="folders of `understudy stage record`")
    parser.add_argument("--work", type=Path, required=True, help="folder for the demonstrations")
    parser.add_argument("--out", type=Path, help="folder for README.md")
    parser.add_argument("--object", default="rgbd")
    parser.add_argument("--teacher", default="rgbd")
    parser.add_argument("--markers", help="which marker is on what; default: each recording's own markers.json")
    parser.add_argument("--hands", default="full")
    parser.add_argument("--jobs", type=int, help="recordings at a time (default: one a processor)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    try:
        main()
    except (UnderstudyError, ImportError) as e:
        sys.exit(f"demonstrations.py: {e}")
