"""keypoints2d.json: 2D keypoints that come with a recording. Reading and its inverse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from understudy.errors import RecordingError
from understudy.files import read_json
from understudy.people_file import rows_from_json
from understudy.recordings.truth import frames_from_json
from understudy.types import Keypoints2D


def read_keypoints2d(path: Path) -> dict[int, list[Keypoints2D]]:
    """Frame number -> people. Raises RecordingError that names the file and the place in it.

    A row that is null counts as not found, like `[0, 0, 0]`.
    """
    frames = frames_from_json(read_json(path), path, _person_from_json)
    return {index: list(people) for index, people in frames.items()}


def keypoints2d_to_json(frames: Mapping[int, Sequence[Keypoints2D]]) -> dict[str, Any]:
    """The content of a keypoints2d.json."""
    return {
        "frames": [
            {"index": index, "people": [{"keypoints": k.rows().tolist()} for k in frames[index]]}
            for index in sorted(frames)
        ]
    }


def _person_from_json(data: Any, where: str, position: int) -> Keypoints2D:
    if not isinstance(data, Mapping):
        raise RecordingError(f"{where}: must be an object")
    rows = np.nan_to_num(rows_from_json(data.get("keypoints"), 3, f"{where}.keypoints"), posinf=np.inf, neginf=-np.inf)
    if not np.isfinite(rows).all():
        raise RecordingError(f"{where}.keypoints: must be finite")
    if rows[:, 2].min() < 0 or rows[:, 2].max() > 1:
        raise RecordingError(f"{where}.keypoints: scores must lie in [0, 1]")
    return Keypoints2D.from_rows(rows)
