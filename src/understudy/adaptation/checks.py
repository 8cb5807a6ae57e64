"""What the exact checks say about an adaptation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from understudy.adaptation.platform import JointPath
from understudy.adaptation.problem import State


@dataclass(frozen=True, eq=False)
class Checked:
    """A state, and what the exact checks say about it."""

    state: State
    free: Bool[np.ndarray, " n"]
    """exactly clear of each demonstration's map"""
    beside: Bool[np.ndarray, " n"]
    """the base is not where the moving part is"""
    achieved: Bool[np.ndarray, " n"]
    """by exact inverse kinematics"""
    joints: tuple[JointPath | None, ...]
    """per demonstration"""
    sizes: tuple[int, ...]
    """samples of each"""

    @property
    def clear(self) -> Bool[np.ndarray, " n"]:
        """The base hits nothing."""
        return self.free & self.beside

    @property
    def arm(self) -> Bool[np.ndarray, " n"]:
        """The arm goes on from here and to here by small motions, and its links hit nothing; everywhere, where nothing
        is known of joints.
        """
        parts = zip(self.joints, self.sizes, strict=True)
        return np.concatenate([np.ones(n, bool) if j is None else at_ease(j) for j, n in parts])

    @property
    def failures(self) -> tuple[bool, int, int]:
        """The least is best: whether the base hits what stands still, which is always refused; samples at which it hits
        something or the pose is out of reach; and at which the arm is not at its ease.
        """
        return not self.free.all(), int((~(self.clear & self.achieved)).sum()), int((~self.arm).sum())


def at_ease(path: JointPath) -> Bool[np.ndarray, " t"]:
    """Where the arm touches nothing, and comes and goes by small motions."""
    return np.asarray(path.clear & np.append(path.linked, True) & np.append(True, path.linked))


def about_arm(path: JointPath) -> list[str]:
    """What a user should know about an arm's motion."""
    words = []
    if not path.linked.all():
        at = ", ".join(map(str, np.flatnonzero(~path.linked).tolist()[:6]))
        words.append(f"no continuous motion of the arm was found after samples {at}")
    for what, clear in (("scene", path.scene_clear), ("moving part", path.part_clear)):
        touches = int((path.exact & ~clear).sum())
        if touches:
            words.append(f"the arm is where the {what} is at {touches} samples")
    return words
