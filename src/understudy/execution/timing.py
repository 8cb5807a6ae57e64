"""Time scaling: a path of joints is run through as fast as wanted, but never faster than velocities and accelerations
allow.

Along a path x(s) with speed u = ds/dt: velocity x' u, acceleration x'' u^2 + x' du/dt. Half of each acceleration limit
is given to either term; then u^2 is bounded at every s, and so is its slope (2 du/dt): a pass forwards and one back
find the greatest u (Bobrow, Dubowsky, Gibson 1985, in this conservative form).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from understudy.errors import UnderstudyError

_FINE: Final = 8  # points per sample of the path
_SHARE: Final = 0.95  # of the limits that is used


@dataclass(frozen=True, eq=False)
class Timed:
    """A path over time. `at` may be asked for any time; before and after the path it stands still."""

    path: CubicSpline
    times_s: Float[np.ndarray, " n"]
    s: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]
    """ds/dt"""

    @property
    def duration_s(self) -> float:
        """Of the whole."""
        return float(self.times_s[-1])

    def at(self, times_s: Float[np.ndarray, " t"]) -> tuple[Float[np.ndarray, "t k"], Float[np.ndarray, "t k"]]:
        """Positions and velocities."""
        t = np.clip(times_s, 0, self.duration_s)
        i = np.clip(np.searchsorted(self.times_s, t, side="right") - 1, 0, len(self.s) - 2)
        dt = np.maximum(self.times_s[i + 1] - self.times_s[i], 1e-12)
        since = t - self.times_s[i]
        slope = (self.speed[i + 1] - self.speed[i]) / dt  # constant between neighbours
        s = self.s[i] + self.speed[i] * since + 0.5 * slope * since**2
        u = np.where((times_s <= 0) | (times_s >= self.duration_s), 0.0, self.speed[i] + slope * since)
        return self.path(s), self.path(s, 1) * u[:, None]

    def time_of(self, s: float) -> float:
        """When the path is at s."""
        return float(np.interp(s, self.s, self.times_s))

    def s_at(self, time_s: float) -> float:
        """The path's parameter at a time."""
        return float(np.interp(time_s, self.times_s, self.s))


def time_scaled(
    s: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "n k"],
    velocity: Float[np.ndarray, " k"],
    acceleration: Float[np.ndarray, " k"],
    stops: Float[np.ndarray, " m"],
) -> Timed:
    """Runs a path x(s) through, s in the seconds of the plan: no faster than planned, at rest at both ends and at
    `stops`. Raises UnderstudyError for limits that are not positive or s that does not increase.
    """
    if (np.diff(s) <= 0).any() or not (velocity > 0).all() or not (acceleration > 0).all():
        raise UnderstudyError("time scaling: s must increase, limits must be positive")
    path = CubicSpline(s, x, bc_type="clamped")
    fine = np.unique(
        np.concatenate([np.linspace(s[0], s[-1], _FINE * len(s)), stops[(stops > s[0]) & (stops < s[-1])]])
    )
    slope, bend = np.abs(path(fine, 1)), np.abs(path(fine, 2))
    v, a = _SHARE * velocity, _SHARE * acceleration / 2
    tiny = 1e-9
    top = np.minimum(1.0, (v / (slope + tiny)).min(axis=1)) ** 2
    top = np.minimum(top, (a / (bend + tiny)).min(axis=1))
    top = np.minimum(top, np.minimum(np.append(top[1:], 1.0), np.append(1.0, top[:-1])))  # also between the points
    top[[0, -1]] = 0.0
    top[np.isin(fine, stops)] = 0.0
    gain = 2 * (a / (slope + tiny)).min(axis=1)
    gain = np.minimum(gain, 20.0)
    step = np.diff(fine)
    gains = np.minimum(gain[1:], gain[:-1]) * step
    square = top.copy()
    for i in range(1, len(square)):
        square[i] = min(square[i], square[i - 1] + gains[i - 1])
    for i in range(len(square) - 2, -1, -1):
        square[i] = min(square[i], square[i + 1] + gains[i])
    u = np.sqrt(square)
    dt = 2 * step / (u[1:] + u[:-1])
    return Timed(path, np.concatenate([[0.0], np.cumsum(dt)]), fine, u)
