"""Action models: time to learn from 10 demonstrations of 150 steps and to read out 200 steps, against gmr's own."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import milliseconds, report

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from action_scenes import TASKS, demonstrate

from understudy.actions import learn


def main() -> None:
    import gmr

    phase, rows = np.linspace(0, 1, 200), []
    for task in ("room_door", "swivel_door", "drawer", "sliding_door"):
        rng = np.random.default_rng(0)
        motions = [demonstrate(TASKS[task], rng) for _ in range(10)]
        learn(motions[:1])  # imports
        seconds = cpu_seconds(lambda motions=motions: learn(motions))
        warped = cpu_seconds(lambda motions=motions: learn(motions, alignment="dtw"))
        model = learn(motions)
        mixture = model.segments["reach"].mixture
        own = milliseconds(lambda mixture=mixture: mixture.regress(phase))
        other = gmr.GMM(len(mixture), priors=mixture.weights, means=mixture.means, covariances=mixture.covariances)
        theirs = milliseconds(lambda other=other: other.predict(np.array([0]), phase[:, None]), repeat=10)
        away = np.abs(other.predict(np.array([0]), phase[:, None]) - mixture.regress(phase).mean).max()
        whole = milliseconds(lambda model=model: model.reproduce(model.object.T_start), repeat=10)
        components = " / ".join(str(len(s.mixture)) for s in model.segments.values())
        row = [
            task,
            components,
            f"{seconds:.2f}",
            f"{warped:.2f}",
            f"{own:.2f}",
            f"{theirs:.1f}",
            f"{theirs / own:.0f}",
        ]
        rows.append([*row, f"{away:.0e}", f"{whole:.1f}"])
    heads = ["task", "components", "fit s", "fit, dtw s", "GMR ms", "gmr ms", "gmr / ours", "apart", "reproduce ms"]
    notes = (
        "Made-up demonstrations (tests/action_scenes.py). Components: reach / manipulate / release. Fit: processor "
        "seconds, target <= 3. GMR: mean, slope and covariance of 200 phases x 10 features (target <= 5 ms); gmr: mean."
    )
    report("actions", heads, rows, notes)


def cpu_seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


if __name__ == "__main__":
    main()
