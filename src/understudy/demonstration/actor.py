"""Who acts, and with which hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from understudy.errors import UnderstudyError
from understudy.geometry import transform_points
from understudy.skeleton import JOINT, rows
from understudy.tracking import PersonTrack

_AT_REST = 0.33  # metres: a hanging hand is hardly farther from the trunk's axis
_ALIKE = 0.6  # share of the longest reach from which on another hand is tried, too
_CLEAR = 0.03  # metres times seconds: less is no reach but an error of the joints, and tells hands apart badly
_TRUNK = rows("neck", "right_hip", "left_hip")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hand that may be the one that acts."""

    track: PersonTrack
    side: str
    reaching_s: float
    """metres times seconds for which it was stretched out"""


def reaching_hands(tracks: Sequence[PersonTrack], T_world_cam: np.ndarray) -> list[Candidate]:
    """All hands, the one that is stretched out most and longest first. Raises UnderstudyError when there is nobody."""
    out = []
    for track in tracks:
        joints = transform_points(T_world_cam, track.keypoints)
        trunk = joints[:, _TRUNK].mean(axis=1)
        step = np.gradient(track.times_s) if len(track.times_s) > 1 else np.zeros(1)
        for side in ("left", "right"):
            row = JOINT[f"{side}_wrist"]
            away = np.linalg.norm((joints[:, row] - trunk)[:, :2], axis=1)
            sure = 1 / (1 + (track.sigma_m[:, row] / 0.08) ** 2)
            score = np.nansum(np.maximum(away - _AT_REST, 0) * sure * step)
            out.append(Candidate(track, side, float(score)))
    if not out:
        raise UnderstudyError("there is nobody in the recording whose joints could be estimated")
    return sorted(out, key=lambda c: -c.reaching_s)


def in_question(hands: Sequence[Candidate]) -> list[Candidate]:
    """The hands, two at most, that may be the one that acts, of those that `reaching_hands` gives."""
    longest = hands[0].reaching_s
    return [h for h in hands if longest < _CLEAR or h.reaching_s >= _ALIKE * longest][:2]
