"""Teaching without cameras: demonstrations of a drawer that are made up instead of estimated.

As a program (`python teaching_scenes.py OUT`), it teaches from one of them and tries the skill once, resting at the end
of the first stage and at the start of the last: for tests that kill it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import adaptation_scenes as scenes
import numpy as np

from understudy import report, teaching
from understudy.adaptation import plots
from understudy.adaptation.calibration import Calibration
from understudy.adaptation.result import AdaptationResult, Adapted, Report
from understudy.adaptation.solver import Convergence
from understudy.demonstration import storage
from understudy.demonstration.demonstration import Demonstration
from understudy.demonstration.run import Result
from understudy.files import write_atomically
from understudy.teaching import TeachConfig, Teaching


def made_up(paths: Sequence[str | Path], out: Path, *args: object, **options: object) -> list[Result]:
    """Stands in for `demonstration.run.demonstrate`. Recordings named bad... hold nothing."""
    results = []
    for seed, path in enumerate(map(Path, paths)):
        if path.name.startswith("bad"):
            results.append(Result(str(path), out / path.name, None, f"{path}: nobody <is> there"))
            continue
        demo = replace(scenes.demonstration("drawer", seed, samples=60), source={"recording": str(path)})
        storage.save(out / path.name, demo)
        results.append(Result(str(path), out / path.name, demo))
    return results


def taught(
    out: Path,
    names: Sequence[str] = ("one",),
    task: str = "drawer",
    trials: int = 0,
    drawn: bool = False,
    rest_s: float = 0.0,
) -> Teaching:
    """`teach` with made-up demonstrations. drawn: with pictures; without them, the report is a line.

    rest_s: after the demonstrations were saved, and before the report is.
    """

    def line(teaching: Teaching) -> Path:
        time.sleep(rest_s)
        write_atomically(teaching.report, "a line")
        return teaching.report

    def resting(*args: Any, **options: Any) -> list[Result]:
        results = made_up(*args, **options)
        time.sleep(rest_s)
        return results

    config = TeachConfig(trials=trials, film=False)
    with ExitStack() as stack:
        stack.enter_context(patch.object(teaching, "demonstrate", resting))
        if not drawn:
            stack.enter_context(patch.object(report, "write", line))
            stack.enter_context(patch.object(plots, "pictures", lambda *args: {}))
        return teaching.teach(names, out, task=task, config=config, progress=False)


def as_shown(d: Demonstration) -> Adapted:
    """A robot that does what the person did, one and a half times as slowly."""
    yes = np.ones(len(d), bool)
    good = d.hand.known
    nearest = np.flatnonzero(good)[np.abs(np.arange(len(d))[:, None] - np.flatnonzero(good)).argmin(axis=1)]
    base = np.nan_to_num(d.torso.xy_yaw)
    return Adapted(1.5 * d.times_s, d.hand.T_world_x[nearest], base, np.full(len(d), 0.1), yes, yes, np.eye(4), {})


def as_if_adapted(demonstrations: Sequence[Demonstration]) -> AdaptationResult:
    """The result of an adaptation that bends nothing."""
    report = Report(Convergence((), True, 0.0, 0.0), 0, ("bends <nothing>",))
    adapted = tuple(as_shown(d) for d in demonstrations)
    return AdaptationResult("drawer", "pr2_right", adapted, np.eye(4), Calibration.default(), report)


if __name__ == "__main__":
    taught(Path(sys.argv[1]), trials=1, rest_s=5.0)
