"""Poses over time on one clock. World frame: z up, the floor at z = 0 (CONVENTIONS.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """A rigid thing's pose at t moments.

    What was not measured is never passed off as measured: `observed` and `oriented` say what was. Poses between
    measurements may be filled in, with the covariance that this deserves.
    """

    T_world_x: Float[np.ndarray, "t 4 4"]
    """NaN where nothing is known"""
    covariance: Float[np.ndarray, "t 6 6"]
    """of (dp, dr), metres and radians, along the world's axes: p_true = p + dp, R_true = Exp(dr) R"""
    observed: Bool[np.ndarray, " t"]
    """the position was measured"""
    oriented: Bool[np.ndarray, " t"]
    """the rotation was measured"""

    def __post_init__(self) -> None:
        t = len(self.T_world_x)
        shapes = (self.T_world_x.shape, self.covariance.shape, self.observed.shape, self.oriented.shape)
        if shapes != ((t, 4, 4), (t, 6, 6), (t,), (t,)):
            raise UnderstudyError(f"a pose track needs arrays (t, 4, 4), (t, 6, 6), (t,), (t,), got {shapes}")

    def __len__(self) -> int:
        return len(self.T_world_x)

    @property
    def known(self) -> Bool[np.ndarray, " t"]:
        """Where there is a pose, measured or filled in."""
        return np.isfinite(self.T_world_x).all(axis=(1, 2))

    @property
    def positions(self) -> Float[np.ndarray, "t 3"]:
        """Metres, world."""
        return self.T_world_x[:, :3, 3]


@dataclass(frozen=True, eq=False)
class PlanarTrack:
    """Where something stands on the floor, and which way it faces, at t moments."""

    xy_yaw: Float[np.ndarray, "t 3"]
    """metres, metres, radians (from the world's x towards y; unwrapped); NaN where nothing is known"""
    covariance: Float[np.ndarray, "t 3 3"]
    observed: Bool[np.ndarray, " t"]

    def __post_init__(self) -> None:
        t = len(self.xy_yaw)
        shapes = (self.xy_yaw.shape, self.covariance.shape, self.observed.shape)
        if shapes != ((t, 3), (t, 3, 3), (t,)):
            raise UnderstudyError(f"a planar track needs arrays (t, 3), (t, 3, 3), (t,), got {shapes}")

    def __len__(self) -> int:
        return len(self.xy_yaw)

    @property
    def known(self) -> Bool[np.ndarray, " t"]:
        """Where there is a pose, measured or filled in."""
        return np.isfinite(self.xy_yaw).all(axis=1)
