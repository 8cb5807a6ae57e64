"""Unknowns and data of the adaptation graph, stacked over the demonstrations of one task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from understudy import lie
from understudy.adaptation.fields import DistanceField
from understudy.demonstration.demonstration import OccupancyMap

GRIPPER, BASE, TORSO = slice(0, 6), slice(6, 9), slice(9, 10)
"""Columns among a step's unknowns."""
_MIRROR: Final = np.array([1.0, -1.0, 1.0, 1.0])
_MIRROR_TANGENT: Final = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])  # of translations; rotations are pseudovectors


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns."""

    gripper: Float[np.ndarray, "n 4 4"]
    base: Float[np.ndarray, "n 3"]
    torso: Float[np.ndarray, " n"]
    grasp: Float[np.ndarray, "4 4"]
    """T_object_tool, shared"""

    def retract(self, step: Float[np.ndarray, "n 10"], shared: Float[np.ndarray, "6"]) -> State:
        """The state moved along a tangent step."""
        return State(
            self.gripper @ lie.se3_exp(step[:, GRIPPER]),
            lie.se2_compose(self.base, lie.se2_exp(step[:, BASE])),
            self.torso + step[:, 9],
            self.grasp @ lie.se3_exp(shared),
        )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Fields of one demonstration."""

    steps: slice
    """of the chain"""
    map: OccupancyMap
    obstacles: DistanceField
    """of the map's occupied cells"""
    unknown: DistanceField | None
    scene: DistanceField | None


@dataclass(frozen=True, eq=False)
class Problem:
    """All data of the graph, stacked over the demonstrations of one task; n steps in all."""

    dt: Float[np.ndarray, " n"]
    """to the next step; NaN at each demonstration's last"""
    hand: Float[np.ndarray, "n 4 4"]
    """H X; NaN where there is none"""
    hand_covariance: Float[np.ndarray, "n 6 6"]
    """of H X, in its own tangent space"""
    torso: Float[np.ndarray, "n 3"]
    """P Y; NaN where there is none"""
    torso_covariance: Float[np.ndarray, "n 3 3"]
    object: Float[np.ndarray, "n 4 4"]
    """NaN where it does not matter"""
    holding: Bool[np.ndarray, " n"]
    approaching: Bool[np.ndarray, " n"]
    """just before taking hold or after letting go"""
    grasp_steps: Int[np.ndarray, " d"]
    """where each demonstration takes hold"""
    grasp: Float[np.ndarray, "4 4"]
    """the chosen feasible grasp g_k: T_object_tool"""
    panel: Float[np.ndarray, "n m 2"]
    """the moving part from above; NaN where there is none"""
    surroundings: tuple[Surroundings, ...]
    mirrored: Bool[np.ndarray, " n"]
    """of demonstrations whose part swings to the other side: there the grasp is mirrored in the handle's x-z plane"""

    def grasps(
        self, T_object_tool: Float[np.ndarray, "4 4"], steps: Int[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, "m 4 4"], Float[np.ndarray, "m 6"]]:
        """The grasp at some steps, and by what a tangent step of it is to be multiplied there."""
        mirrored = self.mirrored[steps]
        T = np.where(mirrored[:, None, None], mirror(T_object_tool), T_object_tool)
        return T, np.where(mirrored[:, None], _MIRROR_TANGENT, 1.0)


def mirror(T: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """Reflected in the handle's x-z plane; a gripper that is its own mirror image takes hold with it."""
    return np.asarray(_MIRROR[:, None] * T * _MIRROR)
