"""The true people of a recording with the 2D detections that belong to them: what every method is given alike.

Detections are matched to true people in 2D, once, before any method runs; so a method that lifts badly cannot lose a
person, and all are compared on the same detections.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from understudy.camera import Camera
from understudy.errors import FrameError, UnderstudyError
from understudy.lifting import nearest_depths
from understudy.recordings.base import Recording
from understudy.recordings.truth import TruthPerson
from understudy.registration import register
from understudy.skeleton import BONES, JOINT, N_JOINTS
from understudy.types import Keypoints2D, RegisteredFrame

MATCH_LIMIT: Final = 0.3
"""of the person's size in the image: a larger median distance of the keypoints is no match"""
FRONTAL_COSINE: Final = 0.7
"""of the angle between the chest's direction and the way to the camera; below, a person is not frontal"""
COVERED_JOINTS: Final = 3
"""so many joints behind something else put an object in front of a person"""
_BODY_M = 0.25  # metres from the nearest bone: what is farther away is not the person's own body
_BEHIND_M = 0.05  # metres: a joint lies behind a surface
_SEGMENTS = np.array(
    [*BONES, (JOINT["right_shoulder"], JOINT["left_hip"]), (JOINT["left_shoulder"], JOINT["right_hip"])]
)


@dataclass(frozen=True, eq=False)
class Subjects:
    """n true people of one or several recordings who were detected; rows."""

    recording: Int[np.ndarray, " n"]
    """number of the recording, by its name (`number_of`)"""
    frame: Int[np.ndarray, " n"]
    truth: Float[np.ndarray, "n 18 3"]
    """metres; NaN where there is no truth"""
    in_view: Bool[np.ndarray, "n 18"]
    occluded: Bool[np.ndarray, "n 18"]
    covered: Bool[np.ndarray, "n 18"]
    """occluded by something other than the person's own body"""
    frontal: Bool[np.ndarray, " n"]
    true_uv: Float[np.ndarray, "n 18 2"]
    """colour pixels of the true joints; NaN where there are none"""
    detected: Float[np.ndarray, "n 18 3"]
    """u, v, score; zeros where not found"""
    undetected: Int[np.ndarray, " m"]
    """one entry per recording: true people in view without a detection"""
    unmatched: Int[np.ndarray, " m"]
    """one entry per recording: detections that belong to no true person"""

    @property
    def hard(self) -> Bool[np.ndarray, " n"]:
        """Not frontal, or at least `COVERED_JOINTS` joints in view behind something else."""
        return ~self.frontal | ((self.covered & self.in_view).sum(1) >= COVERED_JOINTS)

    @property
    def counted(self) -> Bool[np.ndarray, "n 18"]:
        """Joints in view with truth."""
        return np.asarray(self.in_view & np.isfinite(self.truth).all(-1))

    @property
    def distance(self) -> Float[np.ndarray, " n"]:
        """Metres from the camera to the middle of the person's joints."""
        return np.asarray(np.linalg.norm(np.nanmean(self.truth, axis=1), axis=-1))

    @classmethod
    def pooled(cls, parts: Sequence[Subjects]) -> Subjects:
        """One after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


def number_of(name: str) -> int:
    """A number for a recording's name, the same on every machine."""
    return zlib.crc32(name.encode())


def read_subjects(recording: Recording, name: str) -> Subjects:
    """Truth, detections and who is who. Needs truth.json and keypoints2d.json; broken frames are left out."""
    if recording.truth is None or recording.keypoints2d is None:
        absent = "truth.json" if recording.truth is None else "keypoints2d.json"
        raise UnderstudyError(f"{recording.path}: the comparison needs truth.json and keypoints2d.json; no {absent}")
    rows: list[tuple[np.ndarray, ...]] = []
    undetected = unmatched = 0
    for frame in recording.frames(on_error=_ignore):
        registered = register(frame)
        people = [p for p in recording.truth.frames.get(frame.index, ()) if p.in_view.any()]
        seen = recording.keypoints2d.get(frame.index, [])
        uv = [registered.camera.project(p.keypoints) for p in people]
        pairs = match_2d(uv, [p.in_view for p in people], seen)
        undetected += len(people) - len(pairs)
        unmatched += len(seen) - len(pairs)
        for t, d in pairs:
            truth = people[t]
            covered = truth.occluded & _behind_others(registered, truth, uv[t])
            frontal = np.array(is_frontal(truth.keypoints))
            rows.append(
                (np.array(frame.index), truth.keypoints, truth.in_view, truth.occluded, covered, frontal, uv[t],
                 seen[d].rows())
            )  # fmt: skip
    shapes = ((), (N_JOINTS, 3), (N_JOINTS,), (N_JOINTS,), (N_JOINTS,), (), (N_JOINTS, 2), (N_JOINTS, 3))
    kinds = (np.int64, np.float64, bool, bool, bool, bool, np.float64, np.float64)
    columns = [
        np.array([row[i] for row in rows], dtype=kind).reshape(-1, *shape)
        for i, (kind, shape) in enumerate(zip(kinds, shapes, strict=True))
    ]
    number = np.full(len(rows), number_of(name), np.int64)
    return Subjects(*[number, *columns, np.array([undetected]), np.array([unmatched])])


def _ignore(index: int, error: FrameError) -> None:
    """A broken frame is nobody's fault here."""


def match_2d(
    true_uv: Sequence[np.ndarray], in_view: Sequence[np.ndarray], seen: Sequence[Keypoints2D]
) -> list[tuple[int, int]]:
    """Pairs (true person, detection): least sum of the median distances of found keypoints, in sizes of the person
    (the diagonal about the joints in view); at most `MATCH_LIMIT`.
    """
    if not true_uv or not seen:
        return []
    cost = np.full((len(true_uv), len(seen)), np.inf)
    for i, (uv, inside) in enumerate(zip(true_uv, in_view, strict=True)):
        here = uv[inside & np.isfinite(uv).all(1)]
        size = max(20.0, float(np.linalg.norm(np.ptp(here, axis=0)))) if len(here) else np.inf
        for j, person in enumerate(seen):
            both = person.found & np.isfinite(uv).all(1)
            if both.any():
                cost[i, j] = np.median(np.linalg.norm(uv[both] - person.uv[both], axis=1)) / size
    pairs = zip(*linear_sum_assignment(np.minimum(cost, 10 * MATCH_LIMIT)), strict=True)
    return [(int(i), int(j)) for i, j in pairs if cost[i, j] <= MATCH_LIMIT]


def is_frontal(keypoints: Float[np.ndarray, "18 3"]) -> bool:
    """Whether the chest is turned to the camera, to `FRONTAL_COSINE`. Not, where shoulders or hips have no truth."""
    k = {name: keypoints[JOINT[name]] for name in ("neck", "right_shoulder", "left_shoulder", "right_hip", "left_hip")}
    down = (k["right_hip"] + k["left_hip"]) / 2 - k["neck"]
    facing = np.cross(down, k["left_shoulder"] - k["right_shoulder"])
    length = np.linalg.norm(facing) * np.linalg.norm(k["neck"])
    return bool(-(facing @ k["neck"]) >= FRONTAL_COSINE * length) if np.isfinite(length) and length > 0 else False


def _behind_others(
    frame: RegisteredFrame, person: TruthPerson, uv: Float[np.ndarray, "18 2"]
) -> Bool[np.ndarray, "18"]:
    """Joints behind a measured surface that is not part of the person."""
    inside = frame.camera.contains(uv)
    z = nearest_depths(frame.depth, frame.camera, np.where(inside[:, None], uv, np.nan), k=1)[:, 0].astype(np.float64)
    surface = surface_points(frame.camera, uv, z)
    nearer = z < person.keypoints[:, 2] - _BEHIND_M
    return np.asarray(nearer & (distance_to_bones(surface, person.keypoints) > _BODY_M))


def surface_points(
    camera: Camera, uv: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Metres; NaN where there is no depth."""
    return camera.unproject(np.where(np.isfinite(uv), uv, 0.0), z)


def distance_to_bones(
    points: Float[np.ndarray, "n 3"], keypoints: Float[np.ndarray, "18 3"]
) -> Float[np.ndarray, " n"]:
    """Metres from each point to the nearest bone; NaN for a point that is NaN or a person without any bone."""
    a, b = keypoints[_SEGMENTS[:, 0]], keypoints[_SEGMENTS[:, 1]]
    known = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    if not known.any():
        return np.full(len(points), np.nan)
    a, along = a[known], (b - a)[known]
    share = ((points[:, None] - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
    foot = a + share.clip(0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(points[:, None] - foot, axis=-1).min(1))


# --- quality of the 2D keypoints ---


def _detections(s: Subjects) -> np.ndarray:
    return s.detected


def _true(s: Subjects) -> np.ndarray:
    return _rows(s, s.in_view)


def _true_visible(s: Subjects) -> np.ndarray:
    return _rows(s, s.in_view & ~s.occluded)


def _rows(s: Subjects, use: np.ndarray) -> np.ndarray:
    use = use & np.isfinite(s.true_uv).all(-1)
    return np.where(use[..., None], np.concatenate([s.true_uv, np.ones_like(s.true_uv[..., :1])], -1), 0.0)


def _twice_the_error(s: Subjects) -> np.ndarray:
    out = s.detected.copy()
    wrong = (s.detected[..., 2] > 0) & np.isfinite(s.true_uv).all(-1)
    out[..., :2] = np.where(wrong[..., None], 2 * s.detected[..., :2] - s.true_uv, s.detected[..., :2])
    return out


def _fewer(s: Subjects) -> np.ndarray:
    """Drops each found joint with a probability of 20 %; per recording the same ones on every run."""
    out = s.detected.copy()
    for number in np.unique(s.recording):
        here = s.recording == number
        out[here] *= np.random.default_rng([int(number), 20]).random((int(here.sum()), N_JOINTS, 1)) >= 0.2
    return out


DETECTIONS: Final = "detections"
TRUE: Final = "true 2D"
TRUE_VISIBLE: Final = "true 2D, visible only"
QUALITIES: Final = MappingProxyType[str, Callable[[Subjects], np.ndarray]](
    {
        TRUE: _true,
        TRUE_VISIBLE: _true_visible,
        DETECTIONS: _detections,
        "detections, errors x 2": _twice_the_error,
        "detections, 20 % dropped": _fewer,
    }
)
"""Name of a quality of 2D keypoints -> rows (n, 18, 3) of u, v, score."""
