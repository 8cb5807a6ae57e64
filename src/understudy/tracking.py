"""Who is who from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from understudy.skeleton import TORSO
from understudy.types import Person

MEMORY = 30
"""frames for which a lost person's id is kept"""
_GATE = 0.6  # metres between the torsos of one person in successive frames, growing while the person is lost
_GATE_IN_IMAGE = 0.5  # the same in torso sizes, for people without 3D


@dataclass
class _Track:
    id: int
    person: Person
    age: int = 0


class IdentityTracker:
    """Gives ids that stay with people through a recording: Hungarian assignment on torso positions.

    People without 3D are compared in the image. There is no motion model and no appearance: people who swap places
    while both are hidden swap ids.
    """

    def __init__(self) -> None:
        self._tracks: list[_Track] = []
        self._next = 0

    def update(self, people: Sequence[Person]) -> list[Person]:
        """The same people in the same order, with their ids."""
        for track in self._tracks:
            track.age += 1
        self._tracks = [t for t in self._tracks if t.age <= MEMORY]
        cost = np.array([[_cost(t, p) for t in self._tracks] for p in people]).reshape(len(people), len(self._tracks))
        out: list[Person | None] = [None] * len(people)
        for i, j in np.transpose(linear_sum_assignment(cost)).tolist():
            if cost[i, j] < 1:
                out[i] = self._follow(self._tracks[j], people[i])
        for i, person in enumerate(people):
            if out[i] is None:
                out[i] = self._start(person)
        return [p for p in out if p is not None]

    @staticmethod
    def _follow(track: _Track, person: Person) -> Person:
        track.person, track.age = person.with_id(track.id), 0
        return track.person

    def _start(self, person: Person) -> Person:
        person = person.with_id(self._next)
        self._tracks.append(_Track(self._next, person))
        self._next += 1
        return person


def _cost(track: _Track, person: Person) -> float:
    """Distance between two sightings in units of the gate, at most 1 (= somebody else)."""
    a, b = track.person.keypoints[TORSO], person.keypoints[TORSO]
    both = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    if both.any():
        distance = float(np.median(np.linalg.norm(a[both] - b[both], axis=1))) / (_GATE * (1 + 0.1 * track.age))
    else:
        p, q = track.person.keypoints_2d, person.keypoints_2d
        both = p.found[TORSO] & q.found[TORSO]
        if not both.any():
            return 1.0
        size = max(float(np.ptp(q.uv[TORSO][both], axis=0).max()), 10.0)
        distance = (
            float(np.median(np.linalg.norm(p.uv[TORSO][both] - q.uv[TORSO][both], axis=1))) / size / _GATE_IN_IMAGE
        )
    return min(distance, 1.0)
