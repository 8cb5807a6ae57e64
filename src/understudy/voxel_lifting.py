"""The voxel method: root, person's view, network, assembly. `VoxelLifter` names the stages in order."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from understudy import voxels
from understudy.assembly import ASSEMBLIES, Rows
from understudy.errors import UnderstudyError, one_of
from understudy.roots import Root, find_root
from understudy.types import INFERRED, OBSERVED, Keypoints2D, Person, RegisteredFrame
from understudy.voxelposenet.predictor import Prediction, Predictor, keypoint_input
from understudy.voxels import PersonView


class VoxelLifter:
    """Keypoints and depth -> 3D joints by the voxel network; every joint of everybody, hidden ones too."""

    def __init__(self, min_score: float = 0.2, weights: Path | None = None, assembly: str = "uncertainty"):
        """min_score: 2D keypoints with a lower score are not shown to the network. assembly: one of ASSEMBLIES."""
        if assembly not in ASSEMBLIES:
            raise UnderstudyError(f"assembly {assembly!r}: must be {one_of(ASSEMBLIES)}")
        self.min_score = min_score
        self.predictor = Predictor(weights)
        self._assemble = ASSEMBLIES[assembly]

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        if not people:
            return []
        roots = [find_root(person, frame.depth, frame.camera, self.min_score) for person in people]
        lifted = iter(self._lift(frame, [(p, r) for p, r in zip(people, roots, strict=True) if r is not None]))
        return [
            Person.failure(person, "no usable 2D keypoint") if root is None else next(lifted)
            for person, root in zip(people, roots, strict=True)
        ]

    def _lift(self, frame: RegisteredFrame, rooted: Sequence[tuple[Keypoints2D, Root]]) -> list[Person]:
        """Those who have a root, in their order."""
        if not rooted:
            return []
        views = [PersonView.towards(root.point) for _, root in rooted]
        cloud = voxels.cloud(frame.depth)
        depth = np.stack([view.depth_grid(cloud) for view in views])
        rows = np.stack(
            [keypoint_input(v, frame.camera, p, self.min_score) for v, (p, _) in zip(views, rooted, strict=True)]
        )
        said = self.predictor(views, depth, rows)
        return [self._person(p, *each) for (p, _), *each in zip(rooted, views, rows, said, strict=True)]

    def _person(self, seen: Keypoints2D, view: PersonView, rows: Rows, said: Prediction) -> Person:
        joints = view.to_cam(self._assemble(said, rows, view))
        source = np.where((said.seen > 0.5) & (rows[:, 2] > 0), OBSERVED, INFERRED)
        return Person(seen, joints, said.confidence, said.sigma, tuple(source.tolist()))
