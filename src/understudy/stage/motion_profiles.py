"""How things go over time: minimum-jerk ramps (Flash and Hogan 1985), and the clock of a demonstration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


def ease(s: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    """Minimum-jerk ramp: 0 for s <= 0, 1 for s >= 1."""
    s = np.clip(s, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s * s))


def ramp(times: Float[np.ndarray, " t"], start: float, end: float) -> Float[np.ndarray, " t"]:
    """Minimum-jerk ramp from 0 at `start` to 1 at `end`."""
    return ease((np.asarray(times, np.float64) - start) / (end - start))


@dataclass(frozen=True)
class Clock:
    """When what happens, seconds from the start."""

    walk: float
    """sets off"""
    reach: float
    """the hand leaves its rest"""
    grasp: float
    """the fingers are closed: the hand holds the handle"""
    move: float
    """the part begins to move"""
    pause: tuple[float, float]
    """from .. to: it stands still for a moment; both at `stop` if not"""
    share: float
    """of the way that is done before the pause"""
    slow: float
    """exponent of the slow start: 1 = minimum jerk"""
    stop: float
    """the part stands still"""
    release: float
    """the fingers open: the hand lets go"""
    leave: float
    """the body sets off again"""
    rest: float
    """arm and body are at rest again"""
    end: float

    def progress(self, times: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
        """Share of the way that the part is open, 0 to 1."""
        pause, again = self.pause
        first = ease(np.clip((times - self.move) / (pause - self.move), 0, 1) ** self.slow)
        if again >= self.stop:
            return first
        return self.share * first + (1 - self.share) * ramp(times, again, self.stop)


def draw_clock(rng: np.random.Generator, approach_m: float, path_m: float, leave_m: float) -> Clock:
    """A demonstration's times. approach_m, leave_m: ways of the body before and after; path_m: way of the handle."""
    walk = rng.uniform(0.4, 0.8)
    arrive = walk + 0.6 + approach_m / rng.uniform(0.55, 0.8)
    reach_s = rng.uniform(0.95, 1.3)
    reach = max(walk + 0.2, arrive - rng.uniform(0.45, 0.75))
    grasp = reach + reach_s
    move = grasp + rng.uniform(0.03, 0.15)
    moving_s = max(1.2, path_m / rng.uniform(0.16, 0.26))
    share, again_s = 1.0, 0.0
    if rng.random() < 0.3 and path_m > 0.3:
        share, again_s = rng.uniform(0.35, 0.65), rng.uniform(0.3, 0.6)
    pause = move + share * moving_s
    again = pause + again_s
    stop = again + (1 - share) * moving_s
    release = stop + rng.uniform(0.03, 0.15)
    leave = release + rng.uniform(0.1, 0.35)
    rest = max(release + rng.uniform(1.0, 1.3), leave + 0.6 + leave_m / rng.uniform(0.6, 0.85))
    return Clock(
        walk,
        reach,
        grasp,
        move,
        (pause, again),
        share,
        rng.uniform(1.0, 1.2),
        stop,
        release,
        leave,
        rest,
        rest + rng.uniform(0.5, 0.9),
    )
