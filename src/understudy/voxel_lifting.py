"""The voxel method: root, person's view, network, assembly. `VoxelLifter` names the stages in order."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from understudy import voxels
from understudy.roots import Root, find_root
from understudy.types import INFERRED, OBSERVED, Keypoints2D, Person, RegisteredFrame
from understudy.voxelposenet.predictor import Prediction, Predictor, keypoint_input
from understudy.voxels import PersonView


class VoxelLifter:
    """Keypoints and depth -> 3D joints by the voxel network; every joint of everybody, hidden ones too."""

    def __init__(self, min_score: float = 0.2, weights: Path | None = None):
        """min_score: 2D keypoints with a lower score are not shown to the network."""
        self.min_score = min_score
        self.predictor = Predictor(weights)

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        if not people:
            return []
        roots = [find_root(p, frame.depth, frame.camera, self.min_score) for p in people]
        views = [PersonView.towards(r.point) for r in roots if r is not None]
        rooted = [p for p, r in zip(people, roots, strict=True) if r is not None]
        cloud = voxels.cloud(frame.depth)
        depth = np.stack([v.depth_grid(cloud) for v in views]) if views else np.empty((0, 2, 64, 64), np.float32)
        inputs = [keypoint_input(v, frame.camera, p, self.min_score) for v, p in zip(views, rooted, strict=True)]
        predictions = iter(self.predictor(views, depth, np.array(inputs, np.float32).reshape(-1, 18, 3)))
        return [
            Person.failure(p, "none of its 2D keypoints is usable") if r is None else self._person(p, r, next(predictions))
            for p, r in zip(people, roots, strict=True)
        ]

    def _person(self, seen: Keypoints2D, root: Root, said: Prediction) -> Person:
        source = np.where((said.seen > 0.5) & seen.found, OBSERVED, INFERRED)
        return Person(seen, said.joints, said.confidence, said.sigma, tuple(source.tolist()))
