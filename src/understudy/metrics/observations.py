"""Predictions beside the truth: everything that the metrics need, pooled over frames (and recordings) as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import UnderstudyError
from understudy.metrics.matching import DEFAULT_RULE, MatchRule, match_people
from understudy.people_file import FramePeople
from understudy.recordings.truth import Truth, TruthPerson
from understudy.skeleton import N_JOINTS
from understudy.types import Person

SIDES = ("left", "right")
"""Order of palms in arrays."""


@dataclass(frozen=True)
class Counts:
    """Frames and people, as counts."""

    frames: int = 0
    """frames with truth (also those whose truth is that nobody is there)"""
    skipped_frames: int = 0
    """of these, frames that the prediction lists as unreadable; their people count as missed"""
    absent_frames: int = 0
    """of these, frames that the prediction does not list; their people count as missed"""
    frames_without_truth: int = 0
    """predicted frames without truth: ignored"""
    truth_people: int = 0
    """true people that count"""
    uncounted_people: int = 0
    """true people that do not count (`MatchRule`)"""
    missed: int = 0
    """true people without a predicted person"""
    false: int = 0
    """predicted people without a true person"""
    failed: int = 0
    """predicted people without enough 3D joints to be matched; they match nobody and are not false people"""
    id_switches: int = 0
    """times that a true person's predicted id differs from the one at its match before"""

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Observations:
    """All counted true people of all frames, n rows; rows of those who were missed hold NaN predictions."""

    predicted: Float[np.ndarray, "n 18 3"]
    """metres; NaN where not given"""
    truth: Float[np.ndarray, "n 18 3"]
    """metres; NaN where no truth"""
    in_view: Bool[np.ndarray, "n 18"]
    """joint projects inside the colour image"""
    occluded: Bool[np.ndarray, "n 18"]
    """joint hidden from the colour camera"""
    confidence: Float[np.ndarray, "n 18"]
    """NaN where not given"""
    sigma_m: Float[np.ndarray, "n 18"]
    """NaN where not given"""
    palms_predicted: Float[np.ndarray, "n 2 3"]
    """left, right; NaN where not given"""
    palms_truth: Float[np.ndarray, "n 2 3"]
    """left, right; NaN where no truth"""
    palms_in_view: Bool[np.ndarray, "n 2"]
    """hand inside the colour image"""
    counts: Counts

    @classmethod
    def pooled(cls, parts: Sequence[Observations]) -> Observations:
        """One after the other, as if they were one recording."""
        if not parts:
            raise UnderstudyError("nothing to pool: give at least one recording's observations")
        arrays = {
            f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls) if f.name != "counts"
        }
        return cls(**arrays, counts=sum((p.counts for p in parts), Counts()))


@dataclass(frozen=True, eq=False)
class _FrameMatch:
    """One frame: counted true people, for each the person who was matched (or None), and what is left over."""

    truth: tuple[TruthPerson, ...]
    matched: tuple[Person | None, ...]
    uncounted: int
    false: int
    failed: int


def observe(predicted: Iterable[FramePeople], truth: Truth, rule: MatchRule = DEFAULT_RULE) -> Observations:
    """Matches people in every frame that has truth. In frames skipped or not predicted all people count as missed."""
    frames: dict[int, FramePeople] = {}
    for frame in predicted:
        if frame.index in frames:
            raise UnderstudyError(f"frame {frame.index} is predicted twice; each frame may be given once")
        frames[frame.index] = frame
    matches = [
        _match_frame(frames[index].people if index in frames else (), truth.frames[index], rule)
        for index in sorted(truth.frames)
    ]
    pairs = [pair for m in matches for pair in zip(m.truth, m.matched, strict=True)]
    counts = Counts(
        frames=len(matches),
        skipped_frames=sum(i in frames and frames[i].skipped is not None for i in truth.frames),
        absent_frames=sum(i not in frames for i in truth.frames),
        frames_without_truth=sum(i not in truth.frames for i in frames),
        truth_people=len(pairs),
        uncounted_people=sum(m.uncounted for m in matches),
        missed=sum(person is None for _, person in pairs),
        false=sum(m.false for m in matches),
        failed=sum(m.failed for m in matches),
        id_switches=_id_switches(pairs),
    )
    return _stack([t for t, _ in pairs], [p for _, p in pairs], counts)


def _match_frame(people: Sequence[Person], truth: Sequence[TruthPerson], rule: MatchRule) -> _FrameMatch:
    found = [p for p in people if p.failed is None and _given(p.keypoints).sum() >= rule.min_near]
    known = np.array([_given(t.keypoints).sum() >= rule.min_near for t in truth], dtype=bool)
    counted = known & np.array([np.sum(t.in_view) >= rule.min_in_view for t in truth], dtype=bool)
    pairs = match_people(_rows([p.keypoints for p in found]), _rows([t.keypoints for t in truth]), rule)
    person_of = {int(t): found[p] for p, t in pairs}
    rows = np.flatnonzero(counted)
    return _FrameMatch(
        tuple(truth[int(i)] for i in rows),
        tuple(person_of.get(int(i)) for i in rows),
        uncounted=len(truth) - len(rows),
        false=len(found) - len(pairs),
        failed=len(people) - len(found),
    )


def _given(keypoints: np.ndarray) -> np.ndarray:
    return np.isfinite(keypoints).all(axis=-1)


def _rows(keypoints: Sequence[np.ndarray]) -> np.ndarray:
    """List of (18, 3) -> (n, 18, 3); a row that is not finite as a whole becomes NaN."""
    rows = np.array(keypoints, dtype=np.float64).reshape(-1, N_JOINTS, 3)
    rows[~_given(rows)] = np.nan
    return rows


def _id_switches(pairs: Sequence[tuple[TruthPerson, Person | None]]) -> int:
    """Pairs in the order of frames. A gap without a match does not hide a switch."""
    ids: dict[int, list[int]] = {}
    for true, person in pairs:
        if person is not None:
            ids.setdefault(true.id, []).append(person.id)
    return sum(sum(a != b for a, b in pairwise(seen)) for seen in ids.values())


def _stack(truth: Sequence[TruthPerson], people: Sequence[Person | None], counts: Counts) -> Observations:
    nothing = np.full((N_JOINTS, 3), np.nan)
    predicted = _rows([nothing if p is None else p.keypoints for p in people])
    given = ~np.isnan(predicted[..., 0])
    unknown = nothing[:, 0]

    def per_joint(rows: Sequence[np.ndarray], kind: type) -> np.ndarray:
        return np.array(rows, dtype=kind).reshape(-1, N_JOINTS)

    return Observations(
        predicted,
        _rows([t.keypoints for t in truth]),
        per_joint([t.in_view for t in truth], bool),
        per_joint([t.occluded for t in truth], bool),
        np.where(given, per_joint([unknown if p is None else p.confidence for p in people], float), np.nan),
        np.where(given, per_joint([unknown if p is None else p.sigma_m for p in people], float), np.nan),
        _normals([{} if p is None else {s: h.normal for s, h in p.hands.items() if h is not None} for p in people]),
        _normals([{s: n for s, n in t.palms.items() if n is not None} for t in truth]),
        np.array([[t.hands_in_view.get(s, False) for s in SIDES] for t in truth], dtype=bool).reshape(-1, 2),
        counts,
    )


def _normals(palms: Sequence[dict[str, np.ndarray]]) -> np.ndarray:
    """(n, 2, 3), left and right; NaN where there is none."""
    return np.array([[p.get(s, np.full(3, np.nan)) for s in SIDES] for p in palms], dtype=np.float64).reshape(-1, 2, 3)
