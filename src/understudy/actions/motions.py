"""What an action model is learnt from: motions of a robot (gripper, base, torso) while an object is moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from understudy.demonstration.demonstration import Segments
from understudy.errors import UnderstudyError
from understudy.geometry import is_rigid
from understudy.objects.articulation import Articulation, Handle


@dataclass(frozen=True, eq=False)
class RobotPose:
    """Where a robot is. World frame."""

    T_world_tool: Float[np.ndarray, "4 4"]
    """of the gripper's tool frame"""
    xy_yaw: Float[np.ndarray, "3"]
    """of the base: metres, metres, radians"""
    torso_height: float
    """metres: how far the torso is lifted"""

    def __post_init__(self) -> None:
        if self.T_world_tool.shape != (4, 4) or not is_rigid(self.T_world_tool):
            raise UnderstudyError("robot pose: T_world_tool must be a rigid 4x4 transform")
        if self.xy_yaw.shape != (3,) or not np.isfinite([*self.xy_yaw, self.torso_height]).all():
            raise UnderstudyError("robot pose: xy_yaw must be 3 finite numbers, torso_height one")


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """One demonstration, adapted to a robot: what the robot would do. World frame (z up, floor at z = 0)."""

    times_s: Float[np.ndarray, " t"]
    """increasing"""
    T_world_tool: Float[np.ndarray, "t 4 4"]
    """the gripper's tool frame"""
    xy_yaw: Float[np.ndarray, "t 3"]
    """of the base: metres, metres, radians"""
    torso_height: Float[np.ndarray, " t"]
    """metres: how far the torso is lifted"""
    T_world_object: Float[np.ndarray, "t 4 4"]
    """the frame of the moving handle; only its position along the articulation is used"""
    articulation: Articulation
    """world"""
    handle: Handle
    segments: Segments

    def __post_init__(self) -> None:
        t = len(self.times_s)
        shapes = {
            "T_world_tool": (t, 4, 4),
            "xy_yaw": (t, 3),
            "torso_height": (t,),
            "T_world_object": (t, 4, 4),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise UnderstudyError(f"motion: {name} must have shape {shape} for {t} times, got {array.shape}")
            if not np.isfinite(array).all():
                raise UnderstudyError(f"motion: {name} must be finite at every sample")
        if t < 2 or not (np.diff(self.times_s) > 0).all():
            raise UnderstudyError("motion: times_s must increase")
        for name in ("T_world_tool", "T_world_object"):
            if not all(is_rigid(T) for T in getattr(self, name)):
                raise UnderstudyError(f"motion: {name} must be rigid 4x4 transforms")
        if not self.segments.release <= t:
            raise UnderstudyError(f"motion: segments end at {self.segments.release}, beyond {t} samples")

    def __len__(self) -> int:
        return len(self.times_s)
