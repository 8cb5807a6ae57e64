"""truth.json: the true people of a recording. Reading and its inverse.

What a file leaves out: `in_view` counts as true, `occluded` as false, a hand (or all hands) as without truth, a
person's `id` as their place in the list. A hand without truth is not in view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from understudy.errors import RecordingError
from understudy.files import read_json
from understudy.people_file import rows_from_json
from understudy.skeleton import N_JOINTS

SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class TruthPerson:
    """One true person in one frame, colour camera's frame."""

    id: int
    keypoints: Float[np.ndarray, "18 3"]
    """metres; a row of NaN where there is no truth"""
    in_view: Bool[np.ndarray, "18"]
    """projects inside the colour image"""
    occluded: Bool[np.ndarray, "18"]
    """hidden from the colour camera"""
    palms: dict[str, np.ndarray | None] = field(default_factory=lambda: dict.fromkeys(SIDES))
    """'left', 'right' -> unit normal out of the palm, shape (3,); None without truth"""
    hands_in_view: dict[str, bool] = field(default_factory=lambda: dict.fromkeys(SIDES, False))
    """'left', 'right' -> whether the hand projects inside the colour image"""

    def to_json(self) -> dict[str, Any]:
        """One entry of 'people'."""
        return {
            "id": self.id,
            "keypoints": [None if np.isnan(row).any() else row.tolist() for row in self.keypoints],
            "in_view": self.in_view.tolist(),
            "occluded": self.occluded.tolist(),
            "hands": {side: self._hand_to_json(side) for side in SIDES},
        }

    def _hand_to_json(self, side: str) -> dict[str, Any] | None:
        normal = self.palms.get(side)
        if normal is None:
            return None
        return {"normal": normal.tolist(), "in_view": bool(self.hands_in_view.get(side, True))}


@dataclass(frozen=True, eq=False)
class Truth:
    """The true people of a recording."""

    frames: Mapping[int, tuple[TruthPerson, ...]]
    """frame number -> people; a frame that is absent has no truth, an empty tuple means nobody is there"""
    joints_note: str = ""
    """free text: how the joints are meant"""

    @classmethod
    def read(cls, path: Path) -> Truth:
        """Reads a truth.json. Raises RecordingError that names the file and the place in it."""
        data = read_json(path)
        note = data.get("joints_note")
        return cls(frames_from_json(data, path, _person_from_json), note if isinstance(note, str) else "")

    def to_json(self) -> dict[str, Any]:
        """The content of a truth.json."""
        out: dict[str, Any] = {
            "frames": [
                {"index": index, "people": [p.to_json() for p in self.frames[index]]} for index in sorted(self.frames)
            ]
        }
        if self.joints_note:
            out["joints_note"] = self.joints_note
        return out


def frames_from_json(data: Mapping[str, Any], path: Path, person_from_json: Any) -> dict[int, tuple[Any, ...]]:
    """Frame number -> people, of a file's 'frames'; `person_from_json(data, where, position)` reads one person."""
    frames = data.get("frames")
    if not isinstance(frames, list):
        raise RecordingError(f"{path}: field 'frames' must be a list")
    out: dict[int, tuple[Any, ...]] = {}
    for i, entry in enumerate(frames):
        where = f"{path}: frames[{i}]"
        if not isinstance(entry, Mapping):
            raise RecordingError(f"{where}: must be an object")
        index, people = entry.get("index"), entry.get("people")
        if not isinstance(index, int) or isinstance(index, bool) or index < 0:
            raise RecordingError(f"{where}.index: must be a frame number, got {index!r}")
        if index in out:
            raise RecordingError(f"{where}.index: frame {index} is there twice")
        if not isinstance(people, list):
            raise RecordingError(f"{where}.people: must be a list")
        out[index] = tuple(person_from_json(p, f"{where}.people[{j}]", j) for j, p in enumerate(people))
    return out


def _person_from_json(data: Any, where: str, position: int) -> TruthPerson:
    if not isinstance(data, Mapping):
        raise RecordingError(f"{where}: must be an object")
    id = data.get("id", position)
    if not isinstance(id, int) or isinstance(id, bool):
        raise RecordingError(f"{where}.id: must be a whole number, got {id!r}")
    keypoints = rows_from_json(data.get("keypoints"), 3, f"{where}.keypoints")
    if np.isinf(keypoints).any():
        raise RecordingError(f"{where}.keypoints: must be finite")
    hands = data.get("hands")
    if hands is not None and not isinstance(hands, Mapping):
        raise RecordingError(f"{where}.hands: must be an object")
    palms: dict[str, np.ndarray | None] = {}
    in_view: dict[str, bool] = {}
    for side in SIDES:
        palms[side], in_view[side] = _hand_from_json((hands or {}).get(side), f"{where}.hands.{side}")
    return TruthPerson(
        id,
        keypoints,
        _flags(data.get("in_view"), True, f"{where}.in_view"),
        _flags(data.get("occluded"), False, f"{where}.occluded"),
        palms,
        in_view,
    )


def _flags(data: Any, missing: bool, where: str) -> Bool[np.ndarray, "18"]:
    if data is None:
        return np.full(N_JOINTS, missing)
    if not isinstance(data, list) or len(data) != N_JOINTS or any(not isinstance(x, bool) for x in data):
        raise RecordingError(f"{where}: must be {N_JOINTS} times true or false")
    return np.array(data, dtype=bool)


def _hand_from_json(data: Any, where: str) -> tuple[np.ndarray | None, bool]:
    if data is None:
        return None, False
    if not isinstance(data, Mapping):
        raise RecordingError(f"{where}: must be an object or null")
    try:
        normal = np.array([float(x) for x in data["normal"]])
    except (KeyError, TypeError, ValueError) as e:
        raise RecordingError(f"{where}.normal: must be 3 numbers") from e
    if normal.shape != (3,) or not abs(np.hypot(np.hypot(normal[0], normal[1]), normal[2]) - 1) < 0.01:
        raise RecordingError(f"{where}.normal: must be a unit vector of 3 numbers, got {normal.tolist()}")
    in_view = data.get("in_view", True)
    if not isinstance(in_view, bool):
        raise RecordingError(f"{where}.in_view: must be true or false")
    return normal / np.linalg.norm(normal), in_view
