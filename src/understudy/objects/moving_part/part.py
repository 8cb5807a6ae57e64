"""What is known about the part that moves, before and after it was looked for."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from understudy.errors import UnderstudyError
from understudy.objects.articulation import Articulation, Handle
from understudy.trajectories import PoseTrack


@dataclass(frozen=True, eq=False)
class HandHint:
    """Where the acting hand was, as the skeleton tells. World frame."""

    times_s: Float[np.ndarray, " t"]
    positions: Float[np.ndarray, "t 3"]
    """mid-palm, metres; NaN where missing; errors of 5 cm are usual, of 12 cm happen"""
    sigma_m: Float[np.ndarray, " t"]
    """one sigma of the position; NaN where missing"""

    def __post_init__(self) -> None:
        t = len(self.times_s)
        if self.positions.shape != (t, 3) or self.sigma_m.shape != (t,):
            raise UnderstudyError(
                f"hand hint: {t} times need positions ({t}, 3) and sigma_m ({t},), "
                f"got {self.positions.shape}, {self.sigma_m.shape}"
            )
        if t < 2 or not (np.diff(self.times_s) > 0).all():
            raise UnderstudyError("hand hint: times_s must be 2 or more and increase")


@dataclass(frozen=True)
class MovingPartConfig:
    """Settings of `find_moving_part`."""

    search_frames: int = 14
    """frames on which hypotheses are tried"""
    tried: int = 6
    """hypotheses that are tracked through the recording"""
    refined: int = 3
    """hypotheses that are refined"""
    points: int = 500
    """of the part, for its final track"""
    least_way_m: float = 0.03
    """of the handle: what moves less did not move"""
    least_moving_s: float = 0.4
    """nothing is opened in less time"""
    least_evidence_m2: float = 0.002
    """area that the motion must explain better than rest does"""


@dataclass(frozen=True, eq=False)
class MovingPart:
    """What moved, and how."""

    track: PoseTrack
    """of the handle's frame, world"""
    articulation: Articulation
    """world; T_rest is the handle's frame at rest"""
    handle: Handle
    q: Float[np.ndarray, " t"]
    """radians or metres; filled in where `track` says not observed"""
    sigma_q: Float[np.ndarray, " t"]
    moving: tuple[int, int]
    """first and last sample of the motion; (0, 0) if nothing moves"""
    part_points: Float[np.ndarray, "n 3"]
    """visible points of the part before the motion, in the handle's frame, metres"""
    quality: dict[str, float] = field(default_factory=dict)
    """agreement (mean over observed frames: 1 = every point is where it should be), evidence_m2, runner_up_m2 (of the
    best hypothesis of another kind of motion), hand_spread_m, handle_seen"""
