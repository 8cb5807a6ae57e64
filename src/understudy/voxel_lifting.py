"""The voxel method: roots, person's view, network, assembly. `VoxelLifter` names the stages in order.

Where several places compete for a person (an occluder, the background), the network looks at each, and the one in which
it believes most wins. People of whom it is not sure are looked at again, from where it found their trunk: their voxels
fall otherwise, so both looks err in part independently, and their mean errs less.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float32
from scipy.special import logit

from understudy import voxels
from understudy.assembly import ASSEMBLIES, Rows
from understudy.errors import UnderstudyError, one_of
from understudy.floor import Floor, measured_floor
from understudy.roots import Root, find_roots
from understudy.skeleton import FLIP, TORSO
from understudy.standing import stood
from understudy.types import INFERRED, OBSERVED, Keypoints2D, Person, RegisteredFrame
from understudy.voxelposenet.predictor import Prediction, Predictor, keypoint_input
from understudy.voxels import PersonView

SECOND_LOOKS: Final = 2
"""People of a frame who are looked at again; a bound, so that crowds take no longer than they must."""

_POOLED_ERROR = 0.95  # of two pooled looks, where that of one is 1
_CROWDING = 1.0  # log odds that a place loses because somebody stands there already
_CROWDED = 0.25  # metres: trunks of two people are hardly ever as near as that
_NEAREST = 0.2  # metres before the camera: from there on a trunk is looked at


class VoxelLifter:
    """Keypoints and depth -> 3D joints by the voxel network; every joint of everybody, hidden ones too."""

    def __init__(
        self,
        min_score: float = 0.2,
        weights: Path | None = None,
        assembly: str = "uncertainty",
        second_looks: int = SECOND_LOOKS,
    ):
        """min_score: 2D keypoints with a lower score are not shown to the network. assembly: one of ASSEMBLIES.
        second_looks: how many people of a frame, the least sure ones, are looked at again at most; at 0, nobody is.
        """
        if assembly not in ASSEMBLIES:
            raise UnderstudyError(f"assembly {assembly!r}: must be {one_of(ASSEMBLIES)}")
        if second_looks < 0:
            raise UnderstudyError(f"second_looks {second_looks}: must be 0 or more")
        self.min_score, self.second_looks = min_score, second_looks
        self.predictor = Predictor(weights)
        self._assemble = ASSEMBLIES[assembly]

    def lift(self, frame: RegisteredFrame, people: Sequence[Keypoints2D]) -> list[Person]:
        if not people:
            return []
        cloud = voxels.cloud(frame.depth, voxels.ENOUGH)
        floor = measured_floor(cloud)
        roots = [find_roots(person, frame.depth, frame.camera, self.min_score, floor) for person in people]
        each = [(person, root) for person, several in zip(people, roots, strict=True) for root in several]
        lifted = iter(self._lift(frame, cloud, floor, each))
        candidates = [[next(lifted) for _ in r] for r in roots]
        chosen = choose(candidates, roots)
        out = [
            Person.failure(person, "no usable 2D keypoint") if k is None else several[k]
            for person, several, k in zip(people, candidates, chosen, strict=True)
        ]
        at = {i: several[k] for i, (several, k) in enumerate(zip(roots, chosen, strict=True)) if k is not None}
        again = self._again(out, at)
        second = self._lift(frame, cloud, floor, [(people[i], root) for i, root in again.items()], mirrored=True)
        for i, look in zip(again, second, strict=True):
            out[i] = pooled(out[i], look)
        return out

    def _again(self, people: Sequence[Person], roots: Mapping[int, Root]) -> dict[int, Root]:
        """Who is looked at again, and from where. roots: from where they were looked at, by their number."""
        trunks = {i: people[i].keypoints[TORSO].mean(0) for i, root in roots.items() if root.evidence == "depth"}
        can = [i for i, trunk in trunks.items() if trunk[2] > _NEAREST]
        least_sure = sorted(can, key=lambda i: float(people[i].confidence.mean()))[: self.second_looks]
        return {i: replace(roots[i], point=trunks[i]) for i in sorted(least_sure)}

    def _lift(
        self,
        frame: RegisteredFrame,
        cloud: Float32[np.ndarray, "n 3"],
        floor: Floor | None,
        each: Sequence[tuple[Keypoints2D, Root]],
        mirrored: bool = False,
    ) -> list[Person]:
        """Every pair of a person and a place. cloud: the frame's points, see `voxels.cloud`. mirrored: the network is
        shown the mirror image; the people are not mirrored.
        """
        if not each:
            return []
        views = [PersonView.towards(root.point) for _, root in each]
        if mirrored:
            views = [view.mirrored() for view in views]
        depth = np.stack([view.depth_grid(cloud) for view in views])
        rows = np.stack(
            [keypoint_input(v, frame.camera, p, self.min_score) for v, (p, _) in zip(views, each, strict=True)]
        )
        said = self.predictor(views, depth, rows[:, FLIP] if mirrored else rows, floor)
        if mirrored:
            said = [person.flipped() for person in said]
        return [self._person(*pair, *with_it) for pair, *with_it in zip(each, views, rows, said, strict=True)]

    def _person(self, seen: Keypoints2D, root: Root, view: PersonView, rows: Rows, said: Prediction) -> Person:
        joints = view.to_cam(self._assemble(said, rows, view))
        if root.floor_likelihood is not None:
            joints = stood(joints, root.floor_likelihood)
        observed = (said.seen > 0.5) & (rows[:, 2] > 0) & (root.evidence == "depth")
        source = np.where(observed, OBSERVED, INFERRED)
        return Person(seen, joints, said.confidence, said.sigma, tuple(source.tolist()))


def pooled(first: Person, second: Person) -> Person:
    """Two looks at one person as one: each joint counts as much as its look is sure."""
    looks = (first, second)
    weight = np.stack([look.sigma_m**-2 for look in looks])
    weight /= weight.sum(0)
    joints = np.einsum("lj,ljk->jk", weight, np.stack([look.keypoints for look in looks]))
    sigma, confidence = (
        (weight * np.stack([getattr(look, name) for look in looks])).sum(0) for name in ("sigma_m", "confidence")
    )
    return replace(first, keypoints=joints, sigma_m=_POOLED_ERROR * sigma, confidence=confidence)


def choose(candidates: Sequence[Sequence[Person]], roots: Sequence[Sequence[Root]]) -> list[int | None]:
    """Number of the place that each person gets; None for those without any. The surest choose first: what stands
    where somebody stands already is less likely to be a second person than the one before whom the first stands.
    """
    trust = [[_credibility(p, r) for p, r in zip(*pair, strict=True)] for pair in zip(candidates, roots, strict=True)]
    out: list[int | None] = [None] * len(candidates)
    taken: list[np.ndarray] = []
    for i in sorted((i for i, t in enumerate(trust) if t), key=lambda i: -max(trust[i])):
        trunks = [p.keypoints[TORSO].mean(0) for p in candidates[i]]
        crowded = [any(np.linalg.norm(t - other) < _CROWDED for other in taken) for t in trunks]
        k = int(np.argmax(np.array(trust[i]) - _CROWDING * np.array(crowded)))
        out[i] = k
        taken.append(trunks[k])
    return out


def _credibility(person: Person, root: Root) -> float:
    """Which of several places of one person to believe: log odds of the network's word, and the depths that agree.

    The latter decide where the network is of two minds; their weight matters little between 0.2 and 0.5.
    """
    sure = np.clip(person.confidence.mean(), 0.01, 0.99)
    return float(logit(sure) + 0.2 * np.log(root.support + 0.03))
