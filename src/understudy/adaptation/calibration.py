"""X (hand to gripper) and Y (torso to base): fixed transforms between the teacher's body and the robot's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.adaptation.parts import mirrored_sides
from understudy.adaptation.problem import mirror
from understudy.demonstration.demonstration import Demonstration

_SPREAD: Final = np.array([0.05] * 3 + [np.radians(20)] * 3)  # residuals of this size lose half of their weight
_ROUNDS: Final = 20


def _default_hand_tool() -> Float[np.ndarray, "4 4"]:
    """The gripper approaches where the palm faces and closes along the fingers; its middle is 3 cm before the palm."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])  # columns: tool x = hand z, y = hand x, z = hand y
    T[:3, 3] = (0.02, 0, 0.03)
    return T


DEFAULT_HAND_TOOL: Final = _default_hand_tool()
"""X: T_hand_tool"""
_ROLL: Final = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about the approach
DEFAULT_TORSO_BASE: Final = np.array([-0.2, 0.0, 0.0])
"""Y: (x, y, yaw) of the base seen from the torso: somewhat farther from the work, for a base is wider than a person"""


@dataclass(frozen=True, eq=False)
class Calibration:
    """How the robot stands in for the teacher. Fixed for all demonstrations of a task."""

    T_hand_tool: Float[np.ndarray, "4 4"]
    """X: a gripper at H X is where the hand is"""
    torso_base: Float[np.ndarray, "3"]
    """Y: metres, metres, radians; a base at P Y is where the torso is"""
    T_left_tool: Float[np.ndarray, "4 4"] | None = None
    """X of left hands, where both sides act; None: `T_hand_tool` is of either"""

    def hand_tool(self, acting: str) -> Float[np.ndarray, "4 4"]:
        """X of the acting hand: 'left' or 'right'."""
        return self.T_hand_tool if acting == "right" or self.T_left_tool is None else self.T_left_tool

    @classmethod
    def default(cls) -> Calibration:
        """Without looking at any demonstration."""
        return cls(DEFAULT_HAND_TOOL.copy(), DEFAULT_TORSO_BASE.copy())


def mean_pose(T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "4 4"]:
    """Karcher mean, robust (Cauchy weights): n poses of which some may be far off."""
    start = int(np.argmin(np.linalg.norm(T[:, :3, 3] - np.median(T[:, :3, 3], axis=0), axis=1)))
    mean = T[start]
    for _ in range(_ROUNDS):
        e = lie.se3_log(lie.se3_inverse(mean) @ T)
        weight = 1 / (1 + np.sum((e / _SPREAD) ** 2, axis=1))
        step = (weight @ e) / weight.sum()
        mean = mean @ lie.se3_exp(step)
        if np.abs(step).max() < 1e-10:
            break
    return mean


def hands_on_object(demonstration: Demonstration) -> Float[np.ndarray, "n 4 4"]:
    """T_object_hand of all samples of the manipulation where hand and object are known and measured."""
    d = demonstration
    holding = np.zeros(len(d), bool)
    holding[d.segments.slices(len(d))["manipulate"]] = True
    use = holding & d.hand.observed & d.hand.oriented & d.hand.known & d.object.known
    return lie.se3_inverse(d.object.T_world_x[use]) @ d.hand.T_world_x[use]


def typical_hands(demonstrations: Sequence[Demonstration]) -> Float[np.ndarray, "d 4 4"]:
    """The mean hand in the object's frame of every demonstration that shows one."""
    means = [_typical_hand(d) for d in demonstrations]
    return np.concatenate(means) if means else np.zeros((0, 4, 4))


_typical: WeakKeyDictionary[Demonstration, Float[np.ndarray, "_ 4 4"]] = WeakKeyDictionary()


def _typical_hand(demonstration: Demonstration) -> Float[np.ndarray, "_ 4 4"]:
    """One mean hand, or none; kept, for it is asked for with every grasp that is tried."""
    if demonstration not in _typical:
        shown = hands_on_object(demonstration)
        _typical[demonstration] = mean_pose(shown)[None] if len(shown) else np.zeros((0, 4, 4))
    return _typical[demonstration]


def typical_tools(demonstrations: Sequence[Demonstration], calibration: Calibration) -> Float[np.ndarray, "d 4 4"]:
    """Where a gripper at H X would hold the object, in the object's frame, of every demonstration that shows it.

    Those of doors hung on the other side are mirrored. A left hand holds a bar the other way up than a right one; a
    gripper is the same both ways, so left hands' are rolled by half a turn where X is not their own.
    """
    mirrored, out = mirrored_sides(demonstrations), []
    both = len({d.acting for d in demonstrations}) > 1 and calibration.T_left_tool is None
    for d, other_side in zip(demonstrations, mirrored, strict=True):
        for hand in typical_hands([d]):
            tool = hand @ calibration.hand_tool(d.acting) @ (_ROLL if both and d.acting == "left" else np.eye(4))
            out.append(mirror(tool) if other_side else tool)
    return np.array(out) if out else np.zeros((0, 4, 4))


def estimate_hand_tools(
    demonstrations: Sequence[Demonstration], grasp: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"] | None]:
    """X, the mean of H^-1 O g over how the hands hold the object; and that of left hands, where both sides act.

    grasp: as in the first demonstration. The default for a side of which no hand is seen.
    """
    found: dict[str, list[np.ndarray]] = {d.acting: [] for d in demonstrations}
    for d, other_side in zip(demonstrations, mirrored_sides(demonstrations), strict=True):
        held = mirror(grasp) if other_side else grasp
        found[d.acting] += [lie.se3_inverse(T) @ held for T in typical_hands([d])]
    X = {side: mean_pose(np.array(tools)) if tools else DEFAULT_HAND_TOOL.copy() for side, tools in found.items()}
    return (X["right"], X["left"]) if len(X) == 2 else (next(iter(X.values())), None)


def estimate_hand_tool(
    demonstrations: Sequence[Demonstration], grasp: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """X of right hands, or of the only side that acts (see `estimate_hand_tools`)."""
    return estimate_hand_tools(demonstrations, grasp)[0]
