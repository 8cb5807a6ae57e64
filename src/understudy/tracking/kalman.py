"""Many points at once through a Kalman filter and a Rauch-Tung-Striebel smoother.

Each point moves with Singer's acceleration (R. Singer, IEEE T-AES 1970, eq. 5): white jerk whose acceleration forgets
itself, so that a steady motion goes on in a gap and a swing does not. The measurements' error has a white part and a
part that stays for a while (a first-order Gauss-Markov process): a network's errors do stay, and a filter that takes
them for white believes that averaging removes them. State per axis: position, velocity, acceleration, standardised
bias. x, y and z share their covariance, because sigmas are those of balls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

K: Final = 4
"""numbers of a state along one axis"""
_DIFFUSE: Final = (100.0, 10.0, 30.0)
"""sigmas of a track's first position, velocity and acceleration; metres and seconds"""


@dataclass(frozen=True)
class Model:
    """How points move and how measurements err. Numbers: measured on simulated recordings (docs/tracking.md)."""

    maneuver_s: float = 0.1
    """time in which an acceleration forgets itself"""
    bias_share: float = 0.35
    """of the measurements' variance that is bias"""
    bias_s: float = 0.7
    """time in which the bias forgets itself"""
    constant_share: float = 0.35
    """of the measurements' variance that never changes: no filter can see it, it only adds to the uncertainty"""

    def steps(self, dt_s: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n 4 4"], np.ndarray, np.ndarray]:
        """Transitions F over n intervals and the noise Q = q * first + second, each (n, 4, 4); q in m^2/s^5."""
        tau, u = self.maneuver_s, dt_s / self.maneuver_s
        e, stay = np.exp(-u), np.exp(-dt_s / self.bias_s)
        F = np.tile(np.eye(K), (len(dt_s), 1, 1))
        F[:, 0, 1], F[:, 0, 2], F[:, 1, 2] = dt_s, tau**2 * (u - 1 + e), tau * (1 - e)
        F[:, 2, 2], F[:, 3, 3] = e, stay
        # the integral of f f' over the interval, f being what jerk does to position, velocity and acceleration
        half = (1 - e**2) / 2
        motion, bias = np.zeros_like(F), np.zeros_like(F)
        motion[:, 0, 0] = tau**5 * (u**3 / 3 - u**2 + u - 2 * u * e + half)
        motion[:, 0, 1] = motion[:, 1, 0] = tau**4 * (u**2 / 2 - u + 1 - e + u * e - half)
        motion[:, 0, 2] = motion[:, 2, 0] = tau**3 * (half - u * e)
        motion[:, 1, 1] = tau**3 * (u - 2 * (1 - e) + half)
        motion[:, 1, 2] = motion[:, 2, 1] = tau**2 * (1 - e - half)
        motion[:, 2, 2] = tau * half
        bias[:, 3, 3] = 1 - stay**2
        return F, motion, bias


@dataclass(frozen=True, eq=False)
class State:
    """Of b points."""

    x: Float[np.ndarray, "b 4 3"]
    """position, velocity, acceleration, bias in sigmas of the measurement; along x, y, z"""
    P: Float[np.ndarray, "b 4 4"]
    """covariance, the same along each axis"""


def diffuse(b: int) -> State:
    """Of b points of which nothing is known, but that they are in a building and not bullets."""
    return State(np.zeros((b, K, 3)), np.tile(np.diag([*np.square(_DIFFUSE), 1.0]), (b, 1, 1)))


@dataclass(frozen=True, eq=False)
class Measured:
    """Positions of b points at t moments."""

    y: Float[np.ndarray, "t b 3"]
    """metres; anything finite where there is no measurement"""
    s: Float[np.ndarray, "t b"]
    """sigma along each axis, metres, above 0"""
    seen: Bool[np.ndarray, "t b"]
    active: Bool[np.ndarray, "t b"]
    """False long before a point is seen first: time stands still there, so that no covariance grows huge"""

    def points(self, part: slice) -> Measured:
        """Some of the points."""
        return Measured(self.y[:, part], self.s[:, part], self.seen[:, part], self.active[:, part])

    def rows(self, model: Model) -> tuple[Float[np.ndarray, "t b 4"], Float[np.ndarray, "t b"]]:
        """h and R of each measurement y = h x + white noise of variance R."""
        h = np.zeros((*self.s.shape, K))
        h[..., 0], h[..., 3] = 1.0, np.sqrt(model.bias_share) * self.s
        return h, (1 - model.bias_share - model.constant_share) * self.s**2


@dataclass(frozen=True, eq=False)
class Filtered:
    """What a pass forwards leaves behind."""

    x: Float[np.ndarray, "t b 4 3"]
    P: Float[np.ndarray, "t b 4 4"]
    x_before: Float[np.ndarray, "t b 4 3"]
    """predicted, before the measurement"""
    P_before: Float[np.ndarray, "t b 4 4"]
    F: Float[np.ndarray, "t 4 4"]
    """from the moment before"""
    active: Bool[np.ndarray, "t b"]

    @property
    def last(self) -> State:
        """After all measurements."""
        return State(self.x[-1], self.P[-1])


def forward(
    measured: Measured,
    model: Model,
    dt_s: Float[np.ndarray, " t"],
    q: Float[np.ndarray, " b"],
    weight: Float[np.ndarray, "t b"],
    start: State,
) -> Filtered:
    """Kalman filter. dt_s: since the moment before, for the first one since `start`. weight: R is divided by it."""
    F, Q_motion, Q_bias = model.steps(dt_s)
    h, R = measured.rows(model)
    w = np.where(measured.seen, weight, 0.0)
    t, b = w.shape
    xs, x_before = np.empty((t, b, K, 3)), np.empty((t, b, K, 3))
    Ps, P_before = np.empty((t, b, K, K)), np.empty((t, b, K, K))
    x, P = start.x, start.P
    for k in range(t):
        on = measured.active[k][:, None, None]
        x = np.where(on, F[k] @ x, x)
        P = np.where(on, F[k] @ P @ F[k].T + q[:, None, None] * Q_motion[k] + Q_bias[k], P)
        x_before[k], P_before[k] = x, P
        hk = h[k]
        Ph = (P @ hk[:, :, None])[:, :, 0]
        gain = Ph * (w[k] / (w[k] * (hk * Ph).sum(1) + R[k]))[:, None]
        x = x + gain[:, :, None] * (measured.y[k] - (hk[:, None] @ x)[:, 0])[:, None]
        P = P - gain[:, :, None] * Ph[:, None]
        xs[k], Ps[k] = x, P
    return Filtered(xs, Ps, x_before, P_before, F, measured.active)


def backward(filtered: Filtered) -> tuple[Float[np.ndarray, "t b 4 3"], Float[np.ndarray, "t b 4 4"]]:
    """Rauch-Tung-Striebel smoother: states and covariances given all measurements."""
    x, P = filtered.x.copy(), filtered.P.copy()
    t = len(x)
    ahead = filtered.F[1:, None] @ filtered.P[:-1]
    C = np.linalg.solve(filtered.P_before[1:], ahead).swapaxes(2, 3)
    C = np.where(filtered.active[1:, :, None, None], C, np.eye(K))
    for k in range(t - 2, -1, -1):
        x[k] += C[k] @ (x[k + 1] - filtered.x_before[k + 1])
        P[k] += C[k] @ (P[k + 1] - filtered.P_before[k + 1]) @ C[k].swapaxes(1, 2)
    return x, P
