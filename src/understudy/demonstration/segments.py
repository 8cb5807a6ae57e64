"""reach, manipulate, release: from how the object moves, and from where the hand is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float

from understudy.demonstration.demonstration import Segments
from understudy.errors import UnderstudyError

MOVING: Final = 0.02
"""m/s of the handle along its way: slower is standing still"""
_SURE = 0.06  # m/s: a motion that never gets so fast is noise
_LEAST_WAY = 0.03  # metres: shorter motions are noise, too
_LEFT = 0.20  # metres from the grip (more than while it was held): the hand has left
_WINDOW_S = 0.12  # sigma of the window in which speeds are measured
_BACK_S = 0.6  # a pause at which the hand left for longer than this ends the manipulation


@dataclass(frozen=True, eq=False)
class Motion:
    """How far the handle has gone along its way, and how fast; t moments."""

    way_m: Float[np.ndarray, " t"]
    speed: Float[np.ndarray, " t"]
    """m/s, with its sign"""


def find_segments(
    times_s: Float[np.ndarray, " t"],
    way_m: Float[np.ndarray, " t"],
    hand_distance: Float[np.ndarray, " t"] | None = None,
    sigma_m: Float[np.ndarray, " t"] | None = None,
) -> Segments:
    """Where the manipulation begins and ends.

    way_m: how far the handle has moved along its way from rest (radians times radius for a door), metres; NaN where
    that is not known. hand_distance: of the hand from the handle, metres; NaN where the hand is not seen: it then
    decides nothing. sigma_m: of `way_m`.
    The manipulation is the motion with the longest way, extended to both sides for as long as the handle is faster
    than MOVING, and joined with others over pauses in which the hand stays. A part that swings on after the hand has
    left is no longer manipulated. Raises UnderstudyError when nothing moves.
    """
    motion = measure_motion(times_s, way_m, sigma_m)
    runs = _runs(motion)
    if not runs:
        raise UnderstudyError(
            f"the object does not move: its handle goes {np.nanmax(way_m) - np.nanmin(way_m):.3f} m at most, never "
            f"faster than {np.abs(motion.speed).max():.3f} m/s"
            if np.isfinite(way_m).any()
            else "the object was never seen"
        )
    away = _away(times_s, runs, hand_distance)
    first, last = max(runs, key=lambda run: abs(motion.way_m[run[1]] - motion.way_m[run[0]]))
    for begin, end in runs:  # joined over pauses, if the hand stayed
        between = slice(end, first) if end < first else slice(last, begin)
        if not away[between].any():
            first, last = min(first, begin), max(last, end)
    left = np.flatnonzero(away[first + 1 : last + 1])
    release = first + 1 + int(left[0]) if len(left) else last + 1
    return Segments(first, min(release, len(times_s)))


def measure_motion(
    times_s: Float[np.ndarray, " t"], way_m: Float[np.ndarray, " t"], sigma_m: Float[np.ndarray, " t"] | None = None
) -> Motion:
    """Way and speed at every moment, from a straight line through the neighbouring measurements (Gaussian window)."""
    known = np.flatnonzero(np.isfinite(way_m))
    if not len(known):
        return Motion(np.zeros(len(times_s)), np.zeros(len(times_s)))
    y, times = way_m[known], times_s[known]
    weight = np.ones(len(known)) if sigma_m is None else 1 / np.maximum(sigma_m[known], 1e-3) ** 2
    step = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.1
    width = max(_WINDOW_S, 0.8 * step)
    lag = (times - times_s[:, None]) / width
    w = np.exp(-0.5 * lag**2) * weight + 1e-12 * np.exp(-np.abs(lag) / 50)
    total = w.sum(axis=1, keepdims=True)
    x0, y0 = (w * lag).sum(axis=1, keepdims=True) / total, (w * y).sum(axis=1, keepdims=True) / total
    dx = lag - x0
    slope = (w * dx * (y - y0)).sum(axis=1) / ((w * dx**2).sum(axis=1) + 1e-3 * total[:, 0])
    return Motion((y0[:, 0] - slope * x0[:, 0]), slope / width)


def _runs(motion: Motion) -> list[tuple[int, int]]:
    """First and last sample of each motion worth the name, with hysteresis."""
    fast = np.abs(motion.speed) > MOVING
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fast.astype(int), [0]])))
    runs = [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]
    return [
        (a, b)
        for a, b in runs
        if np.abs(motion.speed[a : b + 1]).max() > _SURE and np.ptp(motion.way_m[max(a - 1, 0) : b + 2]) > _LEAST_WAY
    ]


def _away(
    times_s: Float[np.ndarray, " t"], runs: list[tuple[int, int]], distance: Float[np.ndarray, " t"] | None
) -> Bool[np.ndarray, " t"]:
    """Where the hand has surely left the object: farther from it than while it moved it, and not for a moment only."""
    if distance is None:
        return np.zeros(len(times_s), bool)
    moving = np.concatenate([np.arange(a, b + 1) for a, b in runs])
    held = distance[moving][np.isfinite(distance[moving])]
    if not len(held):
        return np.zeros(len(times_s), bool)
    seen = np.isfinite(distance)
    away = np.zeros(len(times_s), bool)
    away[seen] = distance[seen] > np.percentile(held, 30) + _LEFT
    known = np.flatnonzero(seen)
    for run in np.split(known, np.flatnonzero(np.diff(away[known].astype(int))) + 1):
        if len(run) and away[run[0]] and times_s[run[-1]] - times_s[run[0]] < _BACK_S and run[-1] != known[-1]:
            away[run] = False
    return away
