"""Detectors that look up 2D keypoints which somebody computed before."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from understudy.errors import DetectorError, one_of
from understudy.files import read_json
from understudy.skeleton import LAYOUTS, to_coco18
from understudy.types import Keypoints2D, RegisteredDepth


class RecordingKeypoints:
    """The recording's own `keypoints2d.json`."""

    name = "recording"

    def __init__(self, keypoints: Mapping[int, Sequence[Keypoints2D]] | None, where: str = "the recording"):
        """keypoints: people by frame index. Raises DetectorError when there are none at all."""
        if keypoints is None:
            raise DetectorError(
                f"{where} has no keypoints2d.json, which detector 'recording' reads; use --detector blazepose"
            )
        self._keypoints = keypoints

    def detect(
        self, color: UInt8[np.ndarray, "h w 3"], depth: RegisteredDepth | None = None, index: int = 0
    ) -> list[Keypoints2D]:
        """People of frame `index` (see `Detector.detect`)."""
        return list(self._keypoints.get(index, ()))


class OpenPoseJson:
    """A folder of OpenPose's `--write_json` output: one file a frame, the frame's number last in its name."""

    name = "openpose-json"

    def __init__(self, folder: Path, layout: str = "auto"):
        """layout: the skeleton (`skeleton.LAYOUTS`), or auto: by the number of keypoints and where the neck is."""
        self.folder = Path(folder)
        if layout != "auto" and layout not in LAYOUTS:
            raise DetectorError(f"openpose-json layout {layout!r}: must be {one_of(['auto', *LAYOUTS])}")
        if not self.folder.is_dir():
            raise DetectorError(f"{folder}: no such folder of OpenPose JSON files")
        self._files: dict[int, Path] = {}
        for path in sorted(self.folder.glob("*.json")):
            numbers = re.findall(r"\d+", path.stem)
            if not numbers:
                raise DetectorError(f"{path}: no frame number in the file's name")
            if int(numbers[-1]) in self._files:
                raise DetectorError(f"{path} and {self._files[int(numbers[-1])].name}: the same frame number twice")
            self._files[int(numbers[-1])] = path
        if not self._files:
            raise DetectorError(f"{folder}: holds no .json files")
        self.layout = layout if layout != "auto" else self._guess_layout()

    def detect(
        self, color: UInt8[np.ndarray, "h w 3"], depth: RegisteredDepth | None = None, index: int = 0
    ) -> list[Keypoints2D]:
        """People of the file of frame `index`. Raises DetectorError where there is none (OpenPose writes them all)."""
        path = self._files.get(index)
        if path is None:
            raise DetectorError(f"{self.folder}: no file for frame {index}")
        return [self._person(rows, path) for rows in _read(path)]

    def _person(self, rows: np.ndarray, path: Path) -> Keypoints2D:
        if len(rows) != LAYOUTS[self.layout][0]:
            raise DetectorError(
                f"{path}: pose_keypoints_2d has {len(rows)} keypoints, but layout {self.layout!r} has "
                f"{LAYOUTS[self.layout][0]}"
            )
        return Keypoints2D.from_rows(to_coco18(rows, self.layout))

    def _guess_layout(self) -> str:
        """By the number of keypoints. Both BODY_25 and BODY_25B have 25: eyes and ears are the rows close to the nose,
        15 to 18 in the one and 1 to 4 in the other; everybody in the folder has a vote.
        """
        votes = 0
        for path in self._files.values():
            for rows in _read(path):
                fitting = [name for name, (n, _) in LAYOUTS.items() if n == len(rows) and name != "blazepose"]
                if not fitting:
                    sizes = sorted({n for n, _ in LAYOUTS.values()})
                    raise DetectorError(f"{path}: pose_keypoints_2d has {len(rows)} keypoints; known: {sizes}")
                if len(fitting) == 1:
                    return fitting[0]
                votes += _face_is_first(rows)
        return "body_25b" if votes > 0 else "body_25"


def _face_is_first(rows: np.ndarray) -> int:
    """1 if rows 1 to 4 lie closer to row 0, the nose, than rows 15 to 18 do; -1 if not; 0 if that cannot be said."""
    if rows[0, 2] <= 0.1:
        return 0
    distances = np.where(rows[:, 2] > 0.1, np.linalg.norm(rows[:, :2] - rows[0, :2], axis=1), np.nan)
    first, last = distances[1:5], distances[15:19]
    if np.isnan(first).all() or np.isnan(last).all():
        return 0
    return 1 if np.nanmedian(first) < np.nanmedian(last) else -1


def _read(path: Path) -> list[np.ndarray]:
    """The n x 3 keypoints of each person of one file."""
    try:
        people = read_json(path)["people"]
        rows = [np.array(p["pose_keypoints_2d"], dtype=np.float64).reshape(-1, 3) for p in people]
    except (ValueError, KeyError, TypeError) as e:
        raise DetectorError(
            f"{path}: not OpenPose's JSON (people[].pose_keypoints_2d, triples u v score): {e!r}"
        ) from e
    for r in rows:
        if not np.isfinite(r).all():  # null
            raise DetectorError(f"{path}: pose_keypoints_2d holds values that are not numbers")
    return [r for r in rows if (r[:, 2] > 0).any()]
