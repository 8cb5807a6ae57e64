"""Feasible gripper poses on a handle, and the one nearest to what all demonstrations show.

In the handle's frame (`objects.articulation.Handle`: x out of the front, z along the bar) a gripper takes hold with its
approach (tool x) towards the front and its fingers closing across the bar (tool y). What is free: a turn about the bar,
a place along it, half a turn about the approach. Short grips (knobs) can also be taken end to end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy import lie
from understudy.adaptation.errors import InfeasibleError
from understudy.adaptation.platform import Platform
from understudy.objects.articulation import Handle

_TURN: Final = np.radians(45)  # about the bar, to either side: beyond, the gripper would meet the front
_END_M: Final = 0.02  # of the bar that must stay beyond the middle of the fingers
_CLEARANCE_M: Final = 0.01  # between open fingers and the bar, in all
_TURNS: Final = 5  # of a family, when others than the nearest are tried
_RADIUS_M: Final = 0.3  # metres that count as much as a radian, when grasps are compared


@dataclass(frozen=True)
class GraspFamily:
    """Grasps that go over into each other: by turning about the bar and sliding along it."""

    roll: float
    """radians about the approach: 0 or pi; +-pi/2 for a knob taken end to end"""
    turn: float
    """greatest turn about the bar to either side, radians"""
    slide_m: float
    """greatest way along the bar to either side"""

    def members(self, turn: Float[np.ndarray, " n"], slide: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """T_object_tool for turns (radians) about the bar and ways (metres) along it."""
        frontal = np.column_stack([[-1, 0, 0], [0, -1, 0], [0, 0, 1.0]])  # tool x = -x, y = -y, z = z
        R = frontal @ lie.so3_exp(np.array([self.roll, 0, 0]))
        T = np.zeros((len(turn), 4, 4))
        T[:, :3, :3] = lie.so3_exp(turn[:, None] * np.array([0, 0, 1.0])) @ R
        T[:, 2, 3], T[:, 3, 3] = slide, 1
        return T

    def nearest(self, T_object_tool: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """The member that is nearest to a pose (rotation and place each for itself)."""
        relative = T_object_tool[:3, :3] @ self.members(np.zeros(1), np.zeros(1))[0, :3, :3].T
        # swing-twist: the turn about z that leaves the least rotation
        turn = np.arctan2(relative[1, 0] - relative[0, 1], relative[0, 0] + relative[1, 1])
        turn = np.clip(turn, -self.turn, self.turn)
        slide = np.clip(T_object_tool[2, 3], -self.slide_m, self.slide_m)
        return np.asarray(self.members(np.array([turn]), np.array([slide]))[0])


def grasp_families(handle: Handle, robot: Platform) -> list[GraspFamily]:
    """All families of feasible grasps. Raises InfeasibleError if the gripper does not open widely enough."""
    across = 2 * handle.radius_m + _CLEARANCE_M
    if across > robot.opening_m:
        raise InfeasibleError(
            f"no grasp: the handle is {200 * handle.radius_m:.1f} cm across, and the gripper of {robot.name} opens "
            f"{100 * robot.opening_m:.1f} cm, of which {100 * _CLEARANCE_M:.1f} cm are needed for clearance"
        )
    slide = max(0.0, handle.length_m / 2 - _END_M)
    families = [GraspFamily(roll, _TURN, slide) for roll in (0.0, np.pi)]
    if handle.length_m + _CLEARANCE_M <= robot.opening_m:
        families += [GraspFamily(roll, 0.0, 0.0) for roll in (-np.pi / 2, np.pi / 2)]
    return families


def grasp_candidates(handle: Handle, robot: Platform, turns: int = 7, slides: int = 3) -> Float[np.ndarray, "k 4 4"]:
    """T_object_tool (k, 4, 4): samples of every family. Raises InfeasibleError as `grasp_families`."""
    samples = []
    for family in grasp_families(handle, robot):
        turn = np.linspace(-family.turn, family.turn, turns if family.turn else 1)
        slide = np.linspace(-family.slide_m, family.slide_m, slides if family.slide_m else 1)
        grid = np.meshgrid(turn, slide, indexing="ij")
        samples.append(family.members(grid[0].ravel(), grid[1].ravel()))
    return np.concatenate(samples)


def distance(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " n"]:
    """Metres between poses; a radian counts as 0.3 m."""
    angle = np.linalg.norm(lie.so3_log(a[:3, :3].T @ b[:, :3, :3]), axis=1)
    return np.asarray(np.hypot(np.linalg.norm(b[:, :3, 3] - a[:3, 3], axis=1), _RADIUS_M * angle))


def common_handle(handles: Sequence[Handle]) -> Handle:
    """The handle that a grasp must suit to suit all: the shortest bar, the thickest, the nearest to its front."""
    return Handle(
        min(h.length_m for h in handles), max(h.radius_m for h in handles), min(h.standoff_m for h in handles)
    )


def turned(
    family: GraspFamily, grasp: Float[np.ndarray, "4 4"], hands: Float[np.ndarray, "d 4 4"]
) -> list[Float[np.ndarray, "4 4"]]:
    """Grasps of a family turned about the bar as far as it allows, at the place of a chosen one; nearest first."""
    if not family.turn:
        return []
    turns = family.members(np.linspace(-1, 1, _TURNS) * family.turn, np.full(_TURNS, grasp[2, 3]))
    cost = _summed(turns, hands if len(hands) else grasp[None])
    return [turns[i] for i in np.argsort(cost, kind="stable")]


def _summed(members: Float[np.ndarray, "n 4 4"], hands: Float[np.ndarray, "d 4 4"]) -> Float[np.ndarray, " n"]:
    return np.asarray(np.sum([distance(hand, members) for hand in hands], axis=0))


def ranked(
    handle: Handle, robot: Platform, hands: Float[np.ndarray, "d 4 4"]
) -> list[tuple[GraspFamily, Float[np.ndarray, "4 4"]]]:
    """One grasp per family, nearest to the hands (H X in the object's frame, one per demonstration); best first.

    Nearest in the sum of distances over all demonstrations: one that shows something else does not decide.
    """
    found = []
    for family in grasp_families(handle, robot):
        turn = np.linspace(-family.turn, family.turn, 31 if family.turn else 1)
        slide = np.linspace(-family.slide_m, family.slide_m, 11 if family.slide_m else 1)
        grid = np.meshgrid(turn, slide, indexing="ij")
        members = family.members(grid[0].ravel(), grid[1].ravel())
        cost = _summed(members, hands) if len(hands) else np.abs(grid[0].ravel())
        best = int(np.argmin(cost))
        found.append((float(cost[best]), family, members[best]))
    found.sort(key=lambda item: item[0])
    return [(family, T) for _, family, T in found]
