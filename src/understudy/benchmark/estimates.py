"""The people that a benchmark scores, estimated by the pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from understudy.benchmark.run import Estimate, Timed
from understudy.pipeline import estimate_recording


def estimate_into(out: Path, detector: str = "blazepose", *, resume: bool = False, progress: bool = False) -> Estimate:
    """An `estimate` for `benchmark` whose results stay in OUT/RECORDING/METHOD.

    Estimates anew each time; with `resume` an interrupted benchmark goes on where it stopped, and what an earlier one
    finished is scored again. The time is the median over the frames that were estimated, which leaves out the loading
    of the networks.
    """

    def estimate(recording: Any, method: str) -> Timed:
        seconds: list[float] = []
        people = estimate_recording(
            recording,
            out / recording.path.resolve().name / method,
            method=method,
            detector=detector,
            overlays=False,
            restart=not resume,
            progress=progress,
            report=lambda frame, s: seconds.append(s),
        )
        return Timed(people, 1000 * float(np.median(seconds)) if seconds else None)

    return estimate
