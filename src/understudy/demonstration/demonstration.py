"""What a person showed: trajectories of the acting hand, the torso and the object, and the scene around them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from understudy.errors import UnderstudyError, one_of
from understudy.objects.articulation import Articulation, Handle
from understudy.trajectories import PlanarTrack, PoseTrack

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""Values of `OccupancyMap.state`."""


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """What a robot's base can bump into, seen from above: the static scene, without people and the moving part."""

    state: UInt8[np.ndarray, "rows columns"]
    """UNKNOWN, FREE or OCCUPIED; [i, j] is the cell at y = origin y + i resolution, x = origin x + j resolution"""
    origin_xy: Float[np.ndarray, "2"]
    """world, metres: centre of cell [0, 0]"""
    resolution_m: float


@dataclass(frozen=True)
class Segments:
    """reach = samples [0, grasp), manipulate = [grasp, release), release = [release, t).

    The object moves while it is manipulated (pauses included), and only then: `segments.MOVING` says from which
    speed of the handle on.
    """

    grasp: int
    """first sample of the motion"""
    release: int
    """first sample after it, or, if that is earlier, first one at which the hand has left the object"""

    def __post_init__(self) -> None:
        if not 0 <= self.grasp < self.release:
            raise UnderstudyError(f"segments: needs 0 <= grasp < release, got {self.grasp}, {self.release}")

    def slices(self, t: int) -> dict[str, slice]:
        """By name, for arrays of t samples."""
        return {
            "reach": slice(0, self.grasp),
            "manipulate": slice(self.grasp, self.release),
            "release": slice(self.release, t),
        }


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One demonstration on an even clock. World frame: z up, floor at z = 0, origin below the camera."""

    task: str
    times_s: Float[np.ndarray, " t"]
    """seconds on the recording's clock, evenly spaced"""
    acting: str
    """which hand: left or right"""
    hand: PoseTrack
    """of the acting hand: origin in the middle of the palm, axes as `Palm.R_cam_hand` (z out of the palm, x to the
    fingers)"""
    torso: PlanarTrack
    """below the middle of shoulders and hips; yaw: the way that the chest faces"""
    object: PoseTrack
    """of the moving part: the frame of its handle (`objects.articulation.Handle`)"""
    articulation: Articulation
    handle: Handle
    segments: Segments
    map: OccupancyMap
    scene: Float32[np.ndarray, "n 3"]
    """points of the static scene, thinned out, world"""
    T_world_cam: Float[np.ndarray, "4 4"]
    """of the colour camera"""
    joints: Float[np.ndarray, "t 18 3"]
    """the person's joints, world; NaN where nothing is known"""
    part: Float32[np.ndarray, "m 3"] = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """points of the moving part's surface, as far as it was seen; in the handle's frame"""
    source: dict[str, Any] = field(default_factory=dict)
    """where it is from: recording, methods, version"""

    def __post_init__(self) -> None:
        if self.acting not in ("left", "right"):
            raise UnderstudyError(f"demonstration: acting {self.acting!r} is not {one_of(('left', 'right'))}")
        t = len(self.times_s)
        if not t == len(self.hand) == len(self.torso) == len(self.object) == len(self.joints):
            raise UnderstudyError("demonstration: hand, torso, object and joints must have as many samples as times_s")
        if not self.segments.release <= t:
            raise UnderstudyError(f"demonstration: segments end at {self.segments.release}, beyond {t} samples")

    def __len__(self) -> int:
        return len(self.times_s)
