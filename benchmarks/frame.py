"""A whole frame, stage by stage: milliseconds in all and per person.

    python benchmarks/frame.py [RECORDING]      default: the bundled sample

The alternatives in the same run: the detector on one thread instead of two, the detector without depth (tiles), and the
lifting's nearest depths by a KD-tree over all valid depth pixels, and the palms from depth alone.
"""

from __future__ import annotations

import sys

import numpy as np
from common import milliseconds, report
from scipy.spatial import cKDTree

from understudy import recordings
from understudy.detectors.blazepose import BlazePoseDetector
from understudy.estimator import Estimator
from understudy.hands import HandNormalEstimator
from understudy.types import Keypoints2D, RegisteredFrame


def main() -> None:
    recording = recordings.open(sys.argv[1] if len(sys.argv) > 1 else "sample")
    frame = recording[0]
    estimator = Estimator()
    registered = estimator.register(frame)
    keypoints = estimator.detect(registered)
    n = max(len(keypoints), 1)
    people = estimator.lift(registered, keypoints)
    one_thread, depth_alone = BlazePoseDetector(threads=1), HandNormalEstimator(color=False)
    stages = {
        "1 register": milliseconds(lambda: estimator.register(frame)),
        "2 detect": milliseconds(lambda: estimator.detect(registered), 15),
        "3 lift": milliseconds(lambda: estimator.lift(registered, keypoints)),
        "4 find hands": milliseconds(lambda: estimator.find_hands(registered, people), 15),
    }
    total = milliseconds(lambda: estimator.estimate(frame), 15)
    others = {
        "2 detect, one thread": milliseconds(lambda: one_thread.detect(frame.color, registered.depth), 10),
        "2 detect, no depth (tiles)": milliseconds(lambda: estimator.detector.detect(frame.color), 10),
        "3 nearest depths by KD-tree": milliseconds(lambda: by_tree(registered, keypoints), 5),
        "4 hands from depth alone": milliseconds(lambda: depth_alone.estimate_all(registered, people), 15),
    }
    against = {"2 detect, one thread": "2 detect", "2 detect, no depth (tiles)": "2 detect"}
    against["4 hands from depth alone"] = "4 find hands"
    rows = [[name, f"{ms:.1f}", f"{ms / n:.1f}", ""] for name, ms in stages.items()]
    rows.append(["**all**", f"**{total:.1f}**", f"**{total / n:.1f}**", ""])
    for name, ms in others.items():
        ratio = ms / stages[against.get(name, "3 lift")]
        rows.append([name, f"{ms:.1f}", f"{ms / n:.1f}", f"{ratio:.1f} x ours"])
    heads = ["stage", "ms", "ms per person", "alternative"]
    note = f"{recording.name}: {len(keypoints)} people, colour {registered.camera.width} x {registered.camera.height}."
    report(
        f"frame-{recording.name}",
        heads,
        rows,
        note + " Targets on 2 cores: <= 250 ms for stages 1 to 3 with 4 people, <= 30 ms a person for 4.",
    )


def by_tree(frame: RegisteredFrame, people: list[Keypoints2D]) -> np.ndarray:
    """What `lifting.nearest_depths` gives, by the textbook way."""
    v, u = np.nonzero(frame.depth.z)
    scale = frame.depth.scale_to(frame.camera)
    uv = np.concatenate([p.uv for p in people]) if people else np.zeros((1, 2))
    _, index = cKDTree(np.column_stack([u, v])).query((uv + 0.5) * scale - 0.5, k=3)
    return frame.depth.z[v, u][index]


if __name__ == "__main__":
    main()
