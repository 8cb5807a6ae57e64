"""People while the camera runs: a filter, or a smoother that looks a few frames ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Float

from understudy.errors import UnderstudyError
from understudy.skeleton import N_JOINTS
from understudy.tracking import bones
from understudy.tracking.identities import IdentityTracker
from understudy.tracking.kalman import Model
from understudy.tracking.measured import measure
from understudy.tracking.robust import Past, smooth_points
from understudy.tracking.smoother import REACH_S, Joints, PersonTrack, by_id, independent_moments
from understudy.types import Keypoints2D, Person

_REMEMBERED: Final = 300
"""frames of which bone lengths are kept"""


@dataclass(frozen=True, eq=False)
class TrackedPeople:
    """The people of one moment."""

    time_s: float
    people: list[Person]
    """by id; who was not detected at this moment, but shortly before or after, has no 2D keypoints and no hands"""


@dataclass(eq=False)
class _Known:
    """What is left of the frames of one person that have left the window."""

    past: Past = field(default_factory=lambda: Past.none(N_JOINTS))
    last_s: Float[np.ndarray, "18"] = field(default_factory=lambda: np.full(N_JOINTS, -np.inf))
    """when each joint was observed last"""
    begin_s: float | None = None
    bones: deque[tuple[np.ndarray, np.ndarray]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    """lengths and variances"""


class LiveTracker:
    """Persistent ids and smoothed joints of a stream: a fixed-lag smoother, the same mathematics as `smooth`.

    lag_frames: how many frames it looks ahead; 0 is a filter. The more, the steadier. With a lag as long as the
    recording, the result is that of `smooth`.
    """

    def __init__(self, lag_frames: int = 3, model: Model | None = None, reach_s: float = REACH_S) -> None:
        if lag_frames < 0:
            raise UnderstudyError(f"lag_frames must be 0 or more, got {lag_frames}")
        if not (np.isfinite(reach_s) and reach_s >= 0):
            raise UnderstudyError(f"reach_s must be 0 or more, got {reach_s}")
        self.lag_frames, self.reach_s, self.model = lag_frames, reach_s, model or Model()
        self._tracker = IdentityTracker()
        self._times: list[float] = []
        self._frames: list[dict[int, Person]] = []
        self._known: dict[int, _Known] = {}
        self._left_s: float | None = None
        self._window: dict[int, tuple[Joints, Past]] = {}

    def update(self, time_s: float, people: Sequence[Person]) -> TrackedPeople | None:
        """Takes the people of a new frame; gives those of `lag_frames` frames ago, None while there were not so many.

        time_s: seconds, later than before. Raises UnderstudyError if not.
        """
        previous = self._times[-1] if self._times else self._left_s
        if not np.isfinite(time_s) or (previous is not None and time_s <= previous):
            raise UnderstudyError(f"time_s must increase, got {time_s} after {previous}")
        self._times.append(float(time_s))
        self._frames.append(by_id(self._tracker.update(people, float(time_s)), 0))
        if len(self._times) <= self.lag_frames:
            return None
        tracks, time = self._smooth(), self._times[0]
        out = [_person(t, 0, self._frames[0].get(t.id)) for t in tracks if t.times_s[0] == time]
        self._leave()
        return TrackedPeople(time, [p for p in out if p is not None])

    def flush(self) -> list[TrackedPeople]:
        """The frames that are still inside, at the end of a stream; nothing is inside afterwards."""
        if not self._times:
            return []
        tracks, out = self._smooth(), []
        for time, frame in zip(self._times, self._frames, strict=True):
            people = [
                _person(t, int(np.flatnonzero(t.times_s == time)[0]), frame.get(t.id))
                for t in tracks
                if self._there(t.id, time)
            ]
            out.append(TrackedPeople(time, [p for p in people if p is not None]))
        self._left_s, self._times, self._frames = self._times[-1], [], []
        self._known = {}
        return out

    def _there(self, id: int, time: float) -> bool:
        """Whether the time lies between two sightings of a person; the earlier one may have left the window."""
        seen = [t for t, frame in zip(self._times, self._frames, strict=True) if id in frame]
        return bool(seen) and (id in self._known or seen[0] <= time) and time <= seen[-1]

    def _smooth(self) -> list[PersonTrack]:
        """Everybody who may be seen in the window; keeps what `_leave` needs."""
        ids = sorted(set(self._known).union(*self._frames))
        self._window = {}
        if not ids:
            return []
        times = np.array(self._times)
        known = [self._known.get(id, _Known()) for id in ids]
        last_s = np.concatenate([k.last_s for k in known])
        measured, source = measure(self._frames, ids, times, np.isfinite(last_s), self.reach_s)
        dt = np.diff(times, prepend=times[0] if self._left_s is None else self._left_s)
        smoothed = smooth_points(measured, self.model, dt, Past.join([k.past for k in known]))
        tracks = []
        for i, (id, k, past) in enumerate(zip(ids, known, smoothed.past.split(N_JOINTS), strict=True)):
            there = [n for n, frame in enumerate(self._frames) if id in frame]
            rows = slice(0 if id in self._known else there[0], len(times))
            part = (rows, slice(N_JOINTS * i, N_JOINTS * (i + 1)))
            joints = Joints.of(times[rows], measured, smoothed, part, source, k.last_s, self.reach_s)
            self._window[id] = joints, past
            if np.isfinite(joints.variance).any():
                tracks.append(joints.track(id, *self._bones(k, joints)))
        return tracks

    def _bones(self, known: _Known, joints: Joints) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lengths and sigmas from all that is remembered and what is in the window."""
        length, variance = joints.bones()
        old = list(known.bones)
        if old:
            length = np.concatenate([np.stack([b[0] for b in old]), length])
            variance = np.concatenate([np.stack([b[1] for b in old]), variance])
        seen = joints.times_s[joints.observed.any(axis=1)]
        begin = joints.times_s[0] if known.begin_s is None else known.begin_s
        seconds = float(seen[-1] - begin) if len(seen) else float(joints.times_s[0] - begin)
        return bones.learn(length, variance, independent_moments(seconds, self.model))

    def _leave(self) -> None:
        """Forgets the first moment of the window, but for what later ones need."""
        time = self._times[0]
        for id, (joints, past) in self._window.items():
            if joints.times_s[0] != time:
                continue
            known = self._known.setdefault(id, _Known(begin_s=time))
            known.past = past
            known.last_s = np.where(joints.observed[0], time, known.last_s)
            if joints.observed[0].any():
                length, variance = joints.bones()
                known.bones.append((length[0], variance[0]))
        for id in set(self._known) - self._tracker.remembered:
            del self._known[id]
        self._left_s = time
        del self._times[0], self._frames[0]


def _person(track: PersonTrack, k: int, seen: Person | None) -> Person | None:
    """The person at the k-th moment; None without any joint."""
    if not np.isfinite(track.sigma_m[k]).any():
        return None
    keypoints_2d = Keypoints2D.where(np.zeros((N_JOINTS, 2)), np.zeros(N_JOINTS)) if seen is None else seen.keypoints_2d
    person = Person(
        keypoints_2d,
        track.keypoints[k],
        track.confidence[k],
        track.sigma_m[k],
        tuple(str(s) for s in track.source[k]),
        track.id,
    )
    return person if seen is None else replace(person, hands=seen.hands)
