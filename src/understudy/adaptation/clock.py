"""How fast a robot may go along a trajectory: limits of gripper, base, torso and arm, and a clock that keeps them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from understudy import lie
from understudy.adaptation.platform import JointPath, Platform
from understudy.adaptation.weights import Limits

_JUST: Final = 1.01  # slower than must be, so that it ends
_AROUND: Final = 5  # steps that slow down together: a sudden change of speed is an acceleration, too
_ROUNDS: Final = 80
_UNLIMITED: Final = np.inf


@dataclass(frozen=True, eq=False)
class Motion:
    """What moves from sample to sample, and how fast it may: n steps of k quantities."""

    steps: Float[np.ndarray, "n k"]
    velocity: Float[np.ndarray, " k"]
    """greatest, per second"""
    acceleration: Float[np.ndarray, " k"]

    def shares(self, dt: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
        """Velocity at each step and acceleration between steps (m = n - 1) over their limits: the greatest share."""
        v = self.steps / dt[:, None]
        a = np.diff(v, axis=0) / (0.5 * (dt[:-1] + dt[1:]))[:, None]
        return _greatest(v, self.velocity), _greatest(a, self.acceleration)


def _greatest(x: Float[np.ndarray, "n k"], limit: Float[np.ndarray, " k"]) -> Float[np.ndarray, " n"]:
    return np.asarray((np.abs(x) / limit).max(axis=1, initial=0.0))


def joined(*parts: Motion) -> Motion:
    """All quantities together."""
    return Motion(
        np.concatenate([p.steps for p in parts], axis=1),
        np.concatenate([p.velocity for p in parts]),
        np.concatenate([p.acceleration for p in parts]),
    )


def base_motion(
    platform: Platform, base: Float[np.ndarray, "t 3"], torso: Float[np.ndarray, " t"], share: float = 1.0
) -> Motion:
    """Of base (its own frame) and torso. share: of the limits that may be used."""
    moved = lie.se2_log(lie.se2_compose(lie.se2_inverse(base[:-1]), base[1:]))
    return Motion(
        np.column_stack([moved, np.diff(torso)]),
        share * np.append(platform.base_velocity, platform.torso_velocity),
        share * np.append(platform.base_acceleration, _UNLIMITED),
    )


def gripper_motion(limits: Limits, T: Float[np.ndarray, "t 4 4"], share: float = 1.0) -> Motion:
    """Of the gripper: way and turn."""
    moved = lie.se3_log(lie.se3_inverse(T[:-1]) @ T[1:])
    steps = np.column_stack([np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)])
    return Motion(steps, share * np.array([limits.speed, limits.turning]), np.full(2, _UNLIMITED))


def arm_motion(platform: Platform, path: JointPath, share: float = 1.0) -> Motion:
    """Of the joints; steps at which the path is not linked do not count."""
    assert platform.arm is not None
    steps = np.where(path.linked[:, None], np.diff(path.q, axis=0), 0.0)
    return Motion(steps, share * platform.arm.velocity, share * platform.arm.acceleration)


def retimed(motion: Motion, times_s: Float[np.ndarray, " t"], slowest: float) -> Float[np.ndarray, " t"]:
    """Times at which all limits are kept: slower around the steps that are too fast, nowhere faster.

    slowest: times the clock that no step gets slower than, limits or not.
    """
    first = np.diff(times_s)
    dt = first.copy()
    for _ in range(_ROUNDS):
        speed, change = motion.shares(dt)
        need = speed.copy()
        root = np.sqrt(change)
        need[1:], need[:-1] = np.maximum(need[1:], root), np.maximum(need[:-1], root)
        if need.max(initial=0.0) <= 1:
            break
        slower = maximum_filter1d(np.where(need > 1, _JUST * need, 1.0), _AROUND, mode="nearest")
        dt = np.minimum(dt * uniform_filter1d(slower, _AROUND, mode="nearest"), slowest * first)
    return times_s if (dt == first).all() else times_s[0] + np.concatenate([[0.0], np.cumsum(dt)])
