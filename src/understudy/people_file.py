"""people.json: what `understudy estimate` writes (docs/people.md). Reading, writing; nothing else knows the format."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from understudy.errors import RecordingError, one_of
from understudy.files import read_json, write_atomically
from understudy.skeleton import HAND_KEYPOINTS, N_JOINTS
from understudy.types import INFERRED, MISSING, OBSERVED, Hands, Keypoints2D, Palm, Person

FORMAT = "people/1"

_SIDES = ("left", "right")
_ROUNDED = 1e-5  # of a unit vector's length: what 5 digits may do to it


@dataclass(frozen=True)
class FramePeople:
    """The people of one frame."""

    index: int
    people: tuple[Person, ...]
    timestamp_s: float | None = None
    skipped: str | None = None
    """why the frame could not be read; None when it could"""


@dataclass(frozen=True)
class PeopleFile:
    """A people.json."""

    method: str
    recording: str
    frames: tuple[FramePeople, ...] = field(default=())

    def write(self, path: Path) -> None:
        """Writes the file, whole or not at all."""
        data = {
            "format": FORMAT,
            "method": self.method,
            "recording": self.recording,
            "frames": [frame_to_json(f) for f in self.frames],
        }
        write_atomically(path, json.dumps(data, allow_nan=False))

    @classmethod
    def read(cls, path: Path) -> PeopleFile:
        """Reads the file. Raises RecordingError that names the file and the field."""
        data = read_json(path)
        if data.get("format") != FORMAT:
            raise RecordingError(f"{path}: field 'format' must be {FORMAT!r}, got {data.get('format')!r}")
        if not isinstance(data.get("frames"), list):
            raise RecordingError(f"{path}: field 'frames' must be a list")
        frames = tuple(frame_from_json(f, f"{path}: frames[{i}]") for i, f in enumerate(data["frames"]))
        return cls(str(data.get("method", "")), str(data.get("recording", "")), frames)


def frame_to_json(frame: FramePeople) -> dict[str, Any]:
    """One entry of 'frames'."""
    out: dict[str, Any] = {"index": frame.index}
    if frame.timestamp_s is not None:
        out["timestamp_s"] = frame.timestamp_s
    out["people"] = [_person_to_json(p) for p in frame.people]
    if frame.skipped is not None:
        out["skipped"] = frame.skipped
    return out


def frame_from_json(data: Any, where: str) -> FramePeople:
    """The inverse of `frame_to_json`; `where` names the place in errors."""
    if not isinstance(data, Mapping) or not isinstance(data.get("index"), int):
        raise RecordingError(f"{where}: must be an object with a whole number 'index'")
    people = data.get("people")
    if not isinstance(people, list):
        raise RecordingError(f"{where}: field 'people' must be a list")
    timestamp, skipped = data.get("timestamp_s"), data.get("skipped")
    if timestamp is not None and (isinstance(timestamp, bool) or not isinstance(timestamp, int | float)):
        raise RecordingError(f"{where}.timestamp_s: must be a number, got {timestamp!r}")
    if skipped is not None and not isinstance(skipped, str):
        raise RecordingError(f"{where}.skipped: must be a text, got {skipped!r}")
    return FramePeople(
        data["index"],
        tuple(_person_from_json(p, f"{where}.people[{i}]") for i, p in enumerate(people)),
        timestamp,
        skipped,
    )


def _person_to_json(person: Person) -> dict[str, Any]:
    out: dict[str, Any] = {"id": person.id}
    if person.failed is not None:
        out["failed"] = person.failed
    else:
        out["keypoints"] = rows_to_json(person.keypoints, 4)
        out["confidence"] = [round(float(c), 4) for c in person.confidence]
        out["sigma_m"] = [None if math.isnan(s) else round(float(s), 4) for s in person.sigma_m]
        out["source"] = list(person.source)
    out["keypoints_2d"] = [[round(float(x), 3) for x in row] for row in person.keypoints_2d.rows()]
    out["hands"] = {side: None if palm is None else _palm_to_json(palm) for side, palm in person.hands.items()}
    if isinstance(person.hands, Hands) and person.hands.why:
        out["hands_missing"] = dict(person.hands.why)
    return out


def _palm_to_json(palm: Palm) -> dict[str, Any]:
    out: dict[str, Any] = {
        "normal": [round(float(x), 5) for x in palm.normal],
        "confidence": round(float(palm.confidence), 4),
    }
    if palm.direction is not None:
        out["direction"] = [round(float(x), 5) for x in palm.direction]
    if palm.keypoints is not None:
        out["keypoints"] = rows_to_json(palm.keypoints, 4)
    if palm.keypoints_2d is not None:
        out["keypoints_2d"] = [row or [0.0, 0.0, 0.0] for row in rows_to_json(palm.keypoints_2d, 3)]
    return out


def _person_from_json(data: Any, where: str) -> Person:
    if not isinstance(data, Mapping):
        raise RecordingError(f"{where}: must be an object")
    rows = np.nan_to_num(rows_from_json(data.get("keypoints_2d"), 3, f"{where}.keypoints_2d"))
    keypoints_2d = Keypoints2D.from_rows(rows)
    id = data.get("id", 0)
    if not isinstance(id, int) or isinstance(id, bool) or id < 0:
        raise RecordingError(f"{where}.id: must be a whole number, got {id!r}")
    hands = _hands_from_json(data, where)
    if "failed" in data:
        return replace(Person.failure(keypoints_2d, str(data["failed"])), id=id, hands=hands)
    source = data.get("source")
    if not isinstance(source, list) or len(source) != N_JOINTS or not set(source) <= {OBSERVED, INFERRED, MISSING}:
        raise RecordingError(f"{where}.source: must be 18 of {OBSERVED}, {INFERRED}, {MISSING}")
    return Person(
        keypoints_2d,
        rows_from_json(data.get("keypoints"), 3, f"{where}.keypoints"),
        _numbers(data.get("confidence"), f"{where}.confidence"),
        _numbers(data.get("sigma_m"), f"{where}.sigma_m"),
        tuple(source),
        id,
        hands,
    )


def _hands_from_json(data: Mapping[str, Any], where: str) -> Hands:
    palms, why = data.get("hands") or {}, data.get("hands_missing")
    if not isinstance(palms, Mapping):
        raise RecordingError(f"{where}.hands: must be an object")
    if why is not None and not isinstance(why, Mapping):
        raise RecordingError(f"{where}.hands_missing: must be an object")
    for side, reason in (why or {}).items():
        if side not in _SIDES:
            raise RecordingError(f"{where}.hands_missing: {side!r} must be {one_of(_SIDES)}")
        if not isinstance(reason, str):
            raise RecordingError(f"{where}.hands_missing.{side}: must be a text, got {reason!r}")
    left, right = (_palm_from_json(palms.get(side), f"{where}.hands.{side}") for side in _SIDES)
    return Hands(left, right, dict(why or {}))


def _palm_from_json(data: Any, where: str) -> Palm | None:
    if data is None:
        return None
    if not isinstance(data, Mapping):
        raise RecordingError(f"{where}: must be an object or null")
    confidence = data.get("confidence", 1.0)
    if not _is_number(confidence) or not 0 <= confidence <= 1:
        raise RecordingError(f"{where}.confidence: must be a number in [0, 1], got {confidence!r}")
    direction, keypoints, seen = (data.get(key) for key in ("direction", "keypoints", "keypoints_2d"))
    return Palm(
        _unit_from_json(data.get("normal"), f"{where}.normal"),
        float(confidence),
        None if direction is None else _unit_from_json(direction, f"{where}.direction"),
        None if keypoints is None else _hand_rows(keypoints, f"{where}.keypoints"),
        None if seen is None else _hand_rows_2d(seen, f"{where}.keypoints_2d"),
    )


def _unit_from_json(data: Any, where: str) -> Float[np.ndarray, "3"]:
    """A unit vector, at most 1 % off; one that was only rounded stays as it is."""
    if not isinstance(data, list) or len(data) != 3 or not all(_is_number(x) for x in data):
        raise RecordingError(f"{where}: must be 3 numbers")
    length = math.hypot(*data)
    if not abs(length - 1) <= 0.01:
        raise RecordingError(f"{where}: must be a unit vector, got {data}")
    return np.array(data, dtype=np.float64) / (1.0 if abs(length - 1) <= _ROUNDED else length)


def _hand_rows(data: Any, where: str) -> Float[np.ndarray, "21 3"]:
    """A hand's rows; NaN where null."""
    rows = rows_from_json(data, 3, where, len(HAND_KEYPOINTS))
    if not np.isfinite(rows[[row is not None for row in data]]).all():
        raise RecordingError(f"{where}: must be finite; a row without a position is null")
    return rows


def _hand_rows_2d(data: Any, where: str) -> Float[np.ndarray, "21 3"]:
    """A hand's rows u, v, score; zeros where null."""
    rows = np.nan_to_num(_hand_rows(data, where))
    if rows[:, 2].min() < 0 or rows[:, 2].max() > 1:
        raise RecordingError(f"{where}: scores must lie in [0, 1]")
    return rows


def rows_to_json(rows: np.ndarray, digits: int) -> list[list[float] | None]:
    """Array of rows -> lists; a row with a NaN becomes null."""
    return [None if np.isnan(r).any() else [round(float(x), digits) for x in r] for r in rows]


def rows_from_json(data: Any, n: int, where: str, count: int = N_JOINTS) -> np.ndarray:
    """`count` rows of n numbers (or null -> NaN). Raises RecordingError that names `where`."""
    if not isinstance(data, Sequence) or len(data) != count:
        raise RecordingError(f"{where}: must be a list of {count} rows")
    try:
        rows = [[np.nan] * n if r is None else [_number(x) for x in r] for r in data]
        return np.array(rows, dtype=np.float64).reshape(count, n)
    except (TypeError, ValueError, OverflowError) as e:
        raise RecordingError(f"{where}: each row must be {n} numbers or null ({e})") from e


def _numbers(data: Any, where: str) -> np.ndarray:
    if not isinstance(data, Sequence) or len(data) != N_JOINTS:
        raise RecordingError(f"{where}: must be a list of {N_JOINTS} numbers")
    try:
        return np.array([np.nan if x is None else float(x) for x in data])
    except (TypeError, ValueError) as e:
        raise RecordingError(f"{where}: must be numbers ({e})") from e


def _is_number(x: Any) -> bool:
    """Whether JSON has a number there that a float can hold."""
    return isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= sys.float_info.max


def _number(x: Any) -> float:
    if isinstance(x, bool | str):
        raise TypeError(f"{x!r} is not a number")
    return float(x)
