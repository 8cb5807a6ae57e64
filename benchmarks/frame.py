"""A whole frame, stage by stage: milliseconds in all and per person.

    python benchmarks/frame.py [RECORDING]      default: the bundled sample

Lifting also part by part. The alternatives in the same run: the detector on one thread instead of two, the detector
without depth (tiles), the lifting's nearest depths by a KD-tree over all valid depth pixels, and the palms from depth
alone.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from common import milliseconds, report
from scipy.spatial import cKDTree

from understudy import recordings, voxels
from understudy.assembly import by_uncertainty
from understudy.detectors.blazepose import BlazePoseDetector
from understudy.estimator import Estimator
from understudy.floor import measured_floor
from understudy.hands import HandNormalEstimator
from understudy.roots import Root, find_roots
from understudy.types import Keypoints2D, RegisteredFrame
from understudy.voxel_lifting import VoxelLifter
from understudy.voxelposenet.predictor import keypoint_input
from understudy.voxels import PersonView


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
    rows += [[f"3 {name}", f"{ms:.1f}", f"{ms / k:.1f}", ""] for name, ms, k in parts_of_lifting(registered, keypoints)]
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


def parts_of_lifting(frame: RegisteredFrame, people: list[Keypoints2D]) -> Iterator[tuple[str, float, int]]:
    """Milliseconds of each, and for how many people. A second look repeats grid, network and assembly."""
    lifter, n = VoxelLifter(), max(len(people), 1)
    cloud = voxels.cloud(frame.depth, voxels.ENOUGH)
    floor = measured_floor(cloud)
    yield "points of the frame", milliseconds(lambda: voxels.cloud(frame.depth, voxels.ENOUGH)), n
    yield "floor", milliseconds(lambda: measured_floor(cloud)), n

    def roots() -> list[list[Root]]:
        return [find_roots(person, frame.depth, frame.camera, lifter.min_score, floor) for person in people]

    yield "roots", milliseconds(roots), n
    first = [(person, several[0]) for person, several in zip(people, roots(), strict=True) if several]
    views = [PersonView.towards(root.point) for _, root in first]
    if not views:
        return
    yield "voxel grid", milliseconds(lambda: [view.depth_grid(cloud) for view in views]), n
    depth = np.stack([view.depth_grid(cloud) for view in views])
    rows = [keypoint_input(v, frame.camera, p, lifter.min_score) for v, (p, _) in zip(views, first, strict=True)]
    yield "network", milliseconds(lambda: lifter.predictor(views, depth, np.stack(rows), floor)), n
    alone = milliseconds(lambda: lifter.predictor(views[:1], depth[:1], rows[0][None], floor))
    yield "network, one person alone", alone, 1
    said = lifter.predictor(views, depth, np.stack(rows), floor)
    yield "assembly", milliseconds(lambda: [by_uncertainty(*each) for each in zip(said, rows, views, strict=True)]), n
    once = VoxelLifter(second_looks=0)
    yield "lift without second looks", milliseconds(lambda: once.lift(frame, people)), n


def by_tree(frame: RegisteredFrame, people: list[Keypoints2D]) -> np.ndarray:
    """What `lifting.nearest_depths` gives, by the textbook way."""
    v, u = np.nonzero(frame.depth.z)
    scale = frame.depth.scale_to(frame.camera)
    uv = np.concatenate([p.uv for p in people]) if people else np.zeros((1, 2))
    _, index = cKDTree(np.column_stack([u, v])).query((uv + 0.5) * scale - 0.5, k=3)
    return frame.depth.z[v, u][index]


if __name__ == "__main__":
    main()
