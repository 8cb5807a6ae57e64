"""Whole recordings: where each joint was, given everything that was measured before and after.

tracks = understudy.tracking.track(PeopleFile.read(path).frames)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Shaped

from understudy.errors import UnderstudyError
from understudy.people_file import FramePeople
from understudy.skeleton import N_JOINTS
from understudy.tracking import bones
from understudy.tracking.identities import IdentityTracker
from understudy.tracking.kalman import Measured, Model
from understudy.tracking.measured import BALL, confidence_of, measure, within_reach
from understudy.tracking.robust import Past, Smoothed, smooth_points
from understudy.types import INFERRED, MISSING, Person

REACH_S: Final = 1.0
"""seconds from the nearest measurement beyond which a joint has no position"""
_REJECTED: Final = 0.1  # weight below which a measurement does not count as an observation
_PADDING: Final = 2.0  # how much longer than its people's own tracks a group may be


@dataclass(frozen=True, eq=False)
class PersonTrack:
    """One person over t moments, from the first sighting to the last; colour camera's frame."""

    id: int
    times_s: Float[np.ndarray, " t"]
    keypoints: Float[np.ndarray, "t 18 3"]
    """metres; NaN rows where no measurement is near in time"""
    sigma_m: Float[np.ndarray, "t 18"]
    """the ball of this radius holds the truth with 68 %; NaN as `keypoints`"""
    observed: Bool[np.ndarray, "t 18"]
    """a measurement of this moment supports the joint; otherwise it was filled in, rejected, or there is nothing"""
    source: Shaped[np.ndarray, "t 18"]
    """'observed', 'inferred' or 'missing' as in `Person.source`; filled-in joints are 'inferred'"""
    bone_lengths_m: Float[np.ndarray, " n"]
    """of the bones of `skeleton.BONES`"""

    def __post_init__(self) -> None:
        t = len(self.times_s)
        shapes = (self.keypoints.shape, self.sigma_m.shape, self.observed.shape, self.source.shape)
        if shapes != ((t, N_JOINTS, 3), *((t, N_JOINTS),) * 3):
            raise UnderstudyError(f"a track of {t} moments needs (t, 18, 3) and three times (t, 18), got {shapes}")

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def confidence(self) -> Float[np.ndarray, "t 18"]:
        """Probability of being within 10 cm of the truth; 0 where missing."""
        return confidence_of(self.sigma_m)


def track(
    frames: Sequence[FramePeople], fps: float | None = None, model: Model | None = None, reach_s: float = REACH_S
) -> list[PersonTrack]:
    """The people of a recording, numbered anew and smoothed; ordered by id.

    Frames that were skipped, or that show nobody, are gaps. fps: frames per second, for recordings without a clock.
    Raises UnderstudyError when there are neither time stamps nor fps, and when times do not increase.
    """
    times_s, tracker = frame_times(frames, fps), IdentityTracker()
    return smooth(
        times_s,
        [tracker.update(f.people, float(t)) for f, t in zip(frames, times_s, strict=True)],
        model=model,
        reach_s=reach_s,
    )


def frame_times(frames: Sequence[FramePeople], fps: float | None = None) -> Float[np.ndarray, " t"]:
    """Seconds: the frames' time stamps, or their numbers divided by `fps` where a frame has no time stamp."""
    stamps = [f.timestamp_s for f in frames]
    without = [f.index for f in frames if f.timestamp_s is None]
    if not without:
        return np.array(stamps, np.float64)
    if fps is None:
        raise UnderstudyError(
            f"frame {without[0]}: field 'timestamp_s' is missing; say how many frames a second there are: fps"
        )
    if not (np.isfinite(fps) and fps > 0):
        raise UnderstudyError(f"fps must be above 0, got {fps}")
    return np.array([f.index / fps for f in frames], np.float64)


def smooth(
    times_s: Float[np.ndarray, " t"] | Sequence[float],
    people_per_frame: Sequence[Sequence[Person]],
    *,
    model: Model | None = None,
    reach_s: float = REACH_S,
) -> list[PersonTrack]:
    """Smooths people who have ids already; ordered by id.

    times_s: seconds, increasing, steps may differ. people_per_frame: as many; people without 3D are gaps. reach_s: a
    joint is given at most so far in time from its nearest measurement. A Kalman filter with Student's t measurement
    noise, the Rauch-Tung-Striebel smoother, and the person's own bone lengths (docs/tracking.md).
    Raises UnderstudyError when times and people do not fit, or two people of a frame have one id.
    """
    times = checked_times(times_s, len(people_per_frame))
    if not (np.isfinite(reach_s) and reach_s >= 0):
        raise UnderstudyError(f"reach_s must be 0 or more, got {reach_s}")
    model = model or Model()
    frames = [by_id(people, k) for k, people in enumerate(people_per_frame)]
    spans = _spans(frames)
    tracks: list[PersonTrack] = []
    for group in _groups(spans):
        first, last = min(spans[i][0] for i in group), max(spans[i][1] for i in group)
        window = [{id: p for id, p in frame.items() if id in group} for frame in frames[first : last + 1]]
        tracks += _smooth_group(times[first : last + 1], window, group, model, reach_s)
    return sorted(tracks, key=lambda t: t.id)


def checked_times(times_s: Float[np.ndarray, " t"] | Sequence[float], count: int) -> Float[np.ndarray, " t"]:
    """As an array. Raises UnderstudyError unless there are `count`, finite and increasing."""
    times = np.asarray(times_s, np.float64)
    if times.shape != (count,):
        raise UnderstudyError(f"times_s must hold one time for each of the {count} frames, got shape {times.shape}")
    if not np.isfinite(times).all():
        k = int((~np.isfinite(times)).argmax())
        raise UnderstudyError(f"times_s must be finite, got {times[k]} at position {k}")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        k = int(back[0])
        raise UnderstudyError(f"times_s must increase, got {times[k]:g} and then {times[k + 1]:g} (position {k + 1})")
    return times


def by_id(people: Sequence[Person], position: int) -> dict[int, Person]:
    """Id -> person with 3D. Raises UnderstudyError if two have the same."""
    ids = [p.id for p in people]
    twice = {i for i in ids if ids.count(i) > 1}
    if twice:
        raise UnderstudyError(
            f"people_per_frame[{position}]: id {min(twice)} is there twice; number people with IdentityTracker first"
        )
    return {p.id: p for p in people if np.isfinite(p.keypoints).all(axis=1).any()}


def _spans(frames: Sequence[Mapping[int, Person]]) -> dict[int, tuple[int, int]]:
    spans: dict[int, tuple[int, int]] = {}
    for k, frame in enumerate(frames):
        for id in frame:
            spans[id] = (spans.get(id, (k, k))[0], k)
    return spans


def _groups(spans: Mapping[int, tuple[int, int]]) -> list[list[int]]:
    """People to smooth together: one pass serves many, unless it would mostly serve people who are not there."""
    groups: list[list[int]] = []
    for id in sorted(spans, key=lambda i: spans[i]):
        if groups:
            members = [*groups[-1], id]
            first, last = min(spans[i][0] for i in members), max(spans[i][1] for i in members)
            own = sum(spans[i][1] - spans[i][0] + 1 for i in members)
            if (last - first + 1) * len(members) <= _PADDING * own:
                groups[-1] = members
                continue
        groups.append([id])
    return groups


def _smooth_group(
    times: Float[np.ndarray, " t"],
    frames: Sequence[Mapping[int, Person]],
    ids: Sequence[int],
    model: Model,
    reach_s: float,
) -> list[PersonTrack]:
    b = N_JOINTS * len(ids)
    measured, source = measure(frames, ids, times, np.zeros(b, bool), reach_s)
    smoothed = smooth_points(measured, model, np.diff(times, prepend=times[0]), Past.none(b))
    tracks = []
    for i, id in enumerate(ids):
        part = slice(N_JOINTS * i, N_JOINTS * (i + 1))
        there = np.flatnonzero([id in frame for frame in frames])
        span = slice(there[0], there[-1] + 1)
        joints = Joints.of(times[span], measured, smoothed, (span, part), source, np.full(N_JOINTS, -np.inf), reach_s)
        lengths, sigma = joints.learn_bones(model)
        tracks.append(joints.track(id, lengths, sigma))
    return tracks


@dataclass(frozen=True, eq=False)
class Joints:
    """One person's smoothed joints, before the bones have their say."""

    times_s: Float[np.ndarray, " t"]
    position: Float[np.ndarray, "t 18 3"]
    """metres; NaN beyond the reach of the measurements"""
    variance: Float[np.ndarray, "t 18"]
    observed: Bool[np.ndarray, "t 18"]
    source: Shaped[np.ndarray, "t 18"]

    @classmethod
    def of(
        cls,
        times: Float[np.ndarray, " t"],
        measured: Measured,
        smoothed: Smoothed,
        part: tuple[slice, slice],
        source: Shaped[np.ndarray, "_ _"],
        before_s: Float[np.ndarray, "18"],
        reach_s: float,
    ) -> Joints:
        """The moments and points `part` of what was smoothed. before_s: when each joint was last observed earlier."""
        observed = measured.seen[part] & (smoothed.weight[part] >= _REJECTED)
        known = within_reach(times, observed, before_s, reach_s)
        word = np.where(observed, source[part], np.where(known, INFERRED, MISSING))
        position = np.where(known[..., None], smoothed.position[part], np.nan)
        return cls(times, position, np.where(known, smoothed.variance[part], np.nan), observed, word)

    def bones(self) -> tuple[Float[np.ndarray, "t n"], Float[np.ndarray, "t n"]]:
        """Lengths where both ends were observed, NaN elsewhere, and their variances."""
        seen = self.observed
        return (
            bones.lengths(np.where(seen[..., None], self.position, np.nan)),
            bones.variances(np.where(seen, self.variance, np.nan)),
        )

    def learn_bones(self, model: Model) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lengths and sigmas, metres."""
        return bones.learn(*self.bones(), independent_moments(float(self.times_s[-1] - self.times_s[0]), model))

    def track(self, id: int, lengths: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]) -> PersonTrack:
        """With the bones' lengths."""
        position, variance = bones.enforce(self.position, self.variance, lengths, sigma)
        sigma_m = BALL * np.sqrt(variance)
        return PersonTrack(id, self.times_s, position, sigma_m, self.observed, self.source, lengths)


def independent_moments(seconds: float, model: Model) -> float:
    """In how many moments of this time errors differ: a first-order Markov process stays alike for 2 * bias_s."""
    return 1 + seconds / (2 * model.bias_s)
