"""Who is who from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment

from understudy.errors import UnderstudyError
from understudy.skeleton import TORSO
from understudy.tracking import bones
from understudy.tracking.measured import axis_sigma
from understudy.types import Person

MEMORY: Final = 30
"""frames for which a lost person's id is kept, where frames have no times"""
MEMORY_S: Final = 10.0
"""seconds for which a lost person's id is kept"""
_FRAME_S: Final = 0.1  # a frame's time, where frames have none
_NEWCOMER: Final = 5.0  # minus log density of people who were never seen: one in 30 frames or so, anywhere in a room
_JUMP_M: Final = 0.1  # of a torso between frames, by errors that its sigma does not tell of
_SPEED: Final = 0.7  # m/s along each axis, one sigma: of people in a room
_STEADY_S: Final = 1.0  # time in which they change their speed
_IMAGE_GATE: Final = 0.5  # torso sizes between the sightings of one person, where there is no 3D
_EVIDENCE: Final = 0.25  # of the bones' log likelihoods that counts: their errors go together
_MOST: Final = 3.0  # that proportions can say for or against a person
_NO: Final = 1e6


@dataclass
class _Track:
    """Somebody, and where the torso is by now: a filter of constant, slowly forgotten velocity."""

    id: int
    person: Person
    keypoints: Float[np.ndarray, "18 3"]
    """where each joint was last, moved on with the torso; NaN before it was seen"""
    velocity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    P: Float[np.ndarray, "2 2"] = field(default_factory=lambda: np.diag([_JUMP_M**2, _SPEED**2]))
    """covariance of position and velocity along each axis"""
    bones: Float[np.ndarray, "2 n"] = field(default_factory=lambda: np.zeros((2, bones.N_BONES)))
    """sum of the weighted lengths, and of the weights"""
    age: int = 0
    lost_s: float = 0.0

    def predict(self, dt: float) -> None:
        keep = float(np.exp(-dt / _STEADY_S))
        reach = _STEADY_S * (1 - keep)
        F = np.array([[1.0, reach], [0.0, keep]])
        # noise such that the speed's variance stays that of people (Ornstein and Uhlenbeck's process)
        slow, fast = 1 - keep, 1 - keep**2
        Q = _SPEED**2 * np.array(
            [
                [_STEADY_S * (2 * dt - _STEADY_S * (2 * slow + slow**2)), _STEADY_S * slow**2],
                [_STEADY_S * slow**2, fast],
            ]
        )
        self.keypoints = self.keypoints + reach * self.velocity
        self.velocity = keep * self.velocity
        self.P = F @ self.P @ F.T + Q
        self.age, self.lost_s = self.age + 1, self.lost_s + dt

    def follow(self, person: Person) -> Person:
        self.person, self.age, self.lost_s = person.with_id(self.id), 0, 0.0
        seen = np.isfinite(person.keypoints).all(axis=1)
        gap = _gap(self.keypoints, person)
        if gap is not None:
            shift, noise = gap
            gain = self.P[:, 0] / (self.P[0, 0] + noise**2)
            self.keypoints = self.keypoints + gain[0] * shift
            self.velocity = self.velocity + gain[1] * shift
            self.P = self.P - np.outer(gain, self.P[0])
        self.keypoints = np.where(seen[:, None], person.keypoints, self.keypoints)
        length, variance = _proportions(person)
        known = np.isfinite(length)
        self.bones += np.where(known, np.stack([length, np.ones_like(length)]) / variance, 0.0)
        return self.person


class IdentityTracker:
    """Gives ids that stay with people through a recording.

    Hungarian assignment by likelihood: where a person's torso should be by now, and how sure that is; the person's
    proportions, as far as they are known; and how likely it is that somebody new is there. People without 3D are
    compared in the image. There is no appearance: people of like build who swap places while both are hidden swap ids.
    """

    def __init__(self) -> None:
        self._tracks: list[_Track] = []
        self._next = 0
        self._time_s: float | None = None

    @property
    def remembered(self) -> set[int]:
        """Ids that may come again."""
        return {t.id for t in self._tracks}

    def update(self, people: Sequence[Person], time_s: float | None = None) -> list[Person]:
        """The same people in the same order, with their ids; never two with one id.

        time_s: of the frame, seconds, later than the one before; without it, frames are taken to come at 10 Hz.
        Raises UnderstudyError when times do not increase.
        """
        step = self._step(time_s)
        for track in self._tracks:
            track.predict(step)
        self._time_s = time_s
        self._tracks = [t for t in self._tracks if (t.age <= MEMORY if time_s is None else t.lost_s <= MEMORY_S)]
        cost = np.array([[_cost(t, p) for t in self._tracks] for p in people]).reshape(len(people), len(self._tracks))
        new = np.full((len(people), len(people)), _NO)
        np.fill_diagonal(new, _NEWCOMER)
        old = len(self._tracks)
        out: list[Person | None] = [None] * len(people)
        for i, j in np.transpose(linear_sum_assignment(np.hstack([cost, new]))).tolist():
            out[i] = self._tracks[j].follow(people[i]) if j < old else None
        for i, person in enumerate(people):
            if out[i] is None:
                out[i] = self._start(person)
        return [p for p in out if p is not None]

    def _step(self, time_s: float | None) -> float:
        """Seconds since the frame before."""
        if time_s is None or self._time_s is None:
            return _FRAME_S
        if not time_s > self._time_s:
            raise UnderstudyError(f"time_s must increase, got {time_s} after {self._time_s}")
        return time_s - self._time_s

    def _start(self, person: Person) -> Person:
        track = _Track(self._next, person, person.keypoints)
        self._tracks.append(track)
        self._next += 1
        return track.follow(person)


def _cost(track: _Track, person: Person) -> float:
    """Minus log density of the person being this track's; above `_NEWCOMER` rather somebody else."""
    gap = _gap(track.keypoints, person)
    if gap is None:
        return _image_cost(track.person, person)
    shift, noise = gap
    variance = track.P[0, 0] + noise**2
    return 0.5 * float(shift @ shift) / variance + 1.5 * float(np.log(variance)) + _proportions_cost(track, person)


def _gap(keypoints: Float[np.ndarray, "18 3"], person: Person) -> tuple[Float[np.ndarray, "3"], float] | None:
    """How far a person's torso is from where it should be, metres, and one sigma of that; of whatever joints both have
    where the torsos have none in common; None where nothing is.
    """
    both = np.isfinite(keypoints).all(axis=1) & np.isfinite(person.keypoints).all(axis=1)
    rows = TORSO[both[TORSO]] if both[TORSO].any() else np.flatnonzero(both)
    if not len(rows):
        return None
    sigma = np.median(axis_sigma(person.sigma_m, person.confidence)[rows])
    return np.median(person.keypoints[rows] - keypoints[rows], axis=0), float(np.hypot(sigma, _JUMP_M))


def _image_cost(before: Person, now: Person) -> float:
    """The same from 2D: from that of a person in place to that of a newcomer at the gate."""
    p, q = before.keypoints_2d, now.keypoints_2d
    both: Bool[np.ndarray, "5"] = p.found[TORSO] & q.found[TORSO]
    if not both.any():
        return _NO
    size = max(float(np.ptp(q.uv[TORSO][both], axis=0).max()), 10.0)
    distance = float(np.median(np.linalg.norm(p.uv[TORSO][both] - q.uv[TORSO][both], axis=1))) / size / _IMAGE_GATE
    sure = 3 * float(np.log(_JUMP_M))
    return sure + (_NEWCOMER - sure) * distance**2


def _proportions(person: Person) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Lengths of the bones and their variances; NaN and 1 where an end is missing."""
    sigma = axis_sigma(person.sigma_m, person.confidence)
    length = bones.lengths(person.keypoints)
    return length, np.where(np.isfinite(length), bones.variances(sigma**2) + bones.GIVE_M**2, 1.0)


def _proportions_cost(track: _Track, person: Person) -> float:
    """Minus log of how much better these proportions fit this track's person than anybody."""
    length, noise = _proportions(person)
    total, weight = track.bones
    both = np.isfinite(length) & (weight > 0)
    if not both.any():
        return 0.0
    length, noise, mean = length[both], noise[both], total[both] / weight[both]
    own = 2 * noise + 1 / weight[both]  # what stays of the errors is in both: noise once more, at worst
    anybody = noise + (bones.SCALE * bones.USUAL_M[both]) ** 2
    like = (length - mean) ** 2 / own + np.log(own)
    unlike = (length - bones.USUAL_M[both]) ** 2 / anybody + np.log(anybody)
    return float(np.clip(0.5 * _EVIDENCE * (like - unlike).sum(), -_MOST, _MOST))
